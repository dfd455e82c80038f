"""What changes in the view counts; what rides along does not."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.aggregation.change import change
from loopclosure.aggregation.netvlad import NetVLAD


def by_definition(newest, before):
    changes = np.zeros(newest.shape[:2])
    for row in range(newest.shape[0]):
        for column in range(newest.shape[1]):
            a, b = newest[row, column].astype(float), before[row, column].astype(float)
            changes[row, column] = 1 - a @ b / np.sqrt((a @ a) * (b @ b))
    usual = float(np.quantile(changes, 0.75))
    share = np.minimum(np.maximum(changes / usual, 0.1), 1)
    return share if usual > 0.1 else share * usual / 0.1 + 1 - usual / 0.1


@pytest.mark.parametrize("noise", [0.01, 0.3, 3.0])
def test_weights_are_those_of_the_definition(noise):
    rng = np.random.default_rng(0)
    before = rng.normal(size=(6, 8, 12)).astype(np.float32)
    newest = before + noise * rng.normal(size=before.shape).astype(np.float32)
    np.testing.assert_allclose(change(newest, before), by_definition(newest, before), atol=1e-5)


def test_who_passes_a_standing_robot_is_not_all_that_counts():
    rng = np.random.default_rng(3)
    before = rng.normal(size=(8, 8, 12)).astype(np.float32)
    newest = before + 0.01 * rng.normal(size=before.shape).astype(np.float32)
    newest[2:5, 2:5] = rng.normal(size=(3, 3, 12))
    assert change(newest, before).min() > 0.99


def test_standing_still_all_positions_count_alike_and_blank_frames_do_no_harm():
    maps = np.random.default_rng(1).normal(size=(4, 5, 6)).astype(np.float32)
    assert np.ptp(change(maps, maps)) < 1e-5
    for pair in ((maps, 0 * maps), (0 * maps, maps), (0 * maps, 0 * maps)):
        assert np.isfinite(change(*pair)).all()


def test_netvlad_takes_each_position_as_often_as_it_counts():
    """A position of weight 2 is a position that stands twice in the map."""
    rng = np.random.default_rng(2)
    maps = rng.normal(size=(3, 4, 5, 6)).astype(np.float32)
    netvlad = NetVLAD(4).fit(maps)
    twice = rng.random((3, 4, 5)) < 0.5
    weighted = netvlad.transform(maps, 1 + twice.astype(np.float32))
    for one, double, found in zip(maps, twice, weighted, strict=True):
        repeated = np.concatenate([one.reshape(-1, 6), one[double]])[None, None]
        np.testing.assert_allclose(found, netvlad.transform(repeated)[0], atol=1e-5)
