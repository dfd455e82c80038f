"""The layout of a map: position by position, neighbouring columns joined."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.aggregation.layout import layout


@pytest.mark.parametrize("width", [1, 2, 7, 14])
def test_each_number_is_the_mean_of_two_columns(width):
    maps = np.random.default_rng(0).normal(size=(3, 4, width, 5)).astype(np.float32)
    expected = np.array(
        [
            [
                maps[n, row, start : start + 2, channel].mean()
                for row in range(4)
                for start in range(0, width, 2)
                for channel in range(5)
            ]
            for n in range(3)
        ]
    )
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(layout(maps), expected, atol=1e-6)


def test_things_that_change_places_change_it_and_a_blank_map_gives_zeros():
    maps = np.abs(np.random.default_rng(1).normal(size=(1, 4, 8, 5))).astype(np.float32)
    assert layout(maps)[0] @ layout(maps[:, :, ::-1])[0] < 0.95
    assert not layout(np.zeros_like(maps)).any()
