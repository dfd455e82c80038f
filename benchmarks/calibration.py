"""The odds of a loop: how they were fitted, and what they come to on places that were left out.

    python benchmarks/calibration.py [--data FOLDER] [--cases 'a;b;c'] [--rows FILE.npz ...]

FOLDER holds `gardens_point` and `corridor`. Every case goes through `LoopDetector` with the default settings and
sequences of 10, 5 and 1 frames; the evidence for each candidate is labelled by the truth (right within 3 frames, wrong
beyond 10, neither in between) and a logistic model is fitted to that of the longest sequences, every case
weighing the same. Then each group of places is left out in turn. With `--rows` the evidence is kept in a file, or taken
from files that exist: `--rows a.npz b.npz` joins the cases of two runs.
"""

import argparse
import hashlib
from functools import partial
from itertools import chain, cycle, islice
from pathlib import Path

import numpy as np
from sklearn.linear_model import LogisticRegression

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.decision import features_of
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.verification import Verifier

LENGTHS = 10, 5, 1
RIGHT, WRONG, TOLERANCE = 3, 10, 2
BARS = 1.0, 2.0, 3.0, 3.5, 4.0, 4.37, 5.0  # 4.37: the default rate
PAIRS = {
    "day": ("gardens_point/day_left", "gardens_point/day_right"),
    "night": ("gardens_point/day_right", "gardens_point/night_right"),
    "night, other side": ("gardens_point/day_left", "gardens_point/night_right"),
    "corridor": ("corridor/ref", "corridor/query"),
}
PARTS = {  # of the first traverse, that the second one passes: it comes from new places and goes on to others
    "day, a part": ("gardens_point/day_left", "gardens_point/day_right", 60, 140),
    "night, a part": ("gardens_point/day_right", "gardens_point/night_right", 60, 140),
    "night, other side, a part": ("gardens_point/day_left", "gardens_point/night_right", 0, 120),
    "corridor, a part": ("corridor/ref", "corridor/query", 30, 80),
}
DRIVES = {
    "sim day": {"seed": 20, "covered": 0.4},
    "sim dusk": {"seed": 21, "covered": 0.4, "light": "dusk", "revisit_light": "dusk"},
    "sim night": {"seed": 22, "covered": 0.4, "light": "night", "revisit_light": "night"},
    "sim day, then dusk": {"seed": 23, "revisit_light": "dusk"},
    "sim day, then night": {"seed": 24, "covered": 0.2, "revisit_light": "night"},
    "sim long": {"seed": 25, "covered": 0.4, "frames": 600},
    "sim free": {"seed": 26, "covered": 0.1},
    "sim same lane, by night": {"seed": 27, "revisit_light": "night", "lateral_offset_m": 0.0, "covered": 0.2},
    "sim next lane, at dusk": {"seed": 28, "revisit_light": "dusk", "lateral_offset_m": 1.5, "covered": 0.3},
    "sim no loop, day": {"seed": 30, "frames": 1000, "revisit": False},
    "sim no loop, crowded": {"seed": 31, "frames": 1000, "revisit": False, "covered": 0.4},
    "sim no loop, night": {"seed": 32, "frames": 1000, "revisit": False, "covered": 0.2, "light": "night"},
    "sim no loop, dusk": {"seed": 33, "frames": 1000, "revisit": False, "covered": 0.3, "light": "dusk"},
} | {
    f"sim no loop, {light}, {covered:.0%} covered": {
        "seed": 40 + i,
        "frames": 1000,
        "revisit": False,
        "covered": covered,
        "light": light,
    }
    for i, (light, covered) in enumerate(
        zip(islice(cycle(("day", "dusk", "night")), 10), 2 * (0.0, 0.1, 0.2, 0.3, 0.4), strict=True)
    )
}
COLUMNS = "case", "length", "query", "rank", "off", "loop", "full"  # then the features


class Remembered:
    """A function of one image that is computed once for each image."""

    def __init__(self, function):
        self._function, self._known = function, {}

    def __call__(self, image):
        key = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        if key not in self._known:
            self._known[key] = self._function(image)
        return self._known[key]


