"""The paper's experiments on small drives: equal to the detector, one pass over the images, resumable after a kill."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat

from loopclosure import LoopDetector
from loopclosure.cli import main
from loopclosure.config import Config
from loopclosure.errors import ConfigError, ResultsError, TruthError, WeightsError
from loopclosure.evaluation import LoopLog, paper
from loopclosure.evaluation.cache import BLOCK, MapCache, image_paths
from loopclosure.evaluation.experiments import method_config, reproduce
from loopclosure.evaluation.grid import best_matches, fill_grid, fitting_frames
from loopclosure.features.backbones import Backbone
from loopclosure.images.datasets import DATASETS
from loopclosure.images.sequence import ImageSequence
from loopclosure.report.experiments import PAGE

SMALL = {
    "features.backbone": "efficientnet-lite0",
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 4,
    "sequence.length": 3,
    "sequence.exclude_recent": 6,
}
FAST = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]
CUSTOM = ("--methods", "none", *FAST)


def write_drive(folder, lap, *, stereo=False):
    """Two laps along a wall of coloured blocks; with `stereo`, a right image of another part of it after each."""
    folder.mkdir(parents=True)
    wall = np.random.default_rng(0).integers(0, 255, (18, 2 * lap + 20, 3), dtype=np.uint8)
    wall = wall.repeat(8, axis=0).repeat(8, axis=1)
    number = 0
    for i in range(2 * lap):
        beside, along = int(i >= lap), 16 * (i % lap) + (i >= lap)
        for down in (0, 64) if stereo else (0,):
            Image.fromarray(wall[beside + down : beside + down + 64, along : along + 64]).save(
                folder / f"{number:04}.png"
            )
            number += 1
    return folder


def write_truth(file, lap):
    file.write_text("query,match\n" + "".join(f"{lap + i},{i}\n" for i in range(lap)))
    return file


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """40 frames and their truth: a block and a bit."""
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder / "images", 20), write_truth(folder / "truth.csv", 20)


@pytest.fixture(scope="module")
def small():
    return Config.preset("paper").with_settings(SMALL)


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", "reproduce", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return call


def cache_of(folder, images, config, layers=("s16",)):
    return MapCache(folder, ImageSequence(images), config.features, layers)


def rows_of(file):
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


def times_of(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_cached_maps_are_those_of_the_network(drive, small, tmp_path):
    maps = cache_of(tmp_path, drive[0], small, ("s32", "s8"))
    maps.fill()
    assert maps.computed == 40
    backbone = Backbone("efficientnet-lite0", ("s8", "s32"), height=64, width=64)
    pictures = list(ImageSequence(drive[0]))
    for layer in ("s8", "s32"):
        alone = np.concatenate([backbone.maps([picture])[layer] for picture in pictures])
        np.testing.assert_allclose(np.concatenate(list(maps.blocks(layer))), alone, atol=1e-4)
        np.testing.assert_array_equal(
            maps.take(layer, [0, 31, 32, 39]), np.concatenate(list(maps.blocks(layer)))[[0, 31, 32, 39]]
        )
        assert maps.frame_bytes(layer) == alone[0].nbytes
    assert len(list(tmp_path.iterdir())) == 2 * 2


@pytest.mark.parametrize("window", [0, 7])
def test_a_cell_is_what_the_detector_says_with_a_model_fitted_on_the_same_images(drive, small, tmp_path, window):
    config = small.with_settings(
        {"aggregation.centre_window": window, "decision.threshold": 0.6, "decision.consistency": 3}
    )
    maps = cache_of(tmp_path / "features", drive[0], config)
    maps.fill()
    for cell in fill_grid(maps, (None, 0.6, 0.9), config, tmp_path / "cells"):
        rule = {"compression.reading": "none"} if cell.gamma is None else {"compression.gamma": cell.gamma}
        detector = LoopDetector(config.with_settings({"features.layer": "s16", **rule}))
        images = ImageSequence(drive[0])
        detector.fit(images, source="images")
        wanted = LoopLog.from_decisions(detector.detect(images))
        found = cell.log(config)
        assert (cell.components, cell.channels) == ({None: 112, 0.6: 45, 0.9: 11}[cell.gamma], 112)
        np.testing.assert_allclose(found.score, wanted.score, atol=2e-5)
        np.testing.assert_array_equal(found.match, wanted.match)
        np.testing.assert_array_equal(found.accepted, wanted.accepted)
        assert (wanted.match >= 0).sum() > 20


def test_scores_are_equation_20_in_plain_loops(small):
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(BLOCK + 9, 5)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    match, score, matrix = best_matches(descriptors, small)
    length, exclude = 3, 6
    for query in range(len(descriptors)):
        distances = {
            candidate: np.mean(
                [np.sum((descriptors[query - i] - descriptors[candidate - i]) ** 2) / 4 for i in range(length)]
            )
            for candidate in range(length - 1, query - exclude + 1)
        }
        assert (~np.isnan(matrix[query])).sum() == len(distances)
        if not distances:
            assert match[query] == -1
            assert np.isnan(score[query])
            continue
        assert match[query] == min(distances, key=distances.get)
        assert score[query] == pytest.approx(1 - min(distances.values()), abs=1e-5)


def test_frames_to_fit_on_are_bounded_by_number_and_memory(small):
    assert fitting_frames(10, 1000, small) == list(range(10))
    few = small.with_settings({"learning.fit_frames": 3})
    assert fitting_frames(11, 1000, few) == [0, 5, 10]
    tight = small.with_settings({"learning.max_kept_mb": 0.004})
    assert fitting_frames(100, 1000, tight) == [0, 33, 66, 99]


def test_a_second_run_computes_nothing_and_says_the_same(run, drive, tmp_path):
    arguments = ("--images", drive[0], "--truth", drive[1], "--out", tmp_path, "--methods", "seqslam", *FAST)
    code, first, err = run(*arguments, "--layers", "s16,s32")
    assert (code, err) == (0, "")
    assert "40 images passed the network" in first
    kept = {name: times_of(tmp_path / name) for name in ("features", "cells", "times")}
    runs = {name: moment for name, moment in times_of(tmp_path / "methods").items() if name != "metrics.json"}
    code, second, _ = run(*arguments, "--layers", "s16,s32")
    assert code == 0
    assert "0 images passed the network" in second
    assert second.replace("0 images", "40 images") == first
    assert {name: times_of(tmp_path / name) for name in kept} == kept
    assert {k: v for k, v in times_of(tmp_path / "methods").items() if k != "metrics.json"} == runs


def test_only_what_changed_is_made_anew(drive, small, tmp_path):
    images = write_drive(tmp_path / "images", 20)

    def computed(config=small, layers=("s16",)):
        maps = cache_of(tmp_path / "features", images, config, layers)
        maps.fill()
        return maps.computed

    assert computed() == 40
    assert computed() == 0
    Image.new("RGB", (64, 64), (200, 30, 30)).save(images / "0035.png")
    assert computed() == 40 - BLOCK
    assert computed(layers=("s16", "s32")) == 40
    assert computed(layers=("s32",)) == 0
    assert computed(small.with_settings({"features.height": 96})) == 40
    assert computed(small.with_settings({"features.weights": "random"})) == 40
    (images / "0000.png").rename(images / "0.png")  # the same pictures in the same order
    assert computed() == 0
    (tmp_path / "features" / next(iter((tmp_path / "features").iterdir())).name).unlink()
    assert computed(layers=("s16", "s32")) in (0, 8, BLOCK)


def test_a_cell_is_found_only_by_the_settings_that_made_it(drive, small, tmp_path):
    maps = cache_of(tmp_path / "features", drive[0], small)
    maps.fill()
    places = tmp_path / "cells"
    fill_grid(maps, (0.6,), small, places)
    for setting in ({"aggregation.clusters": 5}, {"sequence.length": 2}, {"learning.seed": 1}):
        before = len(list(places.iterdir()))
        fill_grid(maps, (0.6,), small.with_settings(setting), places)
        assert len(list(places.iterdir())) == before + 1
    fill_grid(maps, (0.6,), small.with_settings({"decision.threshold": 0.9}), places)
    assert len(list(places.iterdir())) == before + 1
    with pytest.raises(ConfigError, match="'channel'"):
        fill_grid(maps, (0.6,), small.with_settings({"compression.reading": "flat"}), places)


def test_a_killed_run_goes_on_where_it_stopped(run, tmp_path):
    images, truth = write_drive(tmp_path / "images", 70), write_truth(tmp_path / "truth.csv", 70)
    out = tmp_path / "out"
    arguments = ["--images", images, "--truth", truth, "--out", out, "--layers", "s16", *CUSTOM]
    command = [sys.executable, "-c", "from loopclosure.cli import main; main()", "reproduce", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not list((out / "features").glob("s16-*.npy")):
        assert process.poll() is None
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = len(list((out / "features").glob("s16-*.npy")))
    assert 1 <= finished <= 5
    code, text, _ = run(*arguments)
    assert code == 0
    assert f"{140 - BLOCK * finished} images passed the network" in text
    pictures = list(ImageSequence(images))
    alone = Backbone("efficientnet-lite0", "s16", height=64, width=64).maps(pictures)["s16"]
    maps = cache_of(out / "features", images, Config.preset("paper").with_settings(SMALL))
    np.testing.assert_allclose(np.concatenate(list(maps.blocks("s16"))), alone, atol=1e-4)


def test_a_damaged_block_is_named(drive, small, tmp_path):
    maps = cache_of(tmp_path, drive[0], small)
    maps.fill()
    block = next(tmp_path.glob("s16-*.npy"))
    block.write_bytes(b"")
    with pytest.raises(ResultsError, match="delete it"):
        list(maps.blocks("s16"))


def test_tables_figures_and_page_of_own_data(run, drive, tmp_path):
    code, out, err = run(
        "garden", "--images", drive[0], "--truth", drive[1], "--out", tmp_path, "--tolerance", 1, *CUSTOM
    )
    assert (code, err) == (0, "")
    rows = rows_of(tmp_path / "tables" / "table-4-5-all.csv")
    assert [row["layer"] for row in rows[::5]] == ["s4", "s8", "s16", "s32"]
    assert [row["gamma"] for row in rows[:5]] == ["", "0.6", "0.7", "0.8", "0.9"]
    assert {row["paper_recall_at_100_precision_percent"] for row in rows} == {""}
    assert {(row["data_set"], row["tolerance"], row["exclusion"], row["view"]) for row in rows} == {
        ("garden", "1", "6", "all")
    }
    assert rows[0]["fitted_on"] == "40 of the 40 test images"
    numbers = json.loads((tmp_path / "results.json").read_text())["experiments"][0]["grid"]
    assert [str(row["average_precision"]) for row in numbers] == [row["average_precision"] for row in rows]
    assert max(float(row["average_precision"]) for row in rows) > 0.8
    pictures = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert pictures == [
        "figure-12-spectrum-all.png",
        "figure-17-truth-all.png",
        "figure-18-19-distances-all.png",
        "figure-20-21-layers-all.png",
        "figure-22-23-methods-all.png",
    ]
    page = (tmp_path / PAGE).read_text()
    assert page.count("<img") == len(pictures)
    assert not re.findall(r'(?:src|href)="(?!data:image/png)', page)
    assert "<script" not in page
    assert "fitted on the test images (40 of the 40 test images)" in page
    assert "tolerance 1 frames" in page
    assert "nothing taken out of the descriptors" in page
    assert "s32 + KL 80 %" in out
    assert not list(tmp_path.rglob("*.part"))


def test_new_college_for_both_cameras_beside_the_paper(run, monkeypatch, tmp_path):
    """The folder and the truth have the published form; only the number of images is smaller."""
    lap = 14
    home = tmp_path / "NewCollege"
    write_drive(home / "Images", lap, stereo=True)
    truth = np.zeros((4 * lap, 4 * lap), np.uint8)
    for i in range(lap):
        truth[2 * (lap + i) : 2 * (lap + i) + 2, 2 * i : 2 * i + 2] = 1
    savemat(home / "NewCollegeGroundTruth.mat", {"truth": truth})
    record = replace(DATASETS["new-college"], frames={"NewCollege": 4 * lap}, images_sha256=None)
    monkeypatch.setitem(DATASETS, "new-college", record)
    given = ["--backbone", "resnet152", "--weights", "random", "--layers", "conv1,conv2", "--methods", "seqslam"]
    out = tmp_path / "out"
    small = [*FAST[2:], "--set", "aggregation.clusters=2"]
    code, text, err = run("new-college", "--images", home, "--out", out, *small, *given)
    assert (code, err) == (0, "")
    assert f"{4 * lap} images passed the network" in text
    for view, first in (("left", 0), ("right", 1)):
        rows = rows_of(out / "tables" / f"table-4-{view}.csv")
        assert {(row["view"], row["rows_with_truth"], row["random"]) for row in rows} == {(view, str(lap), "True")}
        by_cell = {(row["layer"], row["gamma"]): row["paper_recall_at_100_precision_percent"] for row in rows}
        assert by_cell["conv2", "0.9"] == "16.58"
        assert by_cell["conv1", "0.6"] == "14.62"
        assert by_cell["conv2", ""] == ""
        methods = {row["method"]: row for row in rows_of(out / "tables" / f"table-6-7-{view}.csv")}
        assert methods["conv2-kl-0.8-netvlad"]["paper_recall_at_100_precision_percent"] == "18.31"
        assert methods["seqslam"]["paper_ms_an_image"] == "32.16"
        names = (out / f"frames-{view}.txt").read_text().splitlines()
        assert [int(name[-8:-4]) for name in names] == list(range(first, 4 * lap, 2))
    page = (out / PAGE).read_text()
    assert "Table 4: " in page
    assert "Left camera" in page
    assert "Right camera" in page
    assert page.count("Random weights.") == 1
    assert page.count("<mark>random weights</mark>") >= 2 * 8
    assert "16.58" in page
    assert "faster-rcnn" in page  # a row of the paper that was not asked for says so


def test_truth_of_one_camera_of_a_stereo_set(small, tmp_path):
    images = write_drive(tmp_path / "images", 10, stereo=True)
    pairs = np.zeros((20, 20), bool)
    pairs[np.arange(10, 20), np.arange(10)] = True
    np.save(tmp_path / "one.npy", pairs)
    both = np.kron(pairs, np.ones((2, 2), bool))
    np.save(tmp_path / "both.npy", both)
    grids = {}
    for name in ("one", "both"):
        result = reproduce(
            "x",
            tmp_path / "out",
            images=images,
            truth=tmp_path / f"{name}.npy",
            config=small,
            layers=["s16"],
            view="left",
            methods="none",
        )
        (experiment,) = result.experiments
        grids[name] = [cell.metrics["average_precision"] for cell in experiment.grid]
        assert experiment.frames == 20
        assert experiment.truth.pairs.nnz == 10
    assert grids["one"] == grids["both"]
    with pytest.raises(TruthError):
        reproduce("x", tmp_path / "out", images=images, truth=tmp_path / "one.npy", config=small, methods="none")


def test_limit_takes_the_first_frames(small, drive, tmp_path):
    result = reproduce(
        "x", tmp_path, images=drive[0], truth=drive[1], config=small, layers=["s16"], methods=["seqslam"], limit=30
    )
    (experiment,) = result.experiments
    assert (experiment.frames, result.computed) == (30, 30)
    assert experiment.truth.pairs.shape == (30, 30)
    assert {cell.metrics["rows_with_truth"] for cell in experiment.grid} == {10}
    assert experiment.methods[0].metrics["rows"] == 30
    whole = reproduce("x", tmp_path, images=drive[0], truth=drive[1], config=small, layers=["s16"], methods="none")
    assert whole.computed == 40  # the last block of the quick look was not a whole one


def test_the_embedded_network_stands_in_for_the_papers(run, monkeypatch, drive, tmp_path):
    def refuse(weights, *, progress=None):
        raise WeightsError(f"cannot download {weights.file}")

    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("loopclosure.weights.fetch", refuse)
    code, out, _ = run(
        "--images", drive[0], "--truth", drive[1], "--out", tmp_path, "--layers", "s16", *CUSTOM[:2], *FAST[2:]
    )
    assert code == 0
    assert "the embedded network stands in: cannot download resnet152" in out
    assert "The embedded network stands in." in (tmp_path / PAGE).read_text()
    code, out, err = run(
        "--images", drive[0], "--truth", drive[1], "--out", tmp_path, "--weights", "resnet152-imagenet1k-v1"
    )
    assert (code, out) == (1, "")
    assert "cannot download" in err


def test_methods_run_as_shipped_but_on_the_same_footing(small):
    config = method_config("kl-netvlad", small)
    assert config.sequence == small.sequence
    assert config.features == Config().features.model_copy(update={"height": 64, "width": 64})
    assert config.aggregation.centre_window == Config().aggregation.centre_window
    assert config.decision == Config().decision
    resnet = small.with_settings({"features.backbone": "resnet152", "features.weights": "random"})
    assert method_config("netvlad-resnet152", resnet).features.weights == "random"
    assert method_config("netvlad-vgg16", resnet).features.weights == "default"


def test_the_papers_numbers():
    """Spot checks of the four corners, and the tables agree with each other."""
    assert paper.recall_of_layer("new-college", "resnet152", "conv1", 0.6) == 14.62
    assert paper.recall_of_layer("city-centre", "resnet152", "conv5", 0.9) == 73.38
    assert paper.recall_of_layer("city-centre", "vgg16", "conv5", 0.9) is None
    assert paper.recall_of_layer("kitti", "resnet152", "conv5", 0.9) is None
    assert paper.recall_of_layer("new-college", "resnet152", "conv5", None) is None
    for name in paper.SETS:
        at_90 = paper.recall_of_layer(name, "resnet152", "conv5", paper.FIGURE_GAMMA)
        assert paper.OURS.recall[name] == at_90 != paper.recall_of_layer(name, "resnet152", "conv5", paper.TEXT_GAMMA)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--images", "{drive}"), "--truth"),
        (("new-colege", "--truth", "{truth}"), "none of the paper's data sets"),
        (("--images", "{drive}", "--truth", "{truth}", "--limit", "1"), "at least 2"),
        (("--images", "{drive}", "--truth", "{truth}", "--layers", "conv9"), "conv9"),
        (("--images", "{drive}", "--truth", "{truth}", "--methods", "seqslma"), "did you mean 'seqslam'"),
        (("--images", "{drive}", "--truth", "{truth}", "--set", "sequence.lenght=3"), "did you mean"),
        (("--images", "{drive}", "--truth", "{truth}", "--set", "gamma"), "stage.field=value"),
        (("--images", "{drive}", "--truth", "{drive}/0000.png"), "wanted grey"),
        (("new-college", "--images", "{drive}"), "New College"),
    ],
)
def test_mistakes_are_one_line(run, drive, tmp_path, arguments, words):
    filled = [argument.format(drive=drive[0], truth=drive[1]) for argument in arguments]
    code, out, err = run(*filled, "--backbone", "efficientnet-lite0", "--out", tmp_path / "out")
    assert (code, out) == (1, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err


def test_a_video_has_no_files(small, tmp_path):
    cv2 = pytest.importorskip("cv2")
    file = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 64))
    for _ in range(5):
        writer.write(np.zeros((64, 64, 3), np.uint8))
    writer.release()
    with pytest.raises(ConfigError, match="video"):
        image_paths(ImageSequence(file))
