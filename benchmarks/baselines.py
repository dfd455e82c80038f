"""Every method but faster-rcnn and onnx, without a download: places found on real photographs, and the cost of a frame.

    OMP_NUM_THREADS=1 python benchmarks/baselines.py [--data FOLDER] [--methods a,b,c] [--only accuracy|cost]

FOLDER holds `gardens_point`, `corridor` and `street`. A match is right within 2 frames; frames with a full sequence
behind them count. `fabmap` and `bow` learn their words from `street/images`, all others what they learn from the
reference traverse. The cost is one `LoopDetector.add` in one stream, features included, CPU: medians of alternating
runs on a map of 300 and one of 3,000 frames, which are the photographs and their mirror images.
"""

import argparse
import hashlib
import os
import platform
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.config import EMBEDDED
from loopclosure.evaluation.metrics import Reports, precision_recall, recall_at_precision
from loopclosure.methods import METHODS

TOLERANCE = 2
LENGTHS = 1, 10
PAIRS = {
    "day_right / day_left": ("gardens_point/day_left", "gardens_point/day_right"),
    "night_right / day_right": ("gardens_point/day_right", "gardens_point/night_right"),
    "night_right / day_left": ("gardens_point/day_left", "gardens_point/night_right"),
    "corridor": ("corridor/ref", "corridor/query"),
}
TRAINED_BEFORE = "fabmap", "bow"
SHORT, LONG, RUNS = 300, 3000, 40


class Remembered:
    """A function of images that computes the features of each image once."""

    def __init__(self, features):
        self._features, self._known = features, {}

    def __call__(self, images):
        return [self._one(image) for image in images]

    def _one(self, image):
        key = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        if key not in self._known:
            self._known[key] = self._features([image])[0]
        return self._known[key]


def kind_of(name):
    """What the features of a method are shared under: fabmap and the bags of words have the same."""
    return "words" if name in ("fabmap", "bow", "bow-incremental") else name


def data_argument(parser):
    default = os.environ.get("LOOPCLOSURE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(default))


def config_of(name):
    """The shipped settings; the NetVLAD methods with the embedded network, as their own has to be downloaded."""
    settings = {"features.backbone": EMBEDDED, "features.layer": "s16"} if name.startswith("netvlad-") else {}
    return Config(method=name).with_settings(settings)


def make_detector(config, model, features=None):
    detector = LoopDetector(config, model=model)
    if features is not None:
        detector.method.features = features
    return detector


def fitted_before(name, data, features, folder):
    """Folder of a model where the method wants one that was made before, else None."""
    if name not in TRAINED_BEFORE:
        return None
    detector = make_detector(config_of(name), None, features)
    detector.fit(ImageSequence(data / "street" / "images"), source="street")
    print(f"{name}: learned in {detector.seconds['learn']:.1f} s from {detector.learned_on[0]}", flush=True)
    return detector.save_model(folder)


def score(decisions, length, threshold):
    """Top-1, recall at a precision of 1, precision and recall of what was accepted, and the best wrong score."""
    counted = [d for d in decisions if d.query >= length - 1]
    matched = [d for d in counted if d.match is not None]
    scores = np.array([d.score for d in matched])
    right = np.array([abs(d.match - d.query) <= TOLERANCE for d in matched])
    rows = np.arange(len(matched))
    curve = precision_recall(Reports(scores, right, rows, np.ones(len(counted), int)))
    accepted = scores >= threshold
    precision = right[accepted].mean() if accepted.any() else np.nan
    found, recalled = right.sum() / len(counted), (accepted & right).sum() / len(counted)
    return found, recall_at_precision(curve, 1.0) or 0, precision, recalled, scores[~right]


def accuracy(name, data, features, model):
    for pair, (reference, query) in PAIRS.items():
        cells = []
        for length in LENGTHS:
            detector = make_detector(config_of(name).with_settings({"sequence.length": length}), model, features)
            detector.set_reference(ImageSequence(data / reference))
            decisions = list(detector.detect(ImageSequence(data / query)))
            top1, recall, precision, accepted, wrong = score(decisions, length, detector.threshold)
            cells.append(f"{top1:5.3f}   {recall:5.3f}")
        worst = f"{wrong.max():8.3f}" if len(wrong) else "    none"
        cells.append(f"{precision:5.3f}   {accepted:5.3f}   {worst}")
        print(f"{name:16} {pair:24} {'   '.join(cells)}", flush=True)


def photographs(data):
    """All photographs, then their mirror images, without end."""
    folders = [*dict.fromkeys(folder for pair in PAIRS.values() for folder in pair), "street/images"]
    while True:
        for step in (1, -1):
            for folder in folders:
                for image in ImageSequence(data / folder):
                    yield np.ascontiguousarray(image[:, ::step])


def timed_add(detector, image):
    start = time.perf_counter()
    detector.add(image)
    return 1000 * (time.perf_counter() - start)


def cost(name, data, features, model):
    detector = make_detector(config_of(name), model, features)
    images = photographs(data)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(SHORT):
            detector.add(next(images))
        detector.save(folder)
        short = LoopDetector.load(folder)
    for _ in range(LONG - SHORT):
        detector.add(next(images))
    del detector.method.features  # from here on features cost what they cost
    before = dict(detector.seconds)
    kilobytes = detector.map_bytes / detector.map_size / 1e3
    pairs = np.array([[timed_add(one, image) for one in (short, detector)] for image in islice(images, RUNS)])
    stages = [1000 * (detector.seconds[stage] - before[stage]) / RUNS for stage in ("features", "describe", "match")]
    at_short, at_long = np.median(pairs, axis=0)
    ratio = np.median(pairs[:, 1] / pairs[:, 0])
    figures = " ".join(f"{value:8.2f}" for value in (at_short, at_long, ratio, *stages, kilobytes))
    print(f"{name:16} {figures}", flush=True)


TABLES = {
    "accuracy": (
        accuracy,
        f"top-1 and recall at precision 1, frames of their own | the same, sequences of {LENGTHS[-1]} | "
        "precision, recall and best wrong score of these at the method's own threshold",
    ),
    "cost": (
        cost,
        f"ms a frame at {SHORT} | at {LONG} | their ratio | features, describe, match at {LONG} | map, kB a frame",
    ),
}


def main():
    runnable = [name for name in METHODS if name not in ("onnx", "faster-rcnn")]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data_argument(parser)
    parser.add_argument("--methods", default=",".join(runnable))
    parser.add_argument("--only", choices=["accuracy", "cost"])
    arguments = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads")
    known = {}
    with tempfile.TemporaryDirectory() as folder:
        for title, (measure, columns) in TABLES.items():
            if arguments.only not in (None, title):
                continue
            print(f"\n{title}: {columns}")
            for name in arguments.methods.split(","):
                kind = kind_of(name)
                if kind not in known:
                    known[kind] = Remembered(make_detector(config_of(name), None).method.features)
                model = Path(folder) / name
                if not model.is_dir():
                    model = fitted_before(name, arguments.data, known[kind], model)
                measure(name, arguments.data, known[kind], model)


if __name__ == "__main__":
    main()
