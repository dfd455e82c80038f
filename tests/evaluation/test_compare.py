"""Several methods on one small drive: one table, by the rules of `evaluate`; what cannot run does not stop the rest."""

from __future__ import annotations

import csv
import json
import re
import sys

import numpy as np
import pytest
from PIL import Image

from loopclosure.cli import main
from loopclosure.config import Config
from loopclosure.errors import ConfigError, ImageError, TruthError, WeightsError
from loopclosure.evaluation import evaluate_run
from loopclosure.evaluation.compare import compare_methods, config_for, method_names, milliseconds_a_frame
from loopclosure.methods import METHODS
from loopclosure.report.comparison import PAGE, TABLE, write_comparison
from loopclosure.runs import fit_model
from loopclosure.store import HEADER

SMALL = {
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 4,
    "sequence.length": 3,
    "sequence.exclude_recent": 6,
}
FAST = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]
LAP = 10


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A folder of 20 views: a lap along a wall of coloured blocks, and the same lap again, a few pixels beside."""
    folder = tmp_path_factory.mktemp("drive")
    wall = np.random.default_rng(0).integers(0, 255, (9, 40, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    for i in range(2 * LAP):
        beside, along = 3 * (i >= LAP), 16 * (i % LAP) + 2 * (i >= LAP)
        Image.fromarray(wall[beside : beside + 64, along : along + 64]).save(folder / f"{i}.png")
    return folder


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    file = tmp_path_factory.mktemp("truth") / "truth.csv"
    file.write_text("query,match\n" + "".join(f"{LAP + i},{i}\n" for i in range(LAP)))
    return file


@pytest.fixture
def no_downloads(monkeypatch, tmp_path):
    """An empty cache, and a network that does not answer."""

    def refuse(weights, *, progress=None):
        raise WeightsError(f"cannot download {weights.file}")

    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("loopclosure.weights.fetch", refuse)


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", "compare", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def small():
    return Config().with_settings(SMALL)


def rows_of(folder):
    with open(folder / TABLE, newline="") as file:
        return {row["method"]: row for row in csv.DictReader(file)}


def test_every_row_is_what_evaluate_says_of_the_run_folder(run, drive, truth, tmp_path):
    code, out, err = run(
        drive, "--truth", truth, "--methods", "kl-netvlad,seqslam", "--tolerance", 1, "--out", tmp_path, *FAST
    )
    assert (code, err) == (0, "")
    rows = rows_of(tmp_path)
    assert list(rows) == ["kl-netvlad", "seqslam"]
    for name, row in rows.items():
        metrics, _ = evaluate_run(tmp_path / name, truth, tolerance=1)
        assert json.loads((tmp_path / name / "metrics.json").read_text()) == json.loads(json.dumps(metrics))
        for measure in ("recall_at_100_precision", "average_precision", "top1", "precision", "recall"):
            wanted = metrics[measure]
            assert row[measure] == ("" if wanted is None else str(wanted))
        assert row["truth_hash"] == metrics["protocol"]["truth_hash"]
        assert (row["tolerance"], row["exclusion"]) == ("1", "6")
        info = json.loads((tmp_path / name / "run.json").read_text())
        assert float(row["ms_an_image"]) == pytest.approx(milliseconds_a_frame(info), abs=1e-3)
        assert info["config"]["sequence"] | {"length": 3, "exclude_recent": 6} == info["config"]["sequence"]
        assert re.search(rf"^{name} ", out, re.M)
    assert "protocol: row level" in out
    assert "machine: " in out


def test_milliseconds_leave_learning_out_and_count_the_references():
    seconds = {"features": 3.0, "learn": 100.0, "describe": 0.2, "match": 0.4, "total": 200.0}
    assert milliseconds_a_frame({"seconds": seconds, "frames": 10, "references": None}) == pytest.approx(360)
    against = {"seconds": seconds, "frames": 10, "references": 20}
    assert milliseconds_a_frame(against) == pytest.approx(160)
    assert milliseconds_a_frame(against, map_was_saved=True) == pytest.approx(360)


def test_the_embedded_network_stands_in_and_what_cannot_run_says_why(run, no_downloads, drive, truth, tmp_path):
    methods = "netvlad-vgg16,faster-rcnn,onnx,seqslam"
    code, out, err = run(drive, "--truth", truth, "--methods", methods, "--out", tmp_path, *FAST)
    assert (code, err) == (0, "")
    rows = rows_of(tmp_path)
    assert rows["netvlad-vgg16"]["mark"] == "embedded backbone"
    assert rows["netvlad-vgg16"]["weights"] == "efficientnet-lite0"
    assert rows["netvlad-vgg16"]["top1"] != ""
    for name in ("faster-rcnn", "onnx"):
        assert rows[name]["top1"] == rows[name]["mark"] == ""
    assert "loopclosure weights fetch fasterrcnn-coco" in rows["faster-rcnn"]["note"]
    assert "--weights faster-rcnn=random" in rows["faster-rcnn"]["note"]
    assert "=random" not in rows["netvlad-vgg16"]["note"]
    assert "onnx.path" in rows["onnx"]["note"]
    assert rows["seqslam"]["top1"] != ""
    assert rows["seqslam"]["mark"] == ""
    page = (tmp_path / PAGE).read_text()
    assert "<mark>embedded backbone</mark>" in page
    assert "loopclosure weights fetch vgg16-imagenet1k-v1" in page
    assert "loopclosure weights fetch vgg16-imagenet1k-v1" in out


def test_exit_status_tells_that_nothing_ran(run, no_downloads, drive, truth, tmp_path):
    code, out, _ = run(drive, "--truth", truth, "--methods", "faster-rcnn", "--out", tmp_path, *FAST)
    assert code == 1
    assert "not run" in out


def test_weights_that_are_asked_for_are_not_replaced(no_downloads, drive, truth, small, tmp_path):
    asked = small.with_settings({"features.weights": "vgg16-imagenet1k-v1"})
    (result,) = compare_methods(drive, truth, tmp_path, methods="netvlad-vgg16", config=asked).results
    assert result.metrics is None
    assert "cannot download" in result.note


def test_random_weights_and_another_backbone_are_marked(run, drive, truth, tmp_path):
    given = ["--backbone", "resnet18", "--weights", "random"]
    code, _, _ = run(drive, "--truth", truth, "--methods", "netvlad-vgg16", "--out", tmp_path, *given, *FAST)
    assert code == 0
    assert rows_of(tmp_path)["netvlad-vgg16"]["mark"] == "backbone resnet18, random weights"
    page = (tmp_path / PAGE).read_text()
    assert "<mark>random weights</mark>" in page
    assert "<b>" not in page  # an untrained network is never the best
    info = json.loads((tmp_path / "netvlad-vgg16" / "run.json").read_text())
    assert info["config"]["features"]["backbone"] == "resnet18"
    assert info["config"]["features"]["layer"] == "conv5"


def test_weights_of_one_method(run, no_downloads, drive, truth, tmp_path):
    given = ["--methods", "faster-rcnn,cnn", "--weights", "faster-rcnn=random", "--out", tmp_path]
    code, out, err = run(drive, "--truth", truth, *given, *FAST)
    assert (code, err) == (0, "")
    rows = rows_of(tmp_path)
    assert (rows["faster-rcnn"]["mark"], rows["cnn"]["mark"]) == ("random weights", "")
    assert rows["faster-rcnn"]["top1"] != ""
    assert rows["cnn"]["weights"] == "efficientnet-lite0"
    assert re.search("^faster-rcnn .* random weights$", out, re.M)
    assert "<mark>random weights</mark>" in (tmp_path / PAGE).read_text()


@pytest.mark.parametrize("flag", ["--weights", "--model"])
def test_what_is_for_one_method_names_a_method_that_runs(run, drive, truth, tmp_path, flag):
    out = tmp_path / "out"
    for given, said in (("sqslam=x", "did you mean 'seqslam'"), ("cnn=x", "not among the methods")):
        code, _, err = run(drive, "--truth", truth, "--methods", "seqslam", flag, given, "--out", out)
        assert code == 1
        assert said in err
        assert err.count("\n") == 1
    assert not out.exists()


def test_models_that_were_fitted_before(run, drive, truth, tmp_path):
    words = {"words.branching": 4, "words.side": 64, "words.max_features": 50}
    config = Config().with_settings(SMALL | words | {"method": "bow"})
    fit_model(drive, tmp_path / "words", config=config)
    given = ["--methods", "bow,fabmap,seqslam", "--model", f"bow={tmp_path / 'words'}", "--out", tmp_path / "out"]
    settings = [part for name, value in words.items() for part in ("--set", f"{name}={value}")]
    code, _, err = run(drive, "--truth", truth, *given, "--model", f"fabmap={tmp_path / 'none'}", *FAST, *settings)
    assert (code, err) == (0, "")
    rows = rows_of(tmp_path / "out")
    assert rows["bow"]["learned_on"] == f"20 of 20 frames of the {drive.name}"
    assert "none" in rows["fabmap"]["note"]
    assert rows["fabmap"]["top1"] == ""
    assert rows["seqslam"]["top1"] != ""


def test_a_model_without_a_method_is_refused(run, drive, truth, tmp_path):
    code, _, err = run(drive, "--truth", truth, "--model", tmp_path, "--out", tmp_path / "out")
    assert code == 1
    assert "METHOD=MODEL" in err


def test_a_backbone_is_for_methods_that_run_on_maps():
    assert config_for("netvlad-vgg16", Config()).features.backbone == "vgg16"
    assert config_for("netvlad-vgg16", Config(), "resnet18").features.layer == "conv5"
    assert config_for("faster-rcnn", Config(), "resnet18").features.backbone == "fasterrcnn_resnet50_fpn"
    chosen = Config().with_settings({"features.backbone": "resnet18", "features.layer": "conv4"})
    assert config_for("cnn", chosen, "resnet18").features.layer == "conv4"


def test_two_traverses(drive, small, tmp_path):
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("query,match\n" + "".join(f"{i},{i}\n" for i in range(2 * LAP)))
    comparison = compare_methods(drive, pairs, tmp_path, methods=["cnn"], reference=drive, config=small)
    (result,) = comparison.results
    assert (comparison.frames, comparison.references) == (20, 20)
    assert comparison.protocol["mode"] == "two traverses"
    assert comparison.protocol["exclusion"] == 0
    # All but the first two frames, behind which there is no full sequence.
    assert result.metrics["top1"] == (2 * LAP - 2) / (2 * LAP)
    page = write_comparison(comparison, tmp_path).read_text()
    assert f"{drive.name} against {drive.name}" in page


def test_the_page_stands_alone_and_escapes_names(drive, truth, small, tmp_path):
    odd = tmp_path / "<b>&drive.txt"
    odd.write_text("".join(f"{drive / f'{i}.png'}\n" for i in range(2 * LAP)))
    comparison = compare_methods(odd, truth, tmp_path / "out", methods=["seqslam"], config=small)
    page = write_comparison(comparison, tmp_path / "out").read_text()
    assert "&lt;b&gt;&amp;drive.txt" in page
    assert "<b>&drive" not in page
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "<script" not in page
    assert not list((tmp_path / "out").rglob("*.part"))


def test_json_is_one_object(run, drive, truth, tmp_path):
    code, out, _ = run(drive, "--truth", truth, "--methods", "seqslam", "--out", tmp_path, "--json", *FAST)
    result = json.loads(out)
    assert code == 0
    assert result["methods"][0]["method"] == "seqslam"
    assert result["protocol"]["level"] == "row"
    assert result["machine"]


def test_names_of_methods():
    assert method_names("all") == list(METHODS)
    assert method_names("seqslam,cnn,seqslam") == ["seqslam", "cnn"]
    with pytest.raises(ConfigError, match="did you mean 'seqslam'"):
        method_names("seqslma")
    with pytest.raises(ConfigError, match="no method was named"):
        method_names(" , ")


def test_mistakes_come_before_the_first_run(drive, truth, small, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match="unknown method"):
        compare_methods(drive, truth, out, methods="seqslam,x", config=small)
    with pytest.raises(ImageError):
        compare_methods(tmp_path / "none", truth, out, config=small)
    with pytest.raises(TruthError):
        compare_methods(drive, tmp_path / "none.csv", out, config=small)
    (tmp_path / "saved").mkdir()
    (tmp_path / "saved" / HEADER).write_text("{}")
    with pytest.raises(ConfigError, match="saved detector"):
        compare_methods(drive, truth, out, reference=tmp_path / "saved", config=small)
    assert not out.exists()


def test_method_is_not_methods(run, drive, truth, tmp_path):
    code, out, err = run(drive, "--truth", truth, "--method", "cnn", "--out", tmp_path)
    assert (code, out) == (1, "")
    assert "--methods" in err
    assert err.count("\n") == 1
