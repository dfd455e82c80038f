"""Epochs of gradient descent: schedule, early stop, checkpoints, resuming.

An epoch is one or more rounds. A round begins with the choice of what is learned in it, by the weights as they are and
by numbers drawn from seed and epoch alone; then come its steps. Checkpoints fall between rounds. So a training that was
killed and resumed makes the same steps as one that was not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch

from loopclosure.config import Training
from loopclosure.errors import FitError, ModelError
from loopclosure.training.board import open_board
from loopclosure.training.checkpoint import expect, load_checkpoint, save_checkpoint

Measures = dict[str, float | None]


@dataclass(frozen=True)
class TrainingProgress:
    """How far a training is.

    Attributes
    ----------
    epoch, epochs : int
        Epochs done, and in all.
    step, steps : int
        Steps done in this round, and in it at all.
    loss : float
        Of the last step.
    measures : dict
        On held-out places, after the last epoch.
    """

    epoch: int
    epochs: int
    step: int
    steps: int
    loss: float
    measures: Measures


Progress = Callable[[TrainingProgress], None]


class Task(Protocol):
    """What is trained."""

    @property
    def parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """What learns, by name."""

    @property
    def rounds(self) -> int:
        """Rounds in an epoch."""

    def plan(self, epoch: int, part: int) -> Sequence[Any]:
        """Choose the batches of one round."""

    def loss(self, batch: Any) -> torch.Tensor:
        """Return the loss of one batch."""

    def validate(self) -> Measures:
        """Measure on held-out places."""

    def error(self, measures: Mapping[str, Any]) -> float:
        """Return what `validate` measured as one number; the least one is the best."""


@dataclass
class Run:
    """What a training came to, and all that resuming needs beside the tensors.

    Attributes
    ----------
    rounds : int
        Rounds done.
    history : list of dict
        Before training and after each epoch: the epoch, its mean training loss (``train_loss``), the measures.
    best_epoch : int
        Epoch of the least held-out error; its parameters are the result.
    sum_of_losses, steps : float, int
        Of the epoch that has begun.
    """

    rounds: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)
    best_epoch: int = 0
    sum_of_losses: float = 0.0
    steps: int = 0

    @property
    def best(self) -> dict[str, Any]:
        """The measures of the best epoch."""
        return self.history[self.best_epoch]


def run_training(
    task: Task,
    folder: Path,
    training: Training,
    *,
    optimizer: torch.optim.Optimizer,
    made_from: Mapping[str, Any],
    resume: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Train, and leave in the task the parameters of the epoch with the least held-out error.

    Parameters
    ----------
    task : Task
    folder : pathlib.Path
        For checkpoints and the TensorBoard log.
    training : Training
        Epochs, schedule, early stop.
    optimizer : torch.optim.Optimizer
        Of the parameters of `task`, in their order, with the learning rate of the first epochs.
    made_from : mapping
        Everything that decides the numbers; a checkpoint made from anything else is refused.
    resume : bool
        Go on from the last checkpoint in `folder`.
    progress : callable, optional
        Told after each step.

    Raises
    ------
    FitError
        If a loss is not finite; the last checkpoint stays.
    ModelError
        If there is a checkpoint and `resume` is false, or there is none, or it is damaged or of another training.
    """
    expect(folder, resume=resume)
    parameters, learning_rate = task.parameters, optimizer.defaults["lr"]
    if resume:
        run, best = _resumed(folder, parameters, optimizer, made_from)
    else:
        run = Run(history=[{"epoch": 0, "train_loss": None, **task.validate()}])
        best = _copied(parameters)
        _save(folder, run, parameters, best, optimizer, made_from)
    with open_board(folder) as board:
        while run.rounds < training.epochs * task.rounds and not _stale(run, training.patience):
            epoch, part = divmod(run.rounds, task.rounds)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * halved(epoch, training.halve_every)
            losses = _steps(task, task.plan(epoch, part), optimizer, run, training.epochs, epoch, progress)
            _check_finite(parameters, folder, epoch)
            run.rounds += 1
            if run.rounds % task.rounds == 0 and _epoch_done(task, run):
                best = _copied(parameters)
            _save(folder, run, parameters, best, optimizer, made_from)
            board(epoch, losses, run.history[-1])
    _put_back(parameters, best)
    return run


