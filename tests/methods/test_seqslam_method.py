"""SeqSLAM as the detector runs it: what is compared with what, in one stream and against a reference."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.errors import ConfigError
from loopclosure.features.thumbnails import thumbnails
from loopclosure.matching.differences import difference_matrix, enhance_row
from loopclosure.methods import build_method
from loopclosure.methods.seqslam import ContrastMap


def seqslam(**settings):
    settings = {name.replace("__", "."): value for name, value in settings.items()}
    return Config().with_settings({"method": "seqslam", **settings})


@pytest.mark.parametrize("n", [3, 1023, 1024, 1050, 1100])
def test_a_row_is_that_of_all_candidates_together(n):
    stack = np.random.default_rng(n).normal(size=(n + 1, 4, 20)).astype(np.float32)
    exclude = 31
    places = ContrastMap(exclude_recent=exclude)
    for thumbnail in stack[:n]:
        places.add(thumbnail)
    row = places.similarities(stack[n])
    candidates = [j for j in range(n) if n - j >= exclude]
    assert np.isneginf(np.delete(row, candidates)).all()
    wanted = enhance_row(difference_matrix(stack[n:], stack[candidates])[0])
    np.testing.assert_allclose(row[candidates], 1 - wanted, atol=1e-4)


@pytest.mark.parametrize("length", [1, 2, 5])
def test_a_sequence_has_so_many_frames(lap, length):
    detector = LoopDetector(seqslam(sequence__length=length))
    detector.set_reference(lap)
    decisions = list(detector.detect(lap))
    first = next(d.query for d in decisions if d.match is not None)
    assert first == max(length - 1, 1)  # a trajectory has two frames at least
    best = [d.score for d in decisions if d.match is not None]
    assert min(best) > 1  # standard deviations above the other places


def test_faithful_thumbnails_are_openseqslams(lap):
    method = build_method(seqslam(seqslam__faithful=True))
    np.testing.assert_array_equal(method.features(lap[:2]), thumbnails(lap[:2], patch=8, quantise=True))
    assert build_method(seqslam()).features(lap[:1])[0].dtype == np.float32


def test_recent_frames_are_no_matches(lap):
    detector = LoopDetector(seqslam(sequence__length=3, sequence__exclude_recent=6))
    decisions = list(detector.detect([*lap, *lap]))
    assert all(d.match is None or d.query - d.match >= 6 for d in decisions)
    assert [d.match for d in decisions[18:]] == list(range(2, 16))


def test_errors():
    with pytest.raises(ConfigError, match="driven forward alone"):
        build_method(seqslam(sequence__direction="both"))
    with pytest.raises(ConfigError, match="cannot be cut into patches"):
        build_method(seqslam(seqslam__width=66))


def test_day_right_against_day_left(data_folder):
    folder = data_folder / "gardens_point"
    left, right = (list(ImageSequence(folder / side))[:80] for side in ("day_left", "day_right"))
    detector = LoopDetector(seqslam())
    detector.set_reference(left)
    decisions = list(detector.detect(right))[9:]
    right = np.mean([abs(d.match - d.query) <= 2 for d in decisions])
    assert right >= 0.8  # the original finds 0.42 of the whole traverse
