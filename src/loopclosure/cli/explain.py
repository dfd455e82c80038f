"""``loopclosure explain``."""

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
def explain(
    config: Config,
    source: Annotated[list[Path], typer.Argument(help="Run folder, one image, or two images.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the pictures and explain.html.")],
    query: Annotated[
        int | None, typer.Option(help="Of a run: this frame and its best candidate (default: the best loops).")
    ] = None,
    pairs: Annotated[int, typer.Option(min=1, help="Of a run: so many loops at most, spread over the drive.")] = 4,
    model: Annotated[Path | None, typer.Option(help="Of images: what `fit` learned.")] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Show why two frames were alike: Grad-CAM heat maps of their descriptors, matches, clusters and the KL spectrum.

    A run brings its own settings and its own model; the settings below are for images.

    Examples:

      loopclosure explain run --out explained

      loopclosure explain run --query 215 --out explained

      loopclosure explain evening.jpg morning.jpg --model model --out explained
    """
    from loopclosure.report.explain import explain_images, explain_run

    if len(source) == 1 and source[0].is_dir():
        with progress_bars(quiet=quiet or json) as progress:
            done = explain_run(source[0], out, query=query, most=pairs, progress=progress)
    else:
        done = explain_images(source, out, config=config, model=model)
    if json:
        print_json({"page": str(done.page), "pictures": [str(file) for file in done.pictures]})
    else:
        say(f"{len(done.pictures)} pictures; look at {done.page}", quiet=quiet)
