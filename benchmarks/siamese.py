"""The Siamese network on scene photographs, and what it does to loop closing.

    python benchmarks/siamese.py [--data FOLDER] [--epochs N] [--model FOLDER]

FOLDER holds `scenes15` and `gardens_point`. The embedded network is trained on `scenes15/train` up to its tap s16,
where the detector takes its maps; pairs of `scenes15/test` (one scene class or two, half of each) are told apart by the
mean over that map, before and after, at the threshold that is best on the part of `scenes15/train` that was not learned
from. Then loops are looked for with both networks: sequences of 10, a match is right within 2 frames, basis and
clusters are learned on the reference or on the drive, the KL transform cuts `gamma` of the channels, and what the local
features say is left out, as they are the same with both. `--model` keeps the model, or takes one that is there.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from baselines import Remembered

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.evaluation import LoopLog, evaluate, load_truth
from loopclosure.features.backbones import Backbone
from loopclosure.images.simulator import SimulationSettings, simulate
from loopclosure.store import HEADER, TRAINED
from loopclosure.training.data import open_data
from loopclosure.training.measures import best_threshold, pair_accuracy
from loopclosure.training.siamese import describe_images, train_siamese

PAIRS, GAMMAS = 5000, (0.0, 0.6, 0.8, 0.9)
SETTINGS = {"training.halve_every": 3}
LOOPS = {"verification.mode": "none"}
WALKS = {
    "day_right / day_left": ("day_left", "day_right"),
    "night_right / day_right": ("day_right", "night_right"),
    "night_right / day_left": ("day_left", "night_right"),
}
DRIVES = {
    "drive, day / day": {"covered": 0.25},
    "drive, day / dusk": {"covered": 0.25, "revisit_light": "dusk"},
    "drive, day / night": {"covered": 0.25, "revisit_light": "night"},
}


def compared(backbone, images, places):
    """Similarities of balanced pairs of images, and whether they are of one class."""
    pairs, same = places.draw(PAIRS, np.random.default_rng(0))
    vectors = describe_images(backbone, (images[int(number)] for number in places.members), Config().training)
    first, second = np.searchsorted(places.members, pairs).T
    return np.einsum("nd,nd->n", vectors[first], vectors[second]), same


def verification(weights, scenes):
    """Share of pairs of test photographs that are told apart."""
    config = Config()
    backbone = Backbone(config.features.backbone, config.features.layer, weights=weights)
    train, test = (open_data(scenes / part, config=config) for part in ("train", "test"))
    rng = np.random.default_rng(config.training.seed)  # the split of the training
    _, held_out = train.places.split(config.training.held_out, rng)
    threshold = best_threshold(*compared(backbone, train.images, held_out))
    return pair_accuracy(*compared(backbone, test.images, test.places), threshold)


def found(weights, gamma, known, images, reference, truth_file):
    """Recall at precision 1 and top-1 with a network; `known` remembers features by network."""
    config = Config().with_settings({"compression.gamma": gamma, "features.weights": weights} | LOOPS)
    detector = LoopDetector(config)
    detector.method.features = known.setdefault(weights, Remembered(detector.method.features))
    if reference is not None:
        detector.set_reference(ImageSequence(reference))
    log = LoopLog.from_decisions(detector.detect(ImageSequence(images)))
    frames = (len(log), None if reference is None else detector.map_size)
    band = config.sequence.exclude_recent if reference is None else 0
    truth = load_truth(truth_file, frames=frames, exclude_recent=band)
    metrics = evaluate(log, truth, tolerance=0, bootstrap=0).metrics
    return f"{metrics['recall_at_100_precision'] or 0:.3f} {metrics['top1'] or 0:.3f}"


def sets_of(data, folder):
    """Name, images, reference images and truth file of each test."""
    walks = data / "gardens_point"
    for name, (reference, query) in WALKS.items():
        yield name, walks / query, walks / reference, walks / "truth.csv"
    for name, settings in DRIVES.items():
        drive = simulate(folder / name.replace(" ", ""), SimulationSettings(seed=7, **settings))
        yield name, drive / "images", None, drive / "truth.csv"


def loops(data, networks, folder):
    print("\nR@100P and top-1, before -> after")
    print(f"{'':24} " + "   ".join(f"{f'gamma {gamma}':>26}" for gamma in GAMMAS))
    for name, *files in sets_of(data, folder):
        known = {}
        cells = (" -> ".join(found(network, gamma, known, *files) for network in networks) for gamma in GAMMAS)
        print(f"{name:24} {'   '.join(f'{cell:>26}' for cell in cells)}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("LOOPCLOSURE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--model", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = arguments.model or Path(folder) / "model"
        if not (model / HEADER).is_file():
            start = time.perf_counter()
            config = Config().with_settings(SETTINGS | {"training.epochs": arguments.epochs})
            card = train_siamese(arguments.data / "scenes15" / "train", model, config=config)
            print(f"trained in {time.perf_counter() - start:.0f} s on {card['data']}, best epoch {card['best_epoch']}")
            for row in card["history"]:
                print({name: value if value is None else round(value, 4) for name, value in row.items()}, flush=True)
        networks = "default", str(model / TRAINED)
        before, after = (verification(weights, arguments.data / "scenes15") for weights in networks)
        print(f"pairs of held-out photographs told apart: {before:.3f} before, {after:.3f} after")
        loops(arguments.data, networks, Path(folder))


if __name__ == "__main__":
    main()
