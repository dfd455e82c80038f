"""The default on simulated drives that the odds of a loop were not fitted on, with loops and without.

    python benchmarks/new_drives.py [--with-loops 9] [--without 10] [--frames 1000]

Those with loops have 300 frames, and 40 % of the view is covered; those without have `--frames`, and 0 to 40 %. Printed
for each: its light, the covered share, best candidates that are right (within 2 frames), recall at 100 % precision,
recall of what is accepted, false loops, and the largest probability that a wrong candidate was given.
"""

import argparse

import numpy as np
from ablation import figures
from calibration import drive

from loopclosure import Config

LIGHTS = "day", "dusk", "night"
COVERED = 0.0, 0.1, 0.2, 0.3, 0.4
FIRST_WITHOUT, FIRST_WITH = 50, 70


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--with-loops", type=int, default=9)
    parser.add_argument("--without", type=int, default=10)
    parser.add_argument("--frames", type=int, default=1000)
    args = parser.parse_args()
    settings = [
        {"seed": FIRST_WITH + i, "light": LIGHTS[i % 3], "revisit_light": LIGHTS[i % 3], "covered": 0.4}
        for i in range(args.with_loops)
    ]
    settings += [
        {
            "seed": FIRST_WITHOUT + i,
            "light": LIGHTS[i % 3],
            "covered": COVERED[i % 5],
            "frames": args.frames,
            "revisit": False,
        }
        for i in range(args.without)
    ]
    rows = []
    print("seed  light  covered   top-1  R@100P  recall   false  worst")
    for one in settings:
        *row, worst = figures(Config(), *drive(one))
        rows.append(row)
        print(f"{one['seed']:4}  {one['light']:5}  {one['covered']:7.1f}", *(f"{value:7.3f}" for value in row), end="")
        print(f"  {worst:.4f}", flush=True)
    *means, _ = np.nanmean(rows, axis=0)
    print(
        "mean of those with loops", *(f"{value:.3f}" for value in means), f"; {np.sum(rows, axis=0)[3]:.0f} false loops"
    )


if __name__ == "__main__":
    main()
