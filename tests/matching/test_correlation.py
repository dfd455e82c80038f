"""Correlation of thumbnails after sideways shifts, against a plain reading, and standard deviations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.thumbnails import low_frequencies
from loopclosure.matching.correlation import CorrelationMap
from loopclosure.matching.standard import standard_deviations

SHIFTS = (-4, -2, 0, 3)


def thumbnails(n, seed=0, width=16):
    return np.random.default_rng(seed).normal(size=(n, 8, width)).astype(np.float32)


def fill(places, stack):
    for thumbnail in stack:
        places.add(thumbnail)
    return places


def plain_row(query, references, shifts):
    """Correlate one reference and one shift at a time."""
    width = query.shape[1]
    products = np.zeros((len(references), len(shifts)))
    for column, shift in enumerate(shifts):
        moved = np.zeros_like(query)
        for x in range(width):
            if 0 <= x + shift < width:
                moved[:, x] = query[:, x + shift]
        view = low_frequencies(moved[None])[0].astype(float)
        for row, reference in enumerate(references):
            code = low_frequencies(reference[None])[0].astype(float)
            lengths = math.sqrt(view @ view) * math.sqrt(code @ code * (width - abs(shift)) / width)
            products[row, column] = view @ code / lengths if lengths else 0
    best = [max(line - products.mean(axis=0)) for line in products]
    return (best - np.mean(best)) / np.std(best)


@pytest.mark.parametrize("shifts", [(0,), SHIFTS])
def test_equals_a_plain_reading(shifts):
    references, query = thumbnails(30), thumbnails(1, seed=1)[0]
    references[7] = 0
    row = fill(CorrelationMap(shifts=shifts), references).similarities(query)
    # Half precision is exact to 2 ** -9 of a product; products differ by 0.1 here.
    np.testing.assert_allclose(row, plain_row(query, references, shifts), atol=0.05)


@pytest.mark.parametrize("n", [40, 1023, 1024, 1060])
def test_recent_frames_are_left_out_of_the_statistics_too(n):
    stack = thumbnails(n + 1)
    row = fill(CorrelationMap(exclude_recent=31), stack[:n]).similarities(stack[n])
    candidates = [j for j in range(n) if n - j >= 31]
    assert np.isneginf(np.delete(row, candidates)).all()
    alone = fill(CorrelationMap(), stack[candidates]).similarities(stack[n])
    np.testing.assert_allclose(row[candidates], alone, atol=1e-5)
    assert (row[candidates].mean(), row[candidates].std()) == pytest.approx((0, 1), abs=1e-4)


@pytest.mark.parametrize("shift", SHIFTS)
def test_a_camera_that_looks_aside_is_found_by_shifting(shift):
    wide = thumbnails(20, width=24)
    places = fill(CorrelationMap(shifts=SHIFTS), wide[:, :, 4:20])
    row = places.similarities(wide[5, :, 4 - shift : 20 - shift])
    assert row.argmax() == 5
    assert row[5] > 3


def test_what_all_places_share_does_not_choose_the_shift():
    rim, stack = 2 * thumbnails(1, seed=9)[0], thumbnails(20)
    places = fill(CorrelationMap(shifts=SHIFTS), stack + rim)
    assert places.similarities(stack[3] + rim).argmax() == 3


def test_nothing_says_nothing():
    assert CorrelationMap().similarities(thumbnails(1)[0]).shape == (0,)
    places = fill(CorrelationMap(shifts=SHIFTS), thumbnails(5))
    assert places.similarities(np.zeros((8, 16), np.float32)).tolist() == [0] * 5
    blank = fill(CorrelationMap(shifts=SHIFTS), np.zeros((3, 8, 16), np.float32))
    assert blank.similarities(thumbnails(1)[0]).tolist() == [0] * 3
    assert CorrelationMap().restore(CorrelationMap().to_arrays()).nbytes == 0


def test_a_map_comes_back():
    places = fill(CorrelationMap(shifts=SHIFTS), thumbnails(1030))
    again = CorrelationMap(shifts=SHIFTS).restore(places.to_arrays())
    assert (len(again), again.nbytes) == (len(places), 1030 * 2 * 9 * 8)
    query = thumbnails(1, seed=1)[0]
    np.testing.assert_array_equal(again.similarities(query), places.similarities(query))


@pytest.mark.parametrize("shifts", [(), (0, 16), (-16,)])
def test_shifts_that_leave_nothing_are_refused(shifts):
    with pytest.raises(ConfigError, match="shifts"):
        fill(CorrelationMap(shifts=shifts), thumbnails(1)).similarities(thumbnails(1)[0])


def test_thumbnails_of_different_sizes_are_refused():
    with pytest.raises(ModelError, match="made alike"):
        fill(CorrelationMap(), thumbnails(1)).add(thumbnails(1, width=20)[0])


def test_standard_deviations():
    row = np.array([2.0, 4.0, 6.0, 10.0])
    np.testing.assert_allclose(standard_deviations(row, 3), (row - 4) / math.sqrt(8 / 3))
    for candidates in (0, 1):
        assert standard_deviations(row, candidates).tolist() == [0] * 4
    assert standard_deviations(np.full(5, 0.1), 5).tolist() == [0] * 5
    assert standard_deviations(np.zeros(0), 0).shape == (0,)
