"""Simulate a street drive among moving people and cars, find its loops, and measure them against the exact poses.

python examples/demo.py --out demo
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

import numpy as np

from loopclosure import Config
from loopclosure.cli.console import progress_bars
from loopclosure.evaluation import evaluate_run, load_truth
from loopclosure.images.simulator import SimulationSettings, simulate
from loopclosure.report import write_report
from loopclosure.runs import detect_loops


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("demo"), help="run folder; what it holds is replaced")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--covered", type=float, default=0.25, help="share of the view behind people and cars")
    options = parser.parse_args()
    drive = options.out / "drive"
    shutil.rmtree(drive, ignore_errors=True)  # of an earlier demo

    with progress_bars(quiet=not sys.stderr.isatty()) as progress:
        settings = SimulationSettings(frames=options.frames, covered=options.covered)
        simulate(drive, settings, progress=lambda done, total: progress("rendering the street", done, total))
        run = detect_loops(drive / "images", options.out, config=Config(), progress=progress)

    truth_file = drive / "truth.csv"
    metrics, curve = evaluate_run(options.out, truth_file, tolerance=0)
    (options.out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    truth = load_truth(truth_file, frames=(len(run.decisions), None), exclude_recent=settings.exclude_recent)
    poses = np.loadtxt(drive / "poses.csv", delimiter=",", skiprows=1)[:, 1:3]
    page = write_report(run, metrics=metrics, curve=curve, truth=truth, poses=poses, title="A simulated street drive")

    print(
        f"{metrics['accepted']} loops accepted in {metrics['rows']} frames; {metrics['rows_with_truth']} are revisits"
    )
    precision, recall = ("undefined" if metrics[k] is None else f"{metrics[k]:.3f}" for k in ("precision", "recall"))
    print(f"precision {precision}, recall {recall} at the shipped threshold")
    print(f"look at {page}")


if __name__ == "__main__":
    main()
