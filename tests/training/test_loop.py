"""The loop on a task of two numbers: schedule, early stop, best epoch, checkpoints, resuming, what goes wrong."""

from __future__ import annotations

import logging
import sys

import numpy as np
import pytest
import torch

from loopclosure.config import Training
from loopclosure.errors import FitError, ModelError
from loopclosure.training.checkpoint import BEFORE, CHECKPOINT, load_checkpoint, save_checkpoint
from loopclosure.training.loop import halved, run_training


class Line:
    """Fit a line to points that are drawn for each round; the plan also depends on the weights, as mining does."""

    rounds = 2

    def __init__(self, held_out=None):
        self.parameters = {"slope": torch.nn.Parameter(torch.zeros(1)), "offset": torch.nn.Parameter(torch.ones(1))}
        self.held_out = held_out
        self.break_at = None
        self.steps = 0

    def plan(self, epoch, part):
        rng = np.random.default_rng((7, epoch, part))
        hardness = 1 + 0.1 * abs(float(self.parameters["slope"].detach()))
        return [torch.tensor(hardness * rng.normal(size=4), dtype=torch.float32) for _ in range(3)]

    def loss(self, batch):
        self.steps += 1
        if self.steps == self.break_at:
            return batch.sum() * self.parameters["slope"].sum() * float("nan")
        found = self.parameters["slope"] * batch + self.parameters["offset"]
        return ((found - 2 * batch) ** 2).mean()

    def error(self, measures):
        return measures["loss"]

    def validate(self):
        if self.held_out:
            return {"loss": self.held_out.pop(0)}
        return {"loss": abs(float(self.parameters["slope"].detach()) - 2)}


def sgd(task, training):
    decay = training.weight_decay
    return torch.optim.SGD(task.parameters.values(), lr=0.05, momentum=training.momentum, weight_decay=decay)


def adamw(task, training):
    return torch.optim.AdamW(task.parameters.values(), lr=0.05, weight_decay=training.weight_decay)


def trained(folder, task=None, **more):
    task = task or Line()
    training = Training(**{"epochs": 4, "patience": 0, **more.pop("settings", {})})
    optimizer = more.pop("optimizer", sgd)(task, training)
    run = run_training(task, folder, training, optimizer=optimizer, made_from={"seed": 7}, **more)
    return run, {name: float(value.detach()) for name, value in task.parameters.items()}


class StoppedError(Exception):
    pass


def stop_at(step):
    seen = iter(range(1, 1000))

    def progress(_):
        if next(seen) == step:
            raise StoppedError

    return progress


def test_it_learns(tmp_path):
    run, values = trained(tmp_path, settings={"epochs": 20})
    assert values["slope"] == pytest.approx(2, abs=0.05)
    assert len(run.history) == 21
    assert run.history[-1]["train_loss"] < 0.1 * run.history[1]["train_loss"]


@pytest.mark.parametrize("step", [1, 3, 4, 7, 11, 17, 24])
@pytest.mark.parametrize("optimizer", [sgd, adamw])
def test_interrupted_anywhere_and_resumed_is_the_same(tmp_path, step, optimizer):
    whole, values = trained(tmp_path / "whole", optimizer=optimizer)
    with pytest.raises(StoppedError):
        trained(tmp_path / "cut", progress=stop_at(step), optimizer=optimizer)
    resumed, same_values = trained(tmp_path / "cut", resume=True, optimizer=optimizer)
    assert resumed == whole
    assert same_values == values


def test_steps_are_those_of_sgd_with_momentum_and_decay_at_a_halved_rate(tmp_path):
    settings = {"epochs": 3, "halve_every": 1, "momentum": 0.5, "weight_decay": 0.1}
    task = Line(held_out=[9.0, 8.0, 7.0, 6.0])
    _, values = trained(tmp_path, task, settings=settings)
    slope, offset, speed = 0.0, 1.0, np.zeros(2)
    for epoch in range(3):
        for part in range(2):
            rng, hardness = np.random.default_rng((7, epoch, part)), 1 + 0.1 * abs(slope)
            for x in [hardness * rng.normal(size=4) for _ in range(3)]:
                error = slope * x + offset - 2 * x
                gradient = np.array([(2 * error * x).mean(), (2 * error).mean()]) + 0.1 * np.array([slope, offset])
                speed = 0.5 * speed + gradient
                slope, offset = np.array([slope, offset]) - 0.05 * 0.5**epoch * speed
    assert values["slope"] == pytest.approx(slope, rel=1e-4)
    assert values["offset"] == pytest.approx(offset, rel=1e-4)


def test_halving():
    assert [halved(epoch, 2) for epoch in range(5)] == [1, 1, 0.5, 0.5, 0.25]
    assert halved(100, 0) == 1