def cases(data):
    """Return by name: group, and a function to reference or None, images, true places (-inf: nowhere), loop or not."""
    found = {}
    for name, (reference, query) in PAIRS.items():
        group = reference.split("/")[0]
        found[name] = group, partial(pair, data / reference, data / query)
        found[f"{name}, one stream"] = group, partial(joined, data / reference, data / query)
    for name, (reference, query, first, after) in PARTS.items():
        found[name] = reference.split("/")[0], partial(joined, data / reference, data / query, first, after)
    for folder in sorted(set(chain.from_iterable(PAIRS.values()))):
        found[f"{folder} alone"] = folder.split("/")[0], partial(alone, data / folder)
    return found | {name: ("simulator", partial(drive, settings)) for name, settings in DRIVES.items()}


def pair(reference, query):
    images = list(ImageSequence(query))
    return list(ImageSequence(reference)), images, np.arange(len(images)), np.full(len(images), True)


def joined(reference, query, first=0, after=None):
    mapped = list(ImageSequence(reference))[first:after]
    images = list(ImageSequence(query))
    true = np.arange(len(images)) - first
    return (
        None,
        mapped + images,
        np.r_[np.full(len(mapped), -np.inf), true],
        np.r_[np.full(len(mapped), False), (true >= 0) & (true < len(mapped))],
    )


def alone(folder):
    images = list(ImageSequence(folder))
    return None, images, np.full(len(images), -np.inf), np.full(len(images), False)


def drive(settings):
    frames = list(Drive(SimulationSettings(**{"frames": 300, **settings})))
    at = np.array([(frame.pose.x_m, frame.pose.y_m) for frame in frames])
    true = nearest_before(at)
    return None, [frame.image for frame in frames], np.where(true < 0, -np.inf, true), true >= 0


def nearest_before(at, exclude=30, radius_m=3.0):
    true = np.full(len(at), -1)
    for query in range(exclude, len(at)):
        away = np.linalg.norm(at[: query - exclude + 1] - at[query], axis=1)
        if away.min() < radius_m:
            true[query] = away.argmin()
    return true


def evidence(case, name, reference, images, true, loop, length, maps, local):
    """Return one row for each candidate of each frame."""
    detector = LoopDetector(Config().with_settings({"sequence.length": length}))
    detector.method.features = lambda batch: [maps(image) for image in batch]
    detector.verifier.features = local
    if reference is not None:
        detector.set_reference(reference)
        detector.verifier.features = local
    full_from = length - 1 + (int(loop.argmax()) if reference is None else 0)
    rows = []
    for image, where, back in zip(images, true, loop, strict=True):
        query = detector.add(image).query
        for rank, one in enumerate(detector.evidence):
            rows.append(
                [case, length, query, rank, abs(one.match - where), back, query >= full_from, *features_of(one)]
            )
    print(f"{name:26} {length:3} {len(images):5} frames", flush=True)
    return rows


def label(rows):
    """1 for a loop, 0 for none, -1 for what is neither: near misses, and windows that reach over the seam."""
    off, loop, full = rows[:, 4], rows[:, 5] > 0, rows[:, 6] > 0
    return np.where(loop & full & (off <= RIGHT), 1, np.where((full | ~loop) & (off > WRONG), 0, -1))


def fit(rows):
    labels = label(rows)
    kept = (labels >= 0) & (rows[:, 1] == max(LENGTHS))
    _, inverse, counts = np.unique(rows[:, 0], return_inverse=True, return_counts=True)
    model = LogisticRegression(C=1.0, max_iter=1000)
    features = rows[:, len(COLUMNS) :]
    scale = features[kept].std(0)
    model.fit(features[kept] / scale, labels[kept], sample_weight=1000 / counts[inverse][kept])
    return model.coef_[0] / scale, model.intercept_[0]


def judge(rows, weights, constant):
    """Return for each frame that has a candidate: log-odds of the best, frames it is off, loop, full."""
    odds = rows[:, len(COLUMNS) :] @ weights + constant
    order = np.lexsort((-odds, rows[:, 2]))
    best = order[np.r_[True, np.diff(rows[order, 2]) > 0]]
    return odds[best], rows[best, 4], rows[best, 5] > 0, rows[best, 6] > 0


