"""``loopclosure explain`` on a small run and on images."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from PIL import Image

from loopclosure.cli import main
from loopclosure.config import Config
from loopclosure.runs import detect_loops

SMALL = {"features.height": 64, "features.width": 64, "aggregation.clusters": 8, "sequence.length": 3}
FAST = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]


@pytest.fixture
def call(monkeypatch, capsys):
    """Call the command as a user would; returns exit status, stdout and stderr."""

    def explain(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", "explain", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return explain


@pytest.fixture(scope="module")
def lap(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lap")
    wall = np.random.default_rng(0).integers(0, 255, (8, 30, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    for i in range(10):
        Image.fromarray(wall[:, 16 * i : 16 * i + 64]).save(folder / f"{i}.png")
    return folder


@pytest.fixture(scope="module")
def run(lap, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    return detect_loops(lap, out, reference=lap, config=Config().with_settings(SMALL)).folder


def test_a_run(call, run, tmp_path):
    code, text, _ = call(run, "--query", 7, "--out", tmp_path)
    assert code == 0
    assert text.startswith("4 pictures; look at ")
    assert {file.name for file in tmp_path.iterdir()} == {
        "explain.html",
        "heat_000007_000007.png",
        "geometry_000007_000007.png",
        "clusters_000007_000007.png",
        "spectrum.png",
    }
    page = (tmp_path / "explain.html").read_text()
    assert "query 7 and match 7" in page
    assert "10 of 10 frames of the reference traverse" in page


def test_json_lists_the_pictures(call, lap, tmp_path):
    code, text, _ = call(
        lap / "0.png",
        lap / "1.png",
        "--out",
        tmp_path,
        "--json",
        *FAST,
        "--set",
        "features.width=256",
        "--gamma",
        "0.6",
    )
    assert code == 0
    found = json.loads(text)
    assert found["page"] == str(tmp_path / "explain.html")
    assert len(found["pictures"]) == 4


@pytest.mark.parametrize("wrong", [["nowhere.png"], ["--method", "seqslam"], ["--query", "99"], ["--query", "0"]])
def test_errors_are_one_line(call, run, lap, tmp_path, wrong):
    source = [run] if wrong[0] == "--query" else [lap / "0.png"] if wrong[0] == "--method" else []
    code, out, err = call(*source, *wrong, "--out", tmp_path / "out")
    assert code == 1
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_wrong_usage(call, run, tmp_path):
    assert call(run)[0] == 2
    assert call("--out", tmp_path)[0] == 2
    assert call(run, "--pairs", 0, "--out", tmp_path)[0] == 2
