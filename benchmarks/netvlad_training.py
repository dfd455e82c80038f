"""A NetVLAD layer trained on one simulated drive, on another one of another street in another light.

    python benchmarks/netvlad_training.py [--seeds 5] [--frames 300] [--set training.learning_rate=0.001 ...]

For each seed the layer is trained on a drive by day whose second lap is at dusk, and looks for loops in a drive by day
whose second lap is at night, along another street; people and cars take a quarter of the view. It is compared with
the layer that it began as, k-means clusters on the same training drive behind the same KL basis: recall at
precision 1 of single frames and of sequences of 10, one stream, a match is right as the simulator's truth has it.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from baselines import Remembered

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.evaluation import LoopLog, evaluate, load_truth
from loopclosure.images.simulator import SimulationSettings, simulate
from loopclosure.training.netvlad import train_netvlad

LENGTHS = 1, 10
SETTINGS = {
    "training.positive_m": 3.0,
    "training.negative_m": 8.0,
    "training.learning_rate": 1e-2,
    "training.epochs": 10,
}


def recalls(model, drive, known):
    """Recall at precision 1 for each length of sequences; `known` remembers the features of the drive."""
    values = []
    for length in LENGTHS:
        config = LoopDetector(model=model).config.with_settings({"sequence.length": length})
        detector = LoopDetector(config, model=model)
        known.setdefault("features", Remembered(detector.method.features))
        detector.method.features = known["features"]
        log = LoopLog.from_decisions(detector.detect(ImageSequence(drive / "images")))
        truth = load_truth(drive / "truth.csv", frames=(len(log), None), exclude_recent=config.sequence.exclude_recent)
        values.append(evaluate(log, truth, tolerance=0, bootstrap=0).metrics["recall_at_100_precision"] or 0.0)
    return values


def one_seed(seed, frames, settings, folder):
    """Recalls of the k-means layer and of the trained one."""
    drives = {"train": (seed, "dusk"), "test": (seed + 1000, "night")}
    for name, (street, light) in drives.items():
        simulate(folder / name, SimulationSettings(frames=frames, seed=street, covered=0.25, revisit_light=light))
    results, known = [], {}
    for name, epochs in (("k-means", {"training.epochs": 0}), ("trained", {})):
        config = Config().with_settings(settings | {"training.seed": seed} | epochs)
        train_netvlad(folder / "train/images", folder / name, poses=folder / "train/poses.csv", config=config)
        results.append(recalls(folder / name, folder / "test", known))
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.FIELD=VALUE")
    arguments = parser.parse_args()
    settings = SETTINGS | dict(pair.split("=") for pair in arguments.set)
    print(f"{'seed':>12}   " + "   ".join(f"l = {length}: k-means, trained" for length in LENGTHS))
    rows = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(one_seed(seed, arguments.frames, settings, Path(folder)))
        print_row(str(seed), rows[-1])
    for name, measure in (("mean", np.mean), ("spread (std)", np.std)):
        print_row(name, measure(rows, axis=0))


def print_row(name, row):
    before, after = row
    cells = (f"{b:17.3f} {a:8.3f}" for b, a in zip(before, after, strict=True))
    print(f"{name:>12}   {'   '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