def halved(epoch: int, every: int) -> float:
    """Return the share of the learning rate that is left in an epoch, counted from 0.

    Examples
    --------
    >>> [halved(epoch, 5) for epoch in (0, 4, 5, 10)]
    [1.0, 1.0, 0.5, 0.25]
    """
    return 0.5 ** (epoch // every) if every else 1.0


def _steps(
    task: Task,
    batches: Sequence[Any],
    optimizer: torch.optim.Optimizer,
    run: Run,
    epochs: int,
    epoch: int,
    progress: Progress | None,
) -> list[float]:
    losses = []
    for step, batch in enumerate(batches, start=1):
        loss = task.loss(batch)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FitError(
                f"the loss is {value} in epoch {epoch + 1}, step {step}: is training.learning_rate too large? "
                "The last checkpoint was kept"
            )
        optimizer.zero_grad()
        if loss.requires_grad:
            loss.backward()
            optimizer.step()
        losses.append(value)
        run.sum_of_losses, run.steps = run.sum_of_losses + value, run.steps + 1
        if progress:
            measures = {name: item for name, item in run.history[-1].items() if name not in ("epoch", "train_loss")}
            progress(TrainingProgress(epoch, epochs, step, len(batches), value, measures))
    return losses


def _epoch_done(task: Task, run: Run) -> bool:
    """Measure and note an epoch; return whether it is the best so far."""
    mean = run.sum_of_losses / run.steps if run.steps else 0.0
    run.sum_of_losses, run.steps = 0.0, 0
    before = task.error(run.best)
    run.history.append({"epoch": len(run.history), "train_loss": mean, **task.validate()})
    if not task.error(run.history[-1]) < before:
        return False
    run.best_epoch = len(run.history) - 1
    return True


def _stale(run: Run, patience: int) -> bool:
    return bool(patience) and len(run.history) - 1 - run.best_epoch >= patience


def _check_finite(parameters: Mapping[str, torch.nn.Parameter], folder: Path, epoch: int) -> None:
    for name, value in parameters.items():
        if not torch.isfinite(value).all():
            raise FitError(
                f"'{name}' is no longer finite after epoch {epoch + 1}: is training.learning_rate too large? "
                f"The last checkpoint in {folder} was kept"
            )


def _copied(parameters: Mapping[str, torch.nn.Parameter]) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in parameters.items()}


def _put_back(parameters: Mapping[str, torch.nn.Parameter], tensors: Mapping[str, torch.Tensor]) -> None:
    with torch.no_grad():
        for name, value in parameters.items():
            value.copy_(tensors[name])


def _save(
    folder: Path,
    run: Run,
    parameters: Mapping[str, torch.nn.Parameter],
    best: Mapping[str, torch.Tensor],
    optimizer: torch.optim.Optimizer,
    made_from: Mapping[str, Any],
) -> None:
    tensors = {f"now.{name}": value for name, value in parameters.items()}
    tensors |= {f"best.{name}": value for name, value in best.items()}
    for number, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{number}.{key}": value for key, value in state.items() if value is not None}
    save_checkpoint(folder, {"run": asdict(run), "made_from": dict(made_from)}, tensors)


def _resumed(
    folder: Path,
    parameters: Mapping[str, torch.nn.Parameter],
    optimizer: torch.optim.Optimizer,
    made_from: Mapping[str, Any],
) -> tuple[Run, dict[str, torch.Tensor]]:
    header, tensors = load_checkpoint(folder)
    for name, value in _differences(header["made_from"], made_from):
        raise ModelError(
            f"the checkpoint in {folder} was made with {name} = {value}, here it is {made_from.get(name)}; "
            "resume with the same, or begin in another folder"
        )
    _put_back(parameters, {name: tensors[f"now.{name}"] for name in parameters})
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name in tensors:
        if name.startswith("optimizer."):
            _, number, key = name.split(".")
            state.setdefault(int(number), {})[key] = tensors[name]
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    best = {name: tensors[f"best.{name}"].to(value.device) for name, value in parameters.items()}
    return Run(**header["run"]), best


def _differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    return ((name, found.get(name)) for name in [*found, *wanted] if found.get(name) != wanted.get(name))
