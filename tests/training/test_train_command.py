"""``loopclosure train`` as a user types it."""

from __future__ import annotations

import json
import sys

import pytest

from loopclosure.cli import main
from loopclosure.training.checkpoint import CHECKPOINT


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line; returns exit status, stdout and stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return call


@pytest.fixture
def flags(small):
    """The small settings as flags."""
    changed = {name: value for name, value in small.flat().items() if value != type(small)().flat()[name]}
    return [part for name, value in changed.items() for part in ("--set", f"{name}={value}")]


def test_siamese_then_detect(run, class_tree, drive, flags, tmp_path):
    model = tmp_path / "model"
    code, out, _ = run("train", "siamese", class_tree, "--out", model, "--epochs", 1, *flags)
    assert code == 0
    assert "pair_accuracy" in out
    code, _, err = run("train", "siamese", class_tree, "--out", model, "--epochs", 1, *flags)
    assert (code, err.count("\n")) == (1, 1)
    assert "was begun" in err
    code, out, _ = run("train", "siamese", class_tree, "--out", model, "--epochs", 2, "--resume", "--json", *flags)
    assert len(json.loads(out)["history"]) == 3
    assert run("detect", drive, "--model", model, "--out", tmp_path / "run")[0] == 0
    assert run("detect", drive, "--model", tmp_path / "run" / "model", "--out", tmp_path / "again")[0] == 0


def test_netvlad_then_detect(run, drive, flags, tmp_path):
    model = tmp_path / "model"
    arguments = ("train", "netvlad", drive, "--poses", drive / "poses.csv", "--out", model, "--epochs", 1, *flags)
    code, out, _ = run(*arguments)
    assert code == 0
    assert "recall_at_1" in out
    assert run("detect", drive, "--model", model, "--out", tmp_path / "run")[0] == 0


def test_mistakes_are_one_line(run, class_tree, flags, tmp_path):
    for arguments, words in (
        (("train", "siamese", tmp_path / "absent", "--out", tmp_path / "x"), "absent"),
        (("train", "siamese", class_tree, "--out", tmp_path / "x", "--resume"), "no checkpoint"),
        (("train", "siamese", class_tree, "--out", tmp_path / "x", "--freeze-until", "conv9"), "conv9"),
        (("train", "siamese", class_tree, "--out", tmp_path / "x", "--set", "training.epoch=1"), "training.epochs"),
    ):
        code, out, err = run(*arguments, *flags)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert words in err
    assert not (tmp_path / "x" / CHECKPOINT).exists()
    assert run("train", "netvlad", class_tree, "--out", tmp_path / "x")[0] == 2


def test_help_shows_examples(run):
    for kind in ("siamese", "netvlad"):
        out = run("train", kind, "--help")[1]
        assert f"loopclosure train {kind}" in out
