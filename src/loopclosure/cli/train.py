"""``loopclosure train siamese`` and ``loopclosure train netvlad``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from loopclosure.cli import app
from loopclosure.cli.console import print_json, say
from loopclosure.cli.options import Json, Quiet, configurable
from loopclosure.config import Config

if TYPE_CHECKING:
    from loopclosure.training.loop import Progress as TrainingCallback
    from loopclosure.training.loop import TrainingProgress

commands = typer.Typer(
    help="Train the backbone on pairs of images, or NetVLAD on a drive with poses.", no_args_is_help=True
)
app.add_typer(commands, name="train")

Out = Annotated[Path, typer.Option(help="Model folder to write; holds the checkpoints too.")]
Epochs = Annotated[int | None, typer.Option(help="training.epochs: passes over the training images.")]
FreezeUntil = Annotated[
    str | None, typer.Option(help="training.freeze_until: last layer that stays as it is, or 'nothing'.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint in --out.")]


@commands.command()
@configurable
def siamese(
    config: Config,
    data: Annotated[
        Path, typer.Argument(help="Folder of class folders, CSV file first,second,same, or a sequence (with --poses).")
    ],
    out: Out,
    poses: Annotated[Path | None, typer.Option(help="Poses of the sequence: frame,x,y[,z], TUM or KITTI.")] = None,
    epochs: Epochs = None,
    freeze_until: FreezeUntil = None,
    resume: Resume = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Train the backbone as a Siamese network: two branches, shared weights, contrastive loss.

    Examples:

      loopclosure train siamese places365/train --out model --backbone resnet152 --freeze-until conv4

      loopclosure train siamese pairs.csv --out model --epochs 5 --set training.distance=cosine

      loopclosure train siamese drive/images --poses drive/poses.csv --out model --resume
    """
    from loopclosure.training.siamese import train_siamese

    config = _with(config, epochs, freeze_until)
    with _bars(quiet=quiet or json) as progress:
        card = train_siamese(data, out, poses=poses, config=config, resume=resume, progress=progress)
    _tell(card, out, quiet=quiet, json=json)


@commands.command()
@configurable
def netvlad(
    config: Config,
    sequence: Annotated[Path, typer.Argument(help="Folder of images in order, or text file of paths.")],
    out: Out,
    poses: Annotated[Path, typer.Option(help="frame,x,y[,z], TUM or KITTI: one pose a frame.")],
    epochs: Epochs = None,
    freeze_until: FreezeUntil = None,
    resume: Resume = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Train the NetVLAD layer by the weakly supervised triplet ranking loss.

    Examples:

      loopclosure train netvlad drive/images --poses drive/poses.csv --out model

      loopclosure train netvlad drive/images --poses drive/poses.csv --out model --freeze-until s8
    """
    from loopclosure.training.netvlad import train_netvlad

    config = _with(config, epochs, freeze_until)
    with _bars(quiet=quiet or json) as progress:
        card = train_netvlad(sequence, out, poses=poses, config=config, resume=resume, progress=progress)
    _tell(card, out, quiet=quiet, json=json)


def _with(config: Config, epochs: int | None, freeze_until: str | None) -> Config:
    given = {"training.epochs": epochs, "training.freeze_until": freeze_until}
    return config.with_settings({name: value for name, value in given.items() if value is not None})


def _tell(card: dict[str, Any], out: Path, *, quiet: bool, json: bool) -> None:
    if json:
        print_json({"model": str(out), **card})
        return
    measures = ", ".join(
        f"{name} {_number(card['before'][name])} -> {_number(value)}"
        for name, value in card["after"].items()
        if name not in ("epoch", "train_loss")
    )
    say(f"held out, before -> after epoch {card['best_epoch']}: {measures}; the model is in {out}", quiet=quiet)


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.3f}"


@contextmanager
def _bars(*, quiet: bool) -> Iterator[TrainingCallback]:
    """Give a callable that draws the steps of the epoch, the loss and the held-out measures, if stderr is a screen."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[told]}"))
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bars:
        bar = bars.add_task("preparing", total=None, told="")

        def report(now: TrainingProgress) -> None:
            held_out = " ".join(f"{name} {_number(value)}" for name, value in now.measures.items() if name != "loss")
            bars.update(
                bar,
                description=f"epoch {now.epoch + 1} of {now.epochs}",
                completed=now.step,
                total=now.steps,
                told=f"loss {now.loss:.4f} {held_out}",
            )

        yield report
