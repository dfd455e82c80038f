"""``loopclosure datasets``: what data sets are known, what of them is here."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet

datasets_app = typer.Typer(help="List the data sets, fetch them, or check a copy.")
app.add_typer(datasets_app, name="datasets")

Name = Annotated[str, typer.Argument(help="A data set; `loopclosure datasets` lists them.")]
Folder = Annotated[Path | None, typer.Option(help="Its folder (default: in the cache).")]
Sequences = Annotated[list[str] | None, typer.Option("--sequence", help="Only this sequence; may be repeated.")]


@datasets_app.callback(invoke_without_command=True)
def datasets(context: typer.Context, json: Json = False) -> None:
    """List the data sets: how large they are, their licence, where they come from, and what is in the cache.

    Examples:

      loopclosure datasets

      loopclosure datasets fetch gardens-point

      loopclosure datasets check kitti --folder ~/kitti --sequence 00
    """
    from loopclosure.images.datasets import DATASETS, check_dataset, datasets_folder

    if context.invoked_subcommand is not None:
        return
    rows = {}
    for name, dataset in DATASETS.items():
        here = [found.ok for found in check_dataset(name, hashes=False)] if dataset.page else [False]
        rows[name] = {
            "title": dataset.title,
            "frames": dataset.extent,
            "here": "whole" if all(here) else "in part" if any(here) else "no",
            "licence": dataset.licence,
            "source": ", ".join(filter(None, (dataset.citation, dataset.page))),
        }
    if json:
        print_json(rows)
        return
    for name, row in rows.items():
        say(name)
        for what, text in row.items():
            say(f"  {what:<9}{text}")
    say(f"cache: {datasets_folder()}")


@datasets_app.command()
def fetch(
    name: Name, folder: Folder = None, sequence: Sequences = None, quiet: Quiet = False, json: Json = False
) -> None:
    """Download and unpack what is missing; an interrupted download goes on where it stopped.

    Example:

      loopclosure datasets fetch new-college --folder ~/new-college
    """
    from loopclosure.images.datasets import fetch_dataset

    with progress_bars(quiet=quiet or json) as progress:
        path = fetch_dataset(name, folder, sequences=sequence, progress=progress)
    if json:
        print_json({"data set": name, "folder": str(path)})
    else:
        say(str(path), quiet=quiet)


@datasets_app.command()
def check(
    name: Name, folder: Folder = None, sequence: Sequences = None, quiet: Quiet = False, json: Json = False
) -> None:
    """Say what is there, what is missing and where to get it; exit status 1 unless everything is right.

    Example:

      loopclosure datasets check city-centre --folder ~/city-centre
    """
    from loopclosure.images.datasets import check_dataset

    with progress_bars(quiet=quiet or json) as progress:
        findings = check_dataset(name, folder, sequences=sequence, progress=progress)
    whole = all(found.ok for found in findings)
    if json:
        rows = [asdict(found) | {"path": found.path and str(found.path)} for found in findings]
        print_json({"data set": name, "whole": whole, "parts": rows})
    else:
        for found in findings:
            say(f"{found.part}: {found.path if found.ok else found.state}", quiet=quiet)
    if not whole:
        raise typer.Exit(1)
