"""``loopclosure compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet, configurable, parse_pair
from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.evaluation.tables import NanPoses
from loopclosure.evaluation.truth import View


@app.command()
@configurable
def compare(
    config: Config,
    context: typer.Context,
    source: Annotated[Path, typer.Argument(help="Folder of images, text file of paths, or video.")],
    truth: Annotated[Path, typer.Option(help="Truth: pairs or poses (.csv, .txt), .mat, .npy, or an image.")],
    out: Annotated[Path, typer.Option(help="Folder to write; each method's run folder is in it.")] = Path("compare"),
    methods: Annotated[str, typer.Option(help="Names with commas between them, or all.")] = "all",
    reference: Annotated[Path | None, typer.Option(help="Another traverse, that alone holds the candidates.")] = None,
    models: Annotated[
        list[str] | None,
        typer.Option("--model", metavar="METHOD=MODEL", help="Model that `fit` wrote for a method; may be repeated."),
    ] = None,
    tolerance: Annotated[int, typer.Option(min=0, help="A match so many frames from a true one is right.")] = 0,
    view: Annotated[View, typer.Option(help="Truth of one camera of an interleaved stereo set.")] = "all",
    key: Annotated[str | None, typer.Option(help="Name of the matrix in a .mat file.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Truth by poses: same place, metres.")] = None,
    nan_poses: Annotated[NanPoses, typer.Option(help="Frames without a position: refuse, or leave out.")] = "error",
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run several methods on the same images: accuracy and ms an image in one table (compare.csv, compare.html).

    --backbone and --weights are for every method that runs on feature maps. Without them each has its own network;
    where its weights are not to be had, the embedded one stands in, and the table says so. --weights METHOD=WEIGHTS,
    with commas between several, is for these methods alone.

    Examples:

      loopclosure compare drive/images --truth drive/truth.csv --methods kl-netvlad,seqslam,cnn --out compare

      loopclosure compare evening/ --reference morning/ --truth pairs.csv --methods all --tolerance 2

      loopclosure compare drive/ --truth drive.csv --methods bow,fabmap --model bow=words --model fabmap=places

      loopclosure compare drive/ --truth drive.csv --methods cnn,faster-rcnn --weights faster-rcnn=random
    """
    from loopclosure.evaluation.compare import compare_methods
    from loopclosure.report.comparison import HEADS, protocol_line, record, shown_rows, write_comparison

    if context.params["method"] is not None:
        raise ConfigError("--method is for a command that runs one; here it is --methods a,b,c")
    weights = _by_method(context.params["weights"] or "")
    if weights:
        config = config.with_settings({"features.weights": "default"})
    wants = "METHOD=MODEL, such as --model bow=words"
    with progress_bars(quiet=quiet or json) as progress:
        comparison = compare_methods(
            source,
            truth,
            out,
            methods=methods,
            reference=reference,
            config=config,
            backbone=context.params["backbone"],
            weights=weights,
            models=dict(parse_pair(pair, flag="--model", wants=wants) for pair in models or ()),
            tolerance=tolerance,
            truth_settings={"view": view, "key": key, "radius_m": radius, "nan_poses": nan_poses},
            progress=progress,
        )
        out.mkdir(parents=True, exist_ok=True)
        page = write_comparison(comparison, out)
    if json:
        numbers = [record(result) for result in comparison.results]
        rules = {"protocol": comparison.protocol, "machine": comparison.machine}
        print_json({"methods": numbers, **rules, "page": str(page)})
    else:
        rows = shown_rows(comparison.results)
        width = max(len(row.method) for row in rows)
        say(" " * width + "".join(f"{head:>11}" for head in HEADS), quiet=quiet)
        for row in rows:
            cells = "".join(f"{cell.text:>11}" for cell in row.cells) or "  not run"
            say(f"{row.method:<{width}}{cells}  {', '.join(row.marks)}".rstrip(), quiet=quiet)
        for name, note in ((row.method, row.note) for row in rows if row.note):
            say(f"{name}: {note}", quiet=quiet)
        say(f"protocol: {protocol_line(comparison.protocol)}", quiet=quiet)
        say(f"machine: {comparison.machine}", quiet=quiet)
        say(f"look at {page}", quiet=quiet)
    if not any(result.metrics for result in comparison.results):
        raise typer.Exit(1)


def _by_method(weights: str) -> dict[str, str]:
    """Take METHOD=WEIGHTS,METHOD=WEIGHTS apart; empty where they are for all methods."""
    if "=" not in weights or Path(weights).is_file():
        return {}
    wants = "METHOD=WEIGHTS, such as --weights faster-rcnn=random"
    return dict(parse_pair(part, flag="--weights", wants=wants) for part in weights.split(","))
