"""A run that was interrupted goes on as if nothing had happened."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.config import Config
from loopclosure.errors import ConfigError, ImageError
from loopclosure.runs import detect_loops

FRAMES = 36
CONFIG = Config().with_settings({"method": "seqslam", "sequence.length": 3, "sequence.exclude_recent": 10})
FILES = ("loops.csv", "scores.npy")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two laps along one wall of noise."""
    folder = tmp_path_factory.mktemp("drive")
    wall = cv2.resize(np.random.default_rng(0).integers(0, 256, (6, 60, 3), np.uint8), (960, 96))
    for frame in range(FRAMES):
        left = 40 * (frame % (FRAMES // 2))
        cv2.imwrite(str(folder / f"{frame}.png"), wall[:, left : left + 128])
    return folder


@pytest.fixture(scope="module")
def whole(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    run = detect_loops(drive, out, config=CONFIG, save_scores=True)
    assert any(decision.accepted for decision in run.decisions)
    return out


class BrokenError(Exception):
    pass


def broken_at(frames: int):
    def progress(stage: str, done: int, _total: int) -> None:
        if (stage, done) == ("finding loops", frames):
            raise BrokenError

    return progress


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("stops", [(1,), (13,), (5, 6, 30)])
def test_an_interrupted_run_ends_as_the_uninterrupted_one(drive: Path, whole: Path, tmp_path: Path, stops) -> None:
    for number, stop in enumerate(stops):
        with pytest.raises(BrokenError):
            detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, resume=number > 0, progress=broken_at(stop))
        reported = (tmp_path / "loops.csv.part").read_bytes()
        assert reported.count(b"\n") == stop + 1
        assert (whole / "loops.csv").read_bytes().startswith(reported)
        assert not (tmp_path / "loops.csv").exists()
    run = detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, resume=True)
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()
    assert names(tmp_path) == names(whole)
    assert [decision.query for decision in run.decisions] == list(range(FRAMES))
    again = detect_loops(drive, tmp_path / "again", config=CONFIG)
    np.testing.assert_array_equal(run.matrix, again.matrix)


def test_against_a_reference(drive: Path, tmp_path: Path) -> None:
    config = CONFIG.with_settings({"method": "kl-netvlad", "aggregation.clusters": 4})
    detect_loops(drive, tmp_path / "whole", reference=drive, config=config)
    with pytest.raises(BrokenError):
        detect_loops(drive, tmp_path / "run", reference=drive, config=config, progress=broken_at(20))
    run = detect_loops(drive, tmp_path / "run", reference=drive, config=config, resume=True)
    assert (tmp_path / "run/loops.csv").read_bytes() == (tmp_path / "whole/loops.csv").read_bytes()
    assert run.reference_images is not None
    assert run.info["references"] == FRAMES


def test_a_killed_run_goes_on_from_its_last_state(drive: Path, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(BrokenError):
        detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, progress=broken_at(20))
    with open(tmp_path / "loops.csv.part", "ab") as rows:
        rows.write((whole / "loops.csv").read_bytes().splitlines(keepends=True)[21] + b"21,")
    with open(tmp_path / "scores.npy.rows", "ab") as rows:
        rows.write(b"torn")
    detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, resume=True)
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_a_damaged_image_can_be_mended_or_skipped(drive: Path, whole: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in drive.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    (copy / "25.png").write_bytes(b"")
    for out in ("mended", "skipped"):
        with pytest.raises(ImageError, match="is empty"):
            detect_loops(copy, tmp_path / out, config=CONFIG)
        assert (tmp_path / out / "loops.csv.part").read_text().splitlines()[-1].startswith("24,")
    skip = CONFIG.with_settings({"images.on_error": "skip"})
    run = detect_loops(copy, tmp_path / "skipped", config=skip, resume=True)
    assert run.decisions[25].reason == "unreadable"
    (copy / "25.png").write_bytes((drive / "25.png").read_bytes())
    detect_loops(copy, tmp_path / "mended", config=CONFIG, resume=True)
    assert (tmp_path / "mended/loops.csv").read_bytes() == (whole / "loops.csv").read_bytes()


def test_what_does_not_belong_together_is_refused(drive: Path, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no interrupted run"):
        detect_loops(drive, whole, config=CONFIG, save_scores=True, resume=True)
    with pytest.raises(BrokenError):
        detect_loops(drive, tmp_path, config=CONFIG, progress=broken_at(20))
    other = CONFIG.with_settings({"sequence.length": 4})
    with pytest.raises(ConfigError, match=r"had sequence\.length = 3, wanted 4"):
        detect_loops(drive, tmp_path, config=other, resume=True)
    with pytest.raises(ConfigError, match="--save-scores = False, wanted True"):
        detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, resume=True)
    (drive / "0a.png").write_bytes((drive / "0.png").read_bytes())
    try:
        with pytest.raises(ConfigError, match="no longer begins with the frames"):
            detect_loops(drive, tmp_path, config=CONFIG, resume=True)
    finally:
        (drive / "0a.png").unlink()
    detect_loops(drive, tmp_path, config=CONFIG)  # a new run forgets the old one
    assert "checkpoint" not in names(tmp_path)


def test_a_run_killed_before_its_first_state_begins_again(drive: Path, whole: Path, tmp_path: Path) -> None:
    (tmp_path / "loops.csv.part").write_text("query,ma")
    detect_loops(drive, tmp_path, config=CONFIG, save_scores=True, resume=True)
    assert (tmp_path / "loops.csv").read_bytes() == (whole / "loops.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C reaches other processes in another way")
def test_ctrl_c(drive: Path, tmp_path: Path) -> None:
    long = tmp_path / "long.txt"
    files = sorted(drive.iterdir(), key=lambda file: int(file.stem))
    long.write_text("\n".join(map(str, files * 15)))
    flags = ["--method", "seqslam", "--sequence-length", "3", "--exclude-recent", "10", "--quiet"]
    command = [sys.executable, "-c", "from loopclosure.cli import main; main()", "detect", str(long), *flags]
    process = subprocess.Popen([*command, "--out", str(tmp_path / "run")], stderr=subprocess.PIPE, text=True)
    rows = tmp_path / "run" / "loops.csv.part"
    while not rows.exists() or rows.stat().st_size < 500:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "detect --resume` goes on from there" in errors
    done = rows.read_bytes()
    assert 10 < done.count(b"\n") < 15 * FRAMES
    subprocess.run([*command, "--out", str(tmp_path / "run"), "--resume"], check=True)
    assert (tmp_path / "run" / "loops.csv").read_bytes().startswith(done)
    subprocess.run([*command, "--out", str(tmp_path / "whole")], check=True)
    assert (tmp_path / "run" / "loops.csv").read_bytes() == (tmp_path / "whole" / "loops.csv").read_bytes()
