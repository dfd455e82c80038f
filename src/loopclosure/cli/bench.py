"""``loopclosure bench``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet, configurable
from loopclosure.config import Config


@app.command()
@configurable
def bench(
    config: Config,
    images: Annotated[
        Path | None, typer.Option(help="Folder of images or text file of paths; simulated ones if there is none.")
    ] = None,
    frames: Annotated[int, typer.Option(min=2, help="Images of one round.")] = 16,
    rounds: Annotated[int, typer.Option(min=1, help="How often everything is measured.")] = 5,
    table7: Annotated[bool, typer.Option("--table7", help="Also the methods of the paper's Table 7.")] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Measure each stage, the ratio to plain torchvision, the share of this machine's matrix-multiply limit.

    Weights that are not on this machine are replaced by random ones, which are as fast.

    Examples:

      loopclosure bench

      loopclosure bench --preset paper --rounds 9 --json

      loopclosure bench --preset paper --table7 --images drive/images
    """
    from loopclosure.evaluation.speed import measure_speed

    with progress_bars(quiet=quiet or json) as progress:
        result = measure_speed(config, images=images, frames=frames, rounds=rounds, table7=table7, progress=progress)
    if json:
        print_json(result)
    else:
        say(_page(result))


def _page(result: dict[str, Any]) -> str:
    pipelines, faster = result["pipelines_ms"], result["times_faster_than_eager"]
    share, limit = 100 * result["share_of_matmul_limit"], result["matmul_gflops"]
    lines = [
        f"{result['machine']}; load average {result['load_average']}",
        f"{result['network']}, weights {result['weights']}, {result['runtime']} {result['precision']}, "
        f"{result['image']} pixels, medians of {result['rounds']} rounds",
        "",
        "ms an image, one at a time",
        *(f"  {name:<20}{spent:9.3f}" for name, spent in result["stages_ms"].items()),
        "",
        "ms an image, from file to decision",
        *(f"  {name:<20}{spent:9.2f}{_times(faster.get(name))}" for name, spent in pipelines.items()),
        "",
        f"backbone, batches of 8: {share:.0f} % of the {limit:.0f} GFLOP/s of matrix multiplication",
    ]
    if "table7" in result:
        lines += ["", "Table 7                           ms an image     paper"]
        lines += [_row(row) for row in result["table7"]]
    return "\n".join(lines)


def _times(ratio: float | None) -> str:
    return "" if ratio is None else f"   {ratio:.1f} x as fast as eager"


def _row(row: dict[str, Any]) -> str:
    here = "-" if row["ms"] is None else f"{row['ms']:.2f}"
    note = row.get("note") or (row["weights"] if "random" in str(row.get("weights")) else "")
    return f"  {row['title']:<32}{here:>11}{row['paper_ms']:>10.2f}  {note}".rstrip()
