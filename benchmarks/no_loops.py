"""Loops that the default accepts where there are none: ten simulated drives that no place of is seen twice.

    python benchmarks/no_loops.py [--frames 1000] [--drives 10]

None of these drives was used to fit the odds. Printed for each: its light, the covered share of the view, accepted
loops, and the largest probability that a candidate was given.
"""

import argparse

from loopclosure import LoopDetector
from loopclosure.images.simulator import Drive, SimulationSettings

LIGHTS = "day", "dusk", "night"
COVERED = 0.0, 0.1, 0.2, 0.3, 0.4
FIRST_SEED = 50


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--drives", type=int, default=10)
    args = parser.parse_args()
    accepted = 0
    print("seed  light  covered  accepted  largest probability")
    for number in range(args.drives):
        light, covered = LIGHTS[number % len(LIGHTS)], COVERED[number % len(COVERED)]
        settings = SimulationSettings(
            frames=args.frames, seed=FIRST_SEED + number, revisit=False, light=light, covered=covered
        )
        decisions = list(LoopDetector().detect(frame.image for frame in Drive(settings)))
        loops = sum(one.accepted for one in decisions)
        accepted += loops
        best = max((one.score for one in decisions if one.score is not None), default=0.0)
        print(f"{FIRST_SEED + number:4}  {light:5}  {covered:7.1f}  {loops:8}  {best:.4f}", flush=True)
    print(f"{accepted} loops accepted in {args.drives} drives of {args.frames} frames")


if __name__ == "__main__":
    main()
