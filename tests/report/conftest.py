"""Runs made by hand: the images are drawn here, the decisions are chosen."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from handmade import decide, write_images

from loopclosure.config import Config
from loopclosure.evaluation import Truth, load_truth
from loopclosure.images.sequence import ImageSequence
from loopclosure.runs import Run

MakeRun = Callable[..., Run]


@pytest.fixture(scope="session")
def drawn_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("drawn") / "images", 40)


@pytest.fixture
def folder(drawn_images: Path, tmp_path: Path) -> Path:
    """40 images that the test may spoil."""
    return Path(shutil.copytree(drawn_images, tmp_path / "images"))


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    def make(images, decisions, *, references="same", matrix=None, weights="efficientnet-lite0", **info) -> Run:
        """`references` are "same" in one stream, otherwise an ImageSequence, or None with a saved detector."""
        rows = len(decisions)
        columns = info.get("references") or rows
        out = tmp_path / "run"
        out.mkdir(exist_ok=True)
        facts = {
            "loopclosure": "0.1.0",
            "config": Config().model_dump(),
            "threshold": 0.6,
            "weights": {"weights": weights, "weights_sha256": "0123456789abcdef" * 4},
            "learned_on": ["frames 0 to 29 of the drive"],
            "seconds": {"features": 2.0, "learn": 1.0, "describe": 0.1, "match": 0.1, "total": 4.0},
            "versions": {"python": "3.11.0", "numpy": "2.0.0"},
            "machine": {"system": "Linux", "processor": "", "cores": 2},
            "source": str(images.source),
            "reference": None,
            "frames": rows,
            "references": None,
        } | info
        cells = np.full((rows, columns), np.nan, np.float32) if matrix is None else matrix
        return Run(out, tuple(decisions), facts, cells, images, images if references == "same" else references)

    return make


@pytest.fixture
def drive(make_run: MakeRun, folder: Path) -> Run:
    """40 frames, the last 20 drive the first 20 again; frame 30 is matched wrongly, 35 is not accepted."""
    matches = {query: query - 20 for query in range(20, 40)} | {30: 3}
    decisions = [decide(query, matches.get(query), 0.6 + query / 200, accepted=query != 35) for query in range(40)]
    scores = np.random.default_rng(0).uniform(0.3, 0.9, (40, 40)).astype(np.float32)
    scores[np.arange(40)[:, None] - np.arange(40) < 15] = np.nan
    return make_run(ImageSequence(folder), decisions, matrix=scores)


@pytest.fixture
def make_truth(tmp_path: Path) -> Callable[..., Truth]:
    def make(pairs, frames) -> Truth:
        file = tmp_path / "truth.csv"
        file.write_text("query,match\n" + "".join(f"{query},{match}\n" for query, match in pairs))
        return load_truth(file, frames=frames)

    return make


@pytest.fixture
def drive_truth(make_truth) -> Truth:
    return make_truth([(query, query - 20) for query in range(20, 40)], (40, None))
