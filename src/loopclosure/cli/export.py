"""``loopclosure export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet


@app.command()
def export(
    model: Annotated[Path, typer.Argument(help="What `fit` or `train` wrote, or the folder `model` of a run.")],
    out: Annotated[Path, typer.Option(help="Bundle folder to write.")],
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Write a model together with its network, for `detect --model` where torch is not installed.

    The network is written in OpenVINO's format and as ONNX; both must describe images as torch does.

    Examples:

      loopclosure export model --out bundle

      loopclosure detect drive/images --model bundle --out run
    """
    from loopclosure.bundle import export_model

    with progress_bars(quiet=quiet or json) as progress:
        result = export_model(model, out, progress=lambda done, total: progress("downloading weights", done, total))
    if json:
        print_json(result)
    else:
        agreement = ", ".join(f"{cosine:.5f} by {runtime}" for runtime, cosine in result["cosines"].items())
        say(f"descriptors agree with torch to a cosine of {agreement}; the bundle is in {out}", quiet=quiet)
