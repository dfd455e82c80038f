"""A folder in batches, a camera frame by frame, one runtime or the other: the same decisions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ImageError
from loopclosure.images import ImageSequence
from loopclosure.images.simulator import SimulationSettings, simulate

CONFIG = Config().with_settings(
    {
        "sequence.length": 3,
        "sequence.exclude_recent": 10,
        "aggregation.clusters": 8,
        "learning.refit_at": "",
        "decision.consistency": 3,
    }
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = SimulationSettings(frames=40, spacing_m=6.0, width=160, height=120, parked_cars=False)
    return simulate(tmp_path_factory.mktemp("speed") / "drive", settings) / "images"


def test_batches_decide_as_single_frames_do(drive: Path) -> None:
    images = list(ImageSequence(drive).reduced(224, 224))
    one, many = LoopDetector(CONFIG), LoopDetector(CONFIG)
    alone = [one.add(image) for image in images]
    together = list(many.detect(ImageSequence(drive)))
    assert any(decision.accepted for decision in alone)
    for a, b in zip(alone, together, strict=True):
        assert (a.query, a.match, a.accepted, a.reason) == (b.query, b.match, b.accepted, b.reason)
        assert (a.score is None) == (b.score is None)
        if a.score is not None and b.score is not None:
            assert a.score == pytest.approx(b.score, abs=1e-4)


def test_both_runtimes_decide_alike(drive: Path) -> None:
    runs = [
        list(LoopDetector(CONFIG.with_settings({"features.backend": name})).detect(ImageSequence(drive)))
        for name in ("torch", "openvino")
    ]
    for a, b in zip(*runs, strict=True):
        assert (a.match, a.accepted, a.reason) == (b.match, b.accepted, b.reason)


def test_frames_before_a_bad_one_are_decided() -> None:
    images = [np.full((32, 32, 3), level, np.uint8) for level in range(5)] + [np.zeros((4, 4), np.uint8)]
    decisions = LoopDetector(CONFIG).detect(images)
    assert [next(decisions).query for _ in range(5)] == list(range(5))
    with pytest.raises(ImageError):
        next(decisions)
