"""One threshold of a method for many drives, and how it does on a drive that it was not chosen on.

    OMP_NUM_THREADS=1 python benchmarks/thresholds.py --methods a,b [--drives DRIVE ...] [--data FOLDER]

FOLDER holds the pairs of `baselines.py`; DRIVE is a folder of `loopclosure simulate`. The threshold is the least one
that lets no false loop through on any set, and a tenth of the way from there to the median score of the right
candidates; a candidate counts where it has moved on with the robot as `decision.consistency` asks. Each row chooses it
on the other sets (`left out`) and says what it then does on its own, beside the threshold of all sets together.
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from baselines import PAIRS, TOLERANCE, Remembered, data_argument, fitted_before, kind_of, make_detector

from loopclosure import Config, ImageSequence
from loopclosure.evaluation.truth import load_truth

MARGIN = 0.1


class Candidates(NamedTuple):
    """The best candidates of a set that pass every test but the threshold, and how many frames have a true match."""

    score: np.ndarray
    right: np.ndarray
    to_find: int


def traverses(data, drives):
    """Yield name, queries, references (None in one stream) and truth of each set."""
    for name, (reference, query) in PAIRS.items():
        queries, references = ImageSequence(data / query), ImageSequence(data / reference)
        yield name, queries, references, lambda query, match: abs(query - match) <= TOLERANCE, len(queries)
    for drive in map(Path, drives):
        queries = ImageSequence(drive / "images")
        pairs = load_truth(drive / "truth.csv", frames=(len(queries), None)).pairs.toarray()
        yield drive.name, queries, None, lambda query, match, pairs=pairs: pairs[query, match], pairs.any(axis=1).sum()


def candidates(name, model, features, queries, references, right, to_find):
    config = Config(method=name).with_settings({"decision.threshold": -1e9})
    detector = make_detector(config, model, features)
    if references is not None:
        detector.set_reference(references)
    passed = [d for d in detector.detect(queries) if d.accepted]
    scores = np.array([d.score for d in passed])
    return Candidates(scores, np.array([right(d.query, d.match) for d in passed], bool), to_find)


def choose(sets):
    scores, right = (np.concatenate([getattr(one, field) for one in sets]) for field in ("score", "right"))
    worst = scores[~right].max() if not right.all() else scores.min()
    return np.nextafter(worst, np.inf) + MARGIN * max(np.median(scores[right]) - worst, 0)


def outcome(one, threshold):
    accepted = one.score >= threshold
    return f"{(accepted & one.right).sum() / one.to_find:6.3f} {(accepted & ~one.right).sum():6d}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data_argument(parser)
    parser.add_argument("--methods", required=True)
    parser.add_argument("--drives", nargs="*", default=[])
    arguments = parser.parse_args()
    known = {}
    for name in arguments.methods.split(","):
        features = known.setdefault(kind_of(name), Remembered(make_detector(Config(method=name), None).method.features))
        with tempfile.TemporaryDirectory() as folder:
            model = fitted_before(name, arguments.data, features, Path(folder) / name)
            sets = {
                title: candidates(name, model, features, *one)
                for title, *one in traverses(arguments.data, arguments.drives)
            }
        together = choose(sets.values())
        print(f"\n{name}: {together:.4f} on all sets; recall and false loops, with it | with that of the other sets")
        for title, one in sets.items():
            left_out = choose([other for other in sets.values() if other is not one])
            print(f"{title:24} {outcome(one, together)} | {left_out:8.4f} {outcome(one, left_out)}", flush=True)


if __name__ == "__main__":
    main()
