"""``loopclosure methods`` and ``loopclosure weights``: what there is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from loopclosure import weights as table
from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet
from loopclosure.errors import WeightsError
from loopclosure.methods import METHODS, MethodEntry

if TYPE_CHECKING:
    from loopclosure.features.importing import ImportedWeights

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

      loopclosure weights import resnet152_places365.caffemodel
    """
    if context.invoked_subcommand is not None:
        return
    rows = [
        {
            "weights": entry.name,
            "MB": f"{entry.size_mb:.0f}",
            "here": _whether_here(entry),
            "licence": entry.licence,
            "source": entry.source,
        }
        for entry in table.all_weights()
    ]
    if json:
        print_json({row["weights"]: row for row in rows})
    else:
        _print_rows(rows)
        say(f"cache: {table.cache_folder()}")


@weights_app.command()
def fetch(
    name: Annotated[str, typer.Argument(help="Weights, or a network for its default weights.")],
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Download weights into the cache and check their hash.

    Example:

      loopclosure weights fetch resnet152-imagenet1k-v2
    """
    wanted = table.weights_for(name) if name in {entry.backbone for entry in table.WEIGHTS.values()} else name
    with progress_bars(quiet=quiet or json) as progress:
        path = table.fetch(wanted, progress=lambda done, total: progress(f"downloading {name}", done, total))
    if json:
        print_json({"weights": name, "file": str(path), "sha256": table.file_sha256(path)})
    else:
        say(f"{path}", quiet=quiet)


@weights_app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help=".pth, .pth.tar, .safetensors, .caffemodel, or .mat of a NetVLAD.")],
    name: Annotated[str | None, typer.Option(help="What --weights shall call it (default: the file's name).")] = None,
    backbone: Annotated[str | None, typer.Option(help="Its network (default: the one that fits).")] = None,
    licence: Annotated[str | None, typer.Option(help="Terms of the file, for the record.")] = None,
    out: Annotated[Path | None, typer.Option(help="Model folder for the clusters of a NetVLAD .mat.")] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Take weights from a file into the cache, checked tensor by tensor.

    Examples:

      loopclosure weights import resnet152_places365.caffemodel --licence "CC BY"

      loopclosure weights import Pitts30K_struct.mat --out pitts30k
    """
    from loopclosure.features.importing import import_weights

    if (file.suffix == ".mat") != (out is not None):
        raise WeightsError(f"--out MODEL is for the clusters of a NetVLAD .mat, and needed there; the file is {file}")
    if out is not None:
        from loopclosure.methods.published import import_netvlad

        imported = import_netvlad(file, out, name=name, backbone=backbone, licence=licence)
    else:
        imported = import_weights(file, name=name, backbone=backbone, licence=licence)
    if json:
        print_json(_import_row(imported) | {"model": None if out is None else str(out)})
    elif not quiet:
        rows = [(imported.taken, "taken"), (imported.left_out, "left out (classifier)")]
        _print_rows([{"part": part, "tensors": str(n), "": what} for parts, what in rows for part, n in parts.items()])
        say(f"--backbone {imported.weights.backbone} --weights {imported.weights.name}")
        if out is not None:
            say(f"--model {out}")


def _import_row(imported: ImportedWeights) -> dict[str, Any]:
    row = imported.weights
    return {
        "weights": row.name,
        "backbone": row.backbone,
        "variant": row.variant,
        "file": str(table.locate(row, download=False)),
        "sha256": row.sha256,
        "source": row.source,
        "source_sha256": imported.source_sha256,
        "licence": row.licence,
        "mean": row.mean,
        "std": row.std,
        "taken": imported.taken,
        "left_out": imported.left_out,
    }


def _whether_here(entry: table.Weights) -> str:
    if entry.package:
        return "installed"
    return "imported" if entry.path else "cached" if table.is_cached(entry) else "no"


def _print_rows(rows: list[dict[str, str]]) -> None:
    grid = Table(box=None, header_style="bold", pad_edge=False)
    for i, column in enumerate(rows[0]):
        grid.add_column(column, no_wrap=i == 0)
    for row in rows:
        grid.add_row(*row.values())
    Console().print(grid)
