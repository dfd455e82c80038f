"""``loopclosure fit``."""

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
def fit(
    config: Config,
    images: Annotated[Path, typer.Argument(help="Folder of images, text file of paths, or video.")],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Learn the KL basis and the NetVLAD clusters, for `detect --model`.

    Examples:

      loopclosure fit drives/all/ --out model

      loopclosure fit drives/all/ --out model --backbone resnet152 --gamma 0.9 --set learning.fit_frames=2000
    """
    from loopclosure.runs import fit_model

    with progress_bars(quiet=quiet or json) as progress:
        detector = fit_model(images, out, config=config, progress=progress)
    if json:
        print_json({"model": str(out), "learned_on": detector.learned_on, **detector.method.provenance})
    else:
        say(f"learned on {detector.learned_on[0]}; the model is in {out}", quiet=quiet)
