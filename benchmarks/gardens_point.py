"""Top-1 on Gardens Point, day: right side against left side, and both joined as one online stream.

    python benchmarks/gardens_point.py [--data FOLDER]

FOLDER holds `gardens_point/day_left` and `gardens_point/day_right`. Both figures count the frames that have a full
sequence behind them; a match is right within 2 frames. The joined stream is two traverses one after the other, fed to
`LoopDetector.add` one frame at a time.
"""

import argparse
import os
from pathlib import Path

import numpy as np

from loopclosure import Config, ImageSequence, LoopDetector

TOLERANCE = 2


def top1(decisions, offset, length):
    """Share of the frames with a full sequence behind them, from `offset` on, whose best candidate is right."""
    counted = [d for d in decisions if d.query >= offset + length - 1]
    right = [d.match is not None and abs(d.match - (d.query - offset)) <= TOLERANCE for d in counted]
    return float(np.mean(right)), len(counted)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("LOOPCLOSURE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(default))
    folder = parser.parse_args().data / "gardens_point"
    left, right = ImageSequence(folder / "day_left"), ImageSequence(folder / "day_right")
    length = Config().sequence.length

    detector = LoopDetector()
    detector.set_reference(left)
    share, frames = top1(list(detector.detect(right)), 0, length)
    print(f"day_right against day_left: top-1 within {TOLERANCE} frames {share:.3f} of {frames} frames (wanted 0.95)")

    detector = LoopDetector()
    decisions = [detector.add(image) for traverse in (left, right) for image in traverse]
    share, frames = top1(decisions, len(left), length)
    print(f"day_left + day_right, online: top-1 within {TOLERANCE} frames {share:.3f} of {frames} frames (wanted 0.90)")


if __name__ == "__main__":
    main()
