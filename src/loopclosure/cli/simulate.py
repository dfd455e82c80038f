"""``loopclosure simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet, options_of
from loopclosure.images.simulator.settings import SimulationSettings


@app.command()
@options_of(SimulationSettings)
def simulate(
    settings: SimulationSettings,
    out: Annotated[Path, typer.Argument(help="Folder to write; must be empty or absent.")],
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Render a street drive with exact poses and truth: images/, poses.csv, truth.csv, covered.csv.

    Examples:

      loopclosure simulate drive --frames 300

      loopclosure simulate drive --covered 0.4 --light day --revisit-light night --lateral-offset-m 1.5
    """
    from loopclosure.images.simulator import simulate as write_drive

    with progress_bars(quiet=quiet or json) as progress:
        folder = write_drive(out, settings, progress=lambda done, total: progress("rendering", done, total))
    if json:
        print_json({"folder": str(folder), "frames": settings.frames})
    else:
        say(f"{settings.frames} frames in {folder / 'images'}, truth in {folder / 'truth.csv'}", quiet=quiet)