def test_the_best_epoch_is_kept_and_stale_training_stops(tmp_path):
    held_out = [5.0, 3.0, 4.0, 6.0, 1.0]
    run, values = trained(tmp_path / "a", Line(list(held_out)), settings={"epochs": 10, "patience": 2})
    assert len(run.history) == 4
    assert run.best_epoch == 1
    _, after_one = trained(tmp_path / "b", settings={"epochs": 1})
    assert values == after_one


def test_a_longer_training_goes_on_from_a_finished_one(tmp_path):
    _, values = trained(tmp_path / "whole", settings={"epochs": 4})
    trained(tmp_path / "parts", settings={"epochs": 2})
    run, in_parts = trained(tmp_path / "parts", settings={"epochs": 4}, resume=True)
    assert in_parts == values
    assert len(run.history) == 5


def test_no_epochs_change_nothing(tmp_path):
    run, values = trained(tmp_path, settings={"epochs": 0})
    assert values == {"slope": 0, "offset": 1}
    assert run.best_epoch == 0


def test_a_loss_that_is_not_finite_keeps_the_last_checkpoint(tmp_path):
    task = Line()
    task.break_at = 14  # in the third epoch
    with pytest.raises(FitError, match=r"the loss is nan in epoch 3, step 2.*learning_rate"):
        trained(tmp_path, task)
    header, tensors = load_checkpoint(tmp_path)
    assert header["run"]["rounds"] == 4
    assert all(torch.isfinite(value).all() for value in tensors.values())
    whole, values = trained(tmp_path / "whole")
    assert trained(tmp_path, resume=True) == (whole, values)


def test_weights_that_leave_the_finite_are_not_saved(tmp_path):
    class Diverging(Line):
        def loss(self, batch):
            fine = super().loss(batch)
            # the last loss of the second round is finite, its gradient is not
            return fine if self.steps != 6 else torch.sqrt(0 * self.parameters["slope"]).sum()

    with pytest.raises(FitError, match="'slope' is no longer finite after epoch 1"):
        trained(tmp_path, Diverging())
    header, tensors = load_checkpoint(tmp_path)
    assert header["run"]["rounds"] == 1
    assert all(torch.isfinite(value).all() for value in tensors.values())


def test_what_cannot_be_resumed(tmp_path):
    with pytest.raises(ModelError, match="no checkpoint"):
        trained(tmp_path, resume=True)
    trained(tmp_path)
    with pytest.raises(ModelError, match="was begun"):
        trained(tmp_path)
    task, training = Line(), Training()
    with pytest.raises(ModelError, match="made with seed = 7, here it is 8"):
        run_training(task, tmp_path, training, optimizer=sgd(task, training), made_from={"seed": 8}, resume=True)


@pytest.mark.parametrize("damage", ["cut", "bits", "text"])
def test_a_damaged_checkpoint_says_so_and_the_one_before_is_there(tmp_path, damage):
    whole, values = trained(tmp_path / "whole")
    with pytest.raises(StoppedError):
        trained(tmp_path / "cut", progress=stop_at(14))
    file = tmp_path / "cut" / CHECKPOINT
    content = bytearray(file.read_bytes())
    if damage == "bits":
        content[-1] ^= 0x10
    file.write_bytes({"cut": content[: len(content) // 2], "bits": content, "text": b"these are words"}[damage])
    with pytest.raises(ModelError, match=f"damaged.*delete it to resume from {BEFORE}"):
        trained(tmp_path / "cut", resume=True)
    file.unlink()
    assert trained(tmp_path / "cut", resume=True) == (whole, values)


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    tensors = {"a": torch.randn(3, 4, generator=torch.Generator().manual_seed(0)), "b": torch.arange(3)}
    save_checkpoint(tmp_path, {"x": [1, None, "y"]}, tensors)
    save_checkpoint(tmp_path, {"x": 2}, tensors)
    header, found = load_checkpoint(tmp_path)
    assert header == {"x": 2}
    assert all(torch.equal(found[name], value) for name, value in tensors.items())
    assert {path.name for path in tmp_path.iterdir()} == {CHECKPOINT, BEFORE}


def test_the_log_holds_the_losses(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run, _ = trained(tmp_path)
    events = EventAccumulator(str(tmp_path / "log")).Reload()
    held_out = [event.value for event in events.Scalars("held out/loss")]
    assert held_out == pytest.approx([row["loss"] for row in run.history[1:]])


def test_without_tensorboard_training_goes_on_and_says_what_is_missing(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with caplog.at_level(logging.WARNING, "loopclosure"):
        run, _ = trained(tmp_path)
    assert "loopclosure[train]" in caplog.text
    assert len(run.history) == 5
    assert not (tmp_path / "log").exists()
