"""Small photographs that the tests paint themselves."""

from __future__ import annotations

import csv

import cv2
import numpy as np
import pytest
import torch

from loopclosure import Config

SMALL = {
    "features.backbone": "resnet18",
    "features.layer": "conv3",
    "features.weights": "random",
    "features.height": 32,
    "features.width": 32,
    "features.backend": "torch",
    "aggregation.clusters": 4,
    "sequence.exclude_recent": 8,
    "sequence.length": 3,
    "training.epochs": 2,
    "training.batch": 4,
    "training.positive_m": 1.5,
    "training.negative_m": 3.0,
}


@pytest.fixture(scope="session")
def small():
    """Settings under which a training takes a second."""
    return Config().with_settings(SMALL)


@pytest.fixture(scope="session")
def class_tree(tmp_path_factory):
    """Three classes of eight images: stripes along, stripes across, spots."""
    folder = tmp_path_factory.mktemp("classes")
    rng = np.random.default_rng(0)
    for name, shape in (("across", (8, 1)), ("along", (1, 8)), ("spots", (8, 8))):
        (folder / name).mkdir()
        for i in range(8):
            image = cv2.resize(rng.integers(0, 255, (*shape, 3), dtype=np.uint8), (40, 40))
            cv2.imwrite(str(folder / name / f"{i}.png"), image)
    return folder


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """A round of sixteen views along a wall, driven twice, with poses; the second time one pixel aside."""
    folder = tmp_path_factory.mktemp("drive")
    wall = cv2.resize(np.random.default_rng(0).integers(0, 255, (6, 40, 3), dtype=np.uint8), None, fx=8, fy=8)
    with open(folder / "poses.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", "x", "y"])
        for frame in range(32):
            lap, place = divmod(frame, 16)
            view = wall[lap : lap + 40, 16 * place + lap : 16 * place + lap + 40]
            cv2.imwrite(str(folder / f"{frame:02}.png"), view)
            angle = 2 * np.pi * place / 16
            rows.writerow([frame, 4 * np.cos(angle), 4 * np.sin(angle)])
    return folder


@pytest.fixture
def same_threads():
    """One thread, so that a sum has one order wherever it is made."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
