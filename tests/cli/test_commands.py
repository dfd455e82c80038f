"""Every command on small real files, and the mistakes a person makes: one line, exit 1; wrong usage, exit 2."""

from __future__ import annotations

import csv
import json
import re
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from loopclosure.cli import main
from loopclosure.store import HEADER

SMALL = {
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 8,
    "sequence.length": 4,
    "sequence.exclude_recent": 10,
    "decision.consistency": 1,
}
FAST = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line as a user would; returns exit status, stdout and stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def lap(tmp_path_factory):
    """A folder of 16 views along a wall of coloured blocks."""
    folder = tmp_path_factory.mktemp("lap")
    wall = np.random.default_rng(0).integers(0, 255, (8, 50, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    for i in range(16):
        Image.fromarray(wall[:, 16 * i : 16 * i + 64]).save(folder / f"{i}.png")
    return folder


def rows_of(folder):
    with open(folder / "loops.csv", newline="") as file:
        return list(csv.DictReader(file))


def error_line(result):
    code, out, err = result
    assert code == 1
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


def test_detect_writes_the_run_folder(run, lap, tmp_path):
    out = tmp_path / "run"
    code, text, _ = run("detect", lap, "--reference", lap, "--out", out, "--save-scores", *FAST)
    assert code == 0
    assert "loops accepted in 16 frames" in text
    rows = rows_of(out)
    assert list(rows[0]) == ["query", "match", "score", "accepted", "inliers", "reason"]
    assert [row["query"] for row in rows] == [str(i) for i in range(16)]
    assert [row["match"] for row in rows] == ["", "", "", *map(str, range(3, 16))]
    scores = np.load(out / "scores.npy")
    assert scores.shape == (16, 16)
    assert scores.dtype == np.float32
    assert np.nanargmax(scores[7]) == 7
    info = json.loads((out / "run.json").read_text())
    assert info["frames"] == info["references"] == 16
    assert info["config"]["sequence"]["length"] == 4
    assert info["learned_on"] == ["16 of 16 frames of the reference traverse"]
    assert len(info["weights"]["weights_sha256"]) == 64
    assert "<html" in (out / "report.html").read_text()
    assert not list(out.glob("*.part"))


def test_scores_of_one_stream_are_masked(run, lap, tmp_path):
    code, *_ = run("detect", lap, "--out", tmp_path, "--save-scores", *FAST)
    assert code == 0
    scores = np.load(tmp_path / "scores.npy")
    query, match = np.nonzero(~np.isnan(scores))
    assert (query - match >= 10).all()
    assert (match >= 3).all()
    code, *_ = run("detect", lap, "--out", tmp_path, *FAST)
    assert not (tmp_path / "scores.npy").exists()


def test_results_of_an_earlier_run_do_not_stay(run, lap, tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "precision_recall.png").write_bytes(b"")
    assert run("detect", lap, "--out", tmp_path, *FAST)[0] == 0
    left = {path.name for path in tmp_path.iterdir()}
    assert {"loops.csv", "run.json", "report.html"} <= left
    assert not left & {"metrics.json", "precision_recall.png", "scores.npy"}


def test_a_failed_run_leaves_no_results_that_look_whole(run, lap, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for file in lap.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "15.png").write_bytes(b"no picture")
    error_line(run("detect", folder, "--out", tmp_path / "run", "--save-scores", *FAST))
    left = {file.name for file in (tmp_path / "run").iterdir()}
    assert left == {"loops.csv.part", "scores.npy.rows", "checkpoint"}  # for `--resume`


def test_videos_are_sources_and_references(run, lap, tmp_path):
    video = tmp_path / "lap.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 64))
    for i in range(16):
        writer.write(cv2.imread(str(lap / f"{i}.png")))
    writer.release()
    out = tmp_path / "run"
    assert run("detect", video, "--reference", video, "--out", out, "--save-scores", *FAST)[0] == 0
    assert [row["match"] for row in rows_of(out)] == ["", "", "", *map(str, range(3, 16))]
    assert np.load(out / "scores.npy").shape == (16, 16)


def test_json_prints_one_object_and_nothing_else(run, lap, tmp_path):
    code, out, _ = run("detect", lap, "--out", tmp_path, "--json", *FAST)
    assert code == 0
    assert json.loads(out)["frames"] == 16
    assert run("detect", lap, "--out", tmp_path, "--quiet", *FAST)[1] == ""


def test_fit_then_detect_with_the_model(run, lap, tmp_path):
    code, out, _ = run("fit", lap, "--out", tmp_path / "model", "--json", *FAST)
    assert code == 0
    assert json.loads(out)["learned_on"] == [f"16 of 16 frames of the {lap.name}"]
    model = tmp_path / "model"
    assert run("detect", lap, "--model", model, "--out", tmp_path / "run")[0] == 0
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["config"]["features"]["height"] == 64
    assert "features.backbone" in error_line(
        run("detect", lap, "--model", model, "--backbone", "resnet18", "--weights", "random", "--out", tmp_path / "x")
    )
    (model / HEADER).write_text("{")
    error_line(run("detect", lap, "--model", model, "--out", tmp_path / "x"))


def test_a_saved_detector_is_a_reference(run, lap, tmp_path):
    saved, loose = tmp_path / "saved", ["--threshold", 0.5, "--set", "decision.consistency=1"]
    assert run("detect", lap, "--out", tmp_path / "one", "--save-detector", saved, *FAST)[0] == 0
    assert run("detect", lap, "--reference", saved, "--out", tmp_path / "two", *loose)[0] == 0
    rows = rows_of(tmp_path / "two")
    assert [row["match"] for row in rows[3:]] == [str(i) for i in range(3, 16)]


def test_skipped_frames_keep_their_row(run, lap, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for file in lap.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "7.png").write_bytes(b"no picture")
    assert "7.png" in error_line(run("detect", folder, "--out", tmp_path / "a", *FAST))
    assert run("detect", folder, "--on-error", "skip", "--out", tmp_path / "b", *FAST)[0] == 0
    assert [row["query"] for row in rows_of(tmp_path / "b") if row["reason"] == "unreadable"] == ["7"]


def test_evaluate(run, lap, tmp_path):
    out = tmp_path / "run"
    run("detect", lap, "--reference", lap, "--out", out, "--threshold", 0.5, *FAST)
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\n" + "".join(f"{i},{i}\n" for i in range(16)))
    code, text, _ = run("evaluate", out, "--truth", truth, "--json")
    assert code == 0
    metrics = json.loads(text)
    assert metrics == json.loads((out / "metrics.json").read_text())
    assert metrics["recall_at_100_precision"] == metrics["recall"] == 13 / 16
    assert metrics["protocol"]["tolerance"] == 0
    assert Image.open(out / "precision_recall.png").width > 300
    assert "protocol" in run("evaluate", out, "--truth", truth)[1]
    error_line(run("evaluate", out, "--truth", tmp_path / "absent.csv"))
    assert run("evaluate", out, "--truth", truth, "--level", "frame")[0] == 2


def test_simulate(run, tmp_path):
    code, *_ = run("simulate", tmp_path / "drive", "--frames", 40, "--width", 80, "--height", 60, "--no-parked-cars")
    assert code == 0
    names = {path.name for path in (tmp_path / "drive").iterdir()}
    assert {"images", "poses.csv", "truth.csv", "covered.csv"} <= names
    error_line(run("simulate", tmp_path / "drive", "--frames", 40))
    error_line(run("simulate", tmp_path / "other", "--frames", 1))


def test_tables(run):
    assert "kl-netvlad" in run("methods")[1]
    assert json.loads(run("methods", "--json")[1])["kl-netvlad"]["source"]
    weights = json.loads(run("weights", "--json")[1])
    assert weights["efficientnet-lite0"]["here"] == "installed"


def test_weights_that_are_absent_say_where_they_belong(run, lap, tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    line = error_line(run("detect", lap, "--backbone", "resnet18", "--out", tmp_path / "x"))
    assert "resnet18-f37072fd.pth" in line
    assert "https://" in line
    assert str(tmp_path / "cache") in line


def bad_folder(tmp_path, **files):
    folder = tmp_path / "bad"
    folder.mkdir()
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_bytes(content)
    return folder


def jpeg(width, height):
    import io

    stream = io.BytesIO()
    Image.new("RGB", (width, height), "grey").save(stream, "jpeg")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "no images"),
        ({"a__jpg": jpeg(64, 64)}, "one image"),
        ({"a__jpg": jpeg(64, 64)[:-200], "b__jpg": jpeg(64, 64)}, "a.jpg"),
        ({"a__jpg": jpeg(1, 1), "b__jpg": jpeg(64, 64)}, "1"),
        ({"a__jpg": b"these are words, not pixels", "b__jpg": jpeg(64, 64)}, "a.jpg"),
        ({"a__jpg": jpeg(10_000, 10_000), "b__jpg": jpeg(64, 64)}, "megapixel"),
    ],
    ids=["empty", "one", "truncated", "1x1", "text", "100MP"],
)
def test_bad_images_are_one_line(run, tmp_path, files, words):
    folder = bad_folder(tmp_path, **files)
    assert words in error_line(run("detect", folder, "--out", tmp_path / "run", *FAST))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gamma", "1.0"], "compression.gamma"),
        (["--threshold", "nan"], "decision.threshold"),
        (["--set", "compression.components=5000"], "5000"),
        (["--set", "sequence.lenght=5"], "did you mean 'sequence.length'"),
        (["--set", "nonsense"], "stage.field=value"),
        (["--preset", "papre"], "did you mean 'paper'"),
        (["--method", "netvald"], "unknown method"),
        (["--backbone", "resnet153", "--weights", "random"], "did you mean 'resnet152'"),
        (["--layer", "conv9"], "conv9"),
        (["--weights", "no-such-weights"], "no-such-weights"),
        (["--reference", "no/such/folder"], "no/such/folder"),
        (["--model", "no/such/model"], "no/such/model"),
        (["--config", "no/such.toml"], "no/such.toml"),
    ],
)
def test_wrong_settings_are_one_line(run, lap, tmp_path, arguments, words):
    assert words in error_line(run("detect", lap, "--out", tmp_path / "run", *FAST, *arguments))


def test_wrong_usage_exits_with_two(run):
    assert run("detect")[0] == 2
    assert run("no-such-command")[0] == 2
    assert run("detect", "x", "--threshold", "high")[0] == 2
    assert run("detect", "x", "--on-error", "ignore")[0] == 2


@pytest.mark.parametrize("command", ["detect", "evaluate", "fit", "simulate", "methods", "weights"])
def test_help_shows_examples(run, command):
    code, out, _ = run(command, "--help")
    assert code == 0
    assert f"loopclosure {command}" in out
    assert "Example" in out


def test_help_shows_the_defaults_of_the_configuration(run):
    out = run("detect", "--help")[1]
    assert "(default: 10)" in re.sub(r"[\s│]+", " ", out)
