"""Every form of training data, and what is wrong with it in one line."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from loopclosure import Config
from loopclosure.errors import FitError, ImageError, TruthError
from loopclosure.training.data import open_data
from loopclosure.training.places import LabelledPlaces, ListedPlaces, PosedPlaces


def test_a_class_tree(class_tree, small):
    data = open_data(class_tree, config=small)
    assert isinstance(data.places, LabelledPlaces)
    assert np.bincount(data.places.labels).tolist() == [8, 8, 8]
    assert data.images[0].shape == (40, 40, 3)
    assert data.summary.startswith("24 images of 3 classes")


def test_a_list_of_pairs(class_tree, small, tmp_path):
    file = tmp_path / "pairs.csv"
    shutil.copytree(class_tree, tmp_path / "images")
    rows = [f"images/along/{i}.png,images/{('along', 'spots')[i % 2]}/{i + 1}.png,{1 - i % 2}" for i in range(6)]
    file.write_text("first,second,same\n" + "\n".join(rows) + "\n")
    data = open_data(file, config=small)
    assert isinstance(data.places, ListedPlaces)
    assert data.places.same.tolist() == [True, False] * 3
    assert len(data.images) == 6 + 3 + 1 - 1
    assert data.images[0].shape == (40, 40, 3)


def test_a_sequence_with_poses(drive, small):
    data = open_data(drive, poses=drive / "poses.csv", config=small)
    assert isinstance(data.places, PosedPlaces)
    assert data.places.relation(np.array([16]), np.arange(32))[0, 0] == 1
    assert len(data.images) == 32


def tree(folder, **classes):
    for name, count in classes.items():
        (folder / name).mkdir(parents=True)
        for i in range(count):
            (folder / name / f"{i}.png").write_bytes(b"x")
    return folder


def test_one_class_is_an_error(tmp_path, small):
    with pytest.raises(FitError, match="holds 1 class folder, wanted at least 2"):
        open_data(tree(tmp_path, only=5), config=small)


def test_an_empty_class_is_an_error_that_names_it(tmp_path, small):
    with pytest.raises(FitError, match="without images: b"):
        open_data(tree(tmp_path, a=5, b=0), config=small)


def test_a_small_class_is_an_error_that_names_it(tmp_path, small):
    with pytest.raises(FitError, match="few holds 3 images"):
        open_data(tree(tmp_path, many=5, few=3), config=small)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("first,second,same\nabsent.png,along/1.png,1\n", ImageError, "line 2: there is no image file"),
        ("first,second,same\nalong/0.png,along/1.png,yes\n", FitError, "line 2: found"),
        ("first,second\n", FitError, "wanted first,second,same"),
        ("", FitError, "wanted first,second,same"),
        ("first,second,same\nalong/0.png,along/1.png,1\n", FitError, "1 pairs of one place and 0 of two"),
    ],
)
def test_bad_lists_of_pairs(class_tree, small, text, error, words):
    file = class_tree / "pairs.csv"
    file.write_text(text)
    with pytest.raises(error, match=words):
        open_data(file, config=small)
    file.unlink()


def test_bad_poses(drive, class_tree, small, tmp_path):
    short = tmp_path / "poses.csv"
    short.write_text("frame,x,y\n0,0,0\n")
    with pytest.raises(TruthError, match="1 poses"):
        open_data(drive, poses=short, config=small)
    pairs = tmp_path / "truth.csv"
    pairs.write_text("query,match\n1,0\n")
    with pytest.raises(TruthError, match="wanted poses"):
        open_data(drive, poses=pairs, config=small)
    with pytest.raises(TruthError, match="no file of poses"):
        open_data(drive, poses=tmp_path / "absent.csv", config=small)


def test_a_drive_without_a_second_visit_is_an_error(drive, small):
    once = small.with_settings({"sequence.exclude_recent": 30})
    with pytest.raises(FitError, match=r"no frame .* has another visit"):
        open_data(drive, poses=drive / "poses.csv", config=once)
    everywhere = small.with_settings({"training.negative_m": 100.0})
    with pytest.raises(FitError, match="100 m apart"):
        open_data(drive, poses=drive / "poses.csv", config=everywhere)


def test_neither_form(tmp_path):
    with pytest.raises(FitError, match="neither a folder"):
        open_data(tmp_path / "absent", config=Config())
