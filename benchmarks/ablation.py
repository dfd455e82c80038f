"""What each part of the default earns: one row a part, the others as they are shipped.

    python benchmarks/ablation.py [--data FOLDER] [--cases 'a;b;c'] [--parts 'a;b;c'] [--length 10]

Figures of each case: share of the frames with a true loop and a full sequence behind them whose best candidate is right
(within 2 frames), their recall at 100 % precision, the recall of what is accepted, and the number of false loops.
"""

import argparse
from pathlib import Path

import numpy as np
from calibration import Remembered, cases, right_and_wrong

from loopclosure import Config, LoopDetector
from loopclosure.verification import Verifier

CASES = (
    "day;night;night, other side;corridor;day, one stream;night, other side, one stream;"
    "sim day;sim dusk;sim night;gardens_point/day_left alone;corridor/ref alone"
)
PARTS = {
    "as shipped": {},
    "no verification": {"verification.mode": "none"},
    "strict verification": {"verification.mode": "strict"},
    "no whitening (and a threshold)": {"aggregation.components": 0},
    "128 whitened numbers a part": {"aggregation.components": 128},
    "no layout": {"aggregation.layout_weight": 0},
    "layout as heavy as NetVLAD": {"aggregation.layout_weight": 1.0},
    "what rides along counts as well": {"aggregation.change_over": 0},
    "neither": {"aggregation.layout_weight": 0, "aggregation.change_over": 0},
    "nothing taken out (and a threshold)": {"aggregation.centre_window": 0},
    "KL before NetVLAD, gamma 0": {"compression.gamma": 0.0},
    "KL before NetVLAD, gamma 0.6": {"compression.gamma": 0.6},
    "KL before NetVLAD, gamma 0.8": {"compression.gamma": 0.8},
    "KL before NetVLAD, gamma 0.9": {"compression.gamma": 0.9},
    "KL before NetVLAD, gamma auto": {"compression.gamma": "auto"},
    "32 clusters": {"aggregation.clusters": 32},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cases", default=CASES)
    parser.add_argument("--parts", default=";".join(PARTS))
    parser.add_argument("--length", type=int, default=10)
    args = parser.parse_args()
    known = cases(args.data)
    network = LoopDetector().method.features
    found = {part: [] for part in args.parts.split(";")}
    for name in args.cases.split(";"):
        reference, images, true, loop = known[name][1]()
        maps = Remembered(lambda image: network([image])[0])
        local = {mode: Remembered(Verifier(mode).features) for mode in ("fast", "strict")} | {"none": None}
        for part in found:
            config = Config().with_settings({"sequence.length": args.length, **PARTS[part]})
            *row, _ = figures(config, reference, images, true, loop, maps=maps, local=local[config.verification.mode])
            found[part].append(row)
            print(f"{name:32} {part:36}", *(f"{value:7.3f}" for value in found[part][-1]), flush=True)
    print(f"\n{'mean over the cases, false loops in all':36}   top-1  R@100P  recall   false")
    for part, rows in found.items():
        top, full, recall, false = np.array(rows).T
        print(f"{part:36} {np.nanmean(top):7.3f} {np.nanmean(full):7.3f} {np.nanmean(recall):7.3f} {false.sum():7.0f}")


def figures(config, reference, images, true, loop, *, maps=None, local=None):
    """Return top-1, recall at 100 % precision, recall, false loops, and the best score of a wrong candidate.

    `maps` and `local` compute the features of an image where these are shared by several runs.
    """
    detector = LoopDetector(config)
    if maps is not None:
        detector.method.features = lambda batch: [maps(image) for image in batch]
    _verify_by(local, detector)
    if reference is not None:
        detector.set_reference(reference)
        _verify_by(local, detector)
    decisions = [detector.add(image) for image in images]
    first = config.sequence.length - 1 + (int(loop.argmax()) if reference is None else 0)
    full = np.arange(len(images)) >= first
    off = np.abs(true - [np.nan if one.match is None else one.match for one in decisions])
    score = np.array([-np.inf if one.score is None else one.score for one in decisions])
    accepted = np.array([one.accepted for one in decisions])
    right, wrong = (which & ~np.isnan(off) for which in right_and_wrong(off, loop, full))
    worst = score[wrong].max(initial=0.0)
    if not loop.any():
        return np.nan, np.nan, np.nan, (wrong & accepted).sum(), worst
    total = (loop & full).sum()
    above = score > worst
    return (
        right.sum() / total,
        (right & above).sum() / total,
        (right & accepted).sum() / total,
        (wrong & accepted).sum(),
        worst,
    )


def _verify_by(local, detector):
    if local is not None and detector.verifier is not None:
        detector.verifier.features = local


if __name__ == "__main__":
    main()