def right_and_wrong(off, loop, full):
    """Return which candidates count as right and which as wrong.

    Those of frames without a full sequence of the loop behind them count for neither, nor do those near the place of a
    frame that the map just does not hold.
    """
    right = off <= TOLERANCE
    return right & loop & full, ~right & (full | ~loop) & (loop | (off > WRONG))


def figures(rows, weights, constant, bars):
    odds, off, loop, full = judge(rows, weights, constant)
    right, wrong = right_and_wrong(off, loop, full)
    total = max((loop & full).sum(), 1)
    worst = odds[wrong].max(initial=-np.inf)
    accepted = [((right & (odds >= bar)).sum() / total, (wrong & (odds >= bar)).sum()) for bar in bars]
    return right.sum() / total, (right & (odds > worst)).sum() / total, accepted, (loop & full).any()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cases", default="")
    parser.add_argument("--rows", type=Path, nargs="+", default=[])
    args = parser.parse_args()
    names, groups, rows = [], [], []
    if args.rows and args.rows[0].exists():
        names, groups, rows = taken_from(args.rows)
    else:
        network = LoopDetector().method.features
        for name, (group, images_of) in cases(args.data).items():
            if args.cases and name not in args.cases.split(";"):
                continue
            reference, images, true, loop = images_of()
            maps = Remembered(lambda image: network([image])[0])
            local = Remembered(Verifier("fast").features)
            names.append(name)
            groups.append(group)
            for length in LENGTHS:
                rows += evidence(len(names) - 1, name, reference, images, true, loop, length, maps, local)
        rows = np.array(rows, np.float64)
        if args.rows:
            np.savez(args.rows[0], names=names, groups=groups, rows=rows)
    report(names, np.array(groups), rows)


def taken_from(files):
    names, groups, rows = [], [], []
    for file in files:
        kept = np.load(file)
        rows.append(kept["rows"] + np.eye(1, kept["rows"].shape[1]) * len(names))
        names += kept["names"].tolist()
        groups += kept["groups"].tolist()
    return names, groups, np.concatenate(rows)


def report(names, groups, rows):
    group = groups[rows[:, 0].astype(int)]
    weights, constant = fit(rows)
    print("\nfitted on all:", " ".join(f"{weight:.3f}" for weight in weights), f"constant {constant:.3f}")
    held = {one: fit(rows[group != one]) for one in np.unique(groups) if (group != one).any()}
    for length in LENGTHS:
        print(
            f"\nsequences of {length}: top-1, recall at 100 % precision, then recall and false loops at log-odds", BARS
        )
        for how in ("fitted on all", "its group left out")[: 1 + bool(held)]:
            totals = []
            for case, name in enumerate(names):
                of = rows[(rows[:, 0] == case) & (rows[:, 1] == length)]
                model = (weights, constant) if how == "fitted on all" else held[groups[case]]
                top, full, accepted, loops = figures(of, *model, BARS)
                free = len(np.unique(of[of[:, 5] == 0, 2]))
                totals.append((loops, top, full, accepted, len(np.unique(of[:, 2])), free))
                cells = " ".join(f"{recall:6.2f} {false:4d}" for recall, false in accepted)
                print(f"  {name:28} {f'{top:5.3f} {full:5.3f}' if loops else '          -'}  {cells}")
            with_loops = [total for total in totals if total[0]]
            mean = " ".join(
                f"{np.mean([t[3][i][0] for t in with_loops]):6.2f} {sum(t[3][i][1] for t in totals):4d}"
                for i in range(len(BARS))
            )
            print(
                f"  {how:28} {np.mean([t[1] for t in with_loops]):5.3f} {np.mean([t[2] for t in with_loops]):5.3f}  "
                f"{mean}  of {sum(t[4] for t in totals)} frames"
            )
            free = sum(t[5] for t in totals)
            odds = [1000 * sum(t[3][i][1] for t in totals) / free * (1 + np.exp(bar)) for i, bar in enumerate(BARS)]
            print(f"  false loops in 1000 of {free} frames without a loop, to one at even odds:", *np.round(odds, 1))


if __name__ == "__main__":
    main()
