"""``loopclosure detect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet, configurable
from loopclosure.config import Config


@app.command()
@configurable
def detect(
    config: Config,
    source: Annotated[Path, typer.Argument(help="Folder of images, text file of paths, or video.")],
    out: Annotated[Path, typer.Option(help="Run folder to write.")] = Path("run"),
    reference: Annotated[
        Path | None, typer.Option(help="Another traverse, or a saved detector, that alone holds the candidates.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="What `fit` learned.")] = None,
    save_scores: Annotated[bool, typer.Option("--save-scores", help="Also write scores.npy.")] = False,
    save_detector: Annotated[
        Path | None, typer.Option(help="Folder for the detector and its map, for a later --reference.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run in OUT that was interrupted, by Ctrl-C too.")
    ] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Find the loops of a sequence and write loops.csv, run.json and report.html.

    Examples:

      loopclosure detect drive/images --out run

      loopclosure detect evening/ --reference morning/ --out run --save-scores

      loopclosure detect drive.mp4 --sequence-length 5 --threshold 0.62

      loopclosure detect drive/images --out run --resume
    """
    from loopclosure.report import write_report
    from loopclosure.runs import detect_loops, summarise

    with progress_bars(quiet=quiet or json) as progress:
        run = detect_loops(
            source,
            out,
            reference=reference,
            config=config,
            model=model,
            save_scores=save_scores,
            save_detector=save_detector,
            resume=resume,
            progress=progress,
        )
        page = write_report(run)
    summary = summarise(run)
    if json:
        print_json(summary)
    else:
        say(f"{summary['accepted']} loops accepted in {summary['frames']} frames; look at {page}", quiet=quiet)
