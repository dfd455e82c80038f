"""``loopclosure evaluate``."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, say
from loopclosure.cli.options import Json, Quiet
from loopclosure.evaluation.protocol import Level
from loopclosure.evaluation.tables import NanPoses
from loopclosure.evaluation.truth import View


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder, or a CSV file with query, match, score.")],
    truth: Annotated[Path, typer.Option(help="Truth: pairs or poses (.csv, .txt), .mat, .npy, or an image.")],
    tolerance: Annotated[int, typer.Option(help="A match so many frames from a true one is right.")] = 0,
    view: Annotated[View, typer.Option(help="One camera of an interleaved stereo set.")] = "all",
    key: Annotated[str | None, typer.Option(help="Name of the matrix in a .mat file.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Truth by poses: same place, metres.")] = None,
    exclude_recent: Annotated[
        int | None, typer.Option(help="Frames nearer than this are no pairs (default: as in the run).")
    ] = None,
    references: Annotated[int | None, typer.Option(help="Frames of the reference traverse, for a CSV file.")] = None,
    nan_poses: Annotated[NanPoses, typer.Option(help="Frames without a position: refuse, or leave out.")] = "error",
    level: Annotated[Level, typer.Option(help="row: a frame counts once; pair: every true pair counts.")] = "row",
    out: Annotated[Path | None, typer.Option(help="Where to write (default: the run folder).")] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Score a run against truth and write metrics.json and precision_recall.png.

    Examples:

      loopclosure evaluate run --truth drive/truth.csv

      loopclosure evaluate run --truth NewCollegeGroundTruth.mat --view left --tolerance 2

      loopclosure evaluate loops.csv --truth poses.txt --radius 4 --exclude-recent 50 --json
    """
    from loopclosure.evaluation import evaluate_run
    from loopclosure.report import png, precision_recall
    from loopclosure.runs import write_whole

    metrics, curve = evaluate_run(
        run,
        truth,
        tolerance=tolerance,
        view=view,
        key=key,
        radius_m=radius,
        exclude_recent=exclude_recent,
        references=references,
        nan_poses=nan_poses,
        level=level,
    )
    folder = out or (run if run.is_dir() else run.parent)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "metrics.json", jsonlib.dumps(metrics, indent=2) + "\n")
    (folder / "precision_recall.png").write_bytes(png(precision_recall({run.name: curve})))
    if json:
        print_json(metrics)
        return
    for name, value in metrics.items():
        if name != "protocol":
            say(f"{name:<34}{_shown(value)}", quiet=quiet)
    say("protocol: " + ", ".join(f"{name} {value}" for name, value in metrics["protocol"].items()), quiet=quiet)


def _shown(value: object) -> str:
    if value is None:
        return "undefined"
    if isinstance(value, (list, tuple)):
        return " to ".join(map(_shown, value))
    return f"{value:.4f}" if isinstance(value, float) else str(value)
