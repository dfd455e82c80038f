"""``loopclosure methods`` and ``loopclosure weights``: what there is."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from loopclosure import weights as table
from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet
from loopclosure.methods import METHODS, MethodEntry

weights_app = typer.Typer()
app.add_typer(weights_app, name="weights")


@app.command()
def methods(json: Json = False) -> None:
    """List the methods that `detect --method` runs.

    Example:

      loopclosure methods
    """
    rows = {name: _method_row(entry) for name, entry in METHODS.items()}
    if json:
        print_json(rows)
        return
    for name, row in rows.items():
        say(name)
        for fact, value in row.items():
            if value is not None:
                say(f"  {fact:<12}{value}")


def _method_row(entry: MethodEntry) -> dict[str, str | int | None]:
    return {
        "what": entry.summary,
        "learns": entry.learns,
        "numbers": entry.numbers,
        "weights": entry.weights or None,
        "licence": table.WEIGHTS[entry.weights].licence if entry.weights else None,
        "source": entry.source,
    }


@weights_app.callback(invoke_without_command=True)
def weights(context: typer.Context, json: Json = False) -> None:
    """List the pretrained weights: where they come from, their licence, and what is cached.

    Examples:

      loopclosure weights

      loopclosure weights fetch resnet152-imagenet1k-v2
    """
    if context.invoked_subcommand is not None:
        return
    rows = [
        {
            "weights": entry.name,
            "MB": f"{entry.size_mb:.0f}",
            "here": "installed" if entry.package else "cached" if table.is_cached(entry.name) else "no",
            "licence": entry.licence,
            "source": entry.source,
        }
        for entry in table.WEIGHTS.values()
    ]
    if json:
        print_json({row["weights"]: row for row in rows})
    else:
        _print_rows(rows)
        say(f"cache: {table.cache_folder()}")


@weights_app.command()
def fetch(
    name: Annotated[str, typer.Argument(help="Weights, or a network for its default weights.")], quiet: Quiet = False
) -> None:
    """Download weights into the cache and check their hash.

    Example:

      loopclosure weights fetch resnet152-imagenet1k-v2
    """
    wanted = table.weights_for(name) if name in {entry.backbone for entry in table.WEIGHTS.values()} else name
    with progress_bars(quiet=quiet) as progress:
        path = table.fetch(wanted, progress=lambda done, total: progress(f"downloading {name}", done, total))
    say(f"{path}", quiet=quiet)


def _print_rows(rows: list[dict[str, str]]) -> None:
    grid = Table(box=None, header_style="bold", pad_edge=False)
    for i, column in enumerate(rows[0]):
        grid.add_column(column, no_wrap=i == 0)
    for row in rows:
        grid.add_row(*row.values())
    Console().print(grid)
