"""The reliability curve against counts by hand."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.report.pairs import Pair
from loopclosure.report.reliability import reliability


def drawn(figure):
    """Return the points of the curve, and the ends of its bars."""
    (axes,) = figure.axes
    curve = axes.containers[0]
    bars = [segment for lines in curve.lines[2] for segment in lines.get_segments()]
    return curve.lines[0].get_xydata(), bars, [text.get_text() for text in axes.texts]


def pair(score, right):
    return Pair(0, 1, score, False, right)


def test_shares_and_counts_are_those_of_the_groups():
    pairs = [pair(0.95, True)] * 8 + [pair(0.91, False)] * 2 + [pair(0.01, False)] * 5 + [pair(0.6, None)] * 7
    points, bars, counts = drawn(reliability(pairs))
    np.testing.assert_allclose(points, [[0.01, 0.0], [0.942, 0.8]])
    assert counts == ["5", "10"]
    # Wilson's formula, by hand: (p + z2 / 2n -+ z sqrt(p q / n + z2 / 4n2)) / (1 + z2 / n)
    z = 1.959964
    for (x, share), bar, n in zip(points, bars, (5, 10), strict=True):
        half = z * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
        ends = (share + z**2 / (2 * n) + np.array([-half, half])) / (1 + z**2 / n)
        np.testing.assert_allclose(bar, [[x, ends[0]], [x, ends[1]]], atol=1e-6)


@pytest.mark.parametrize("score", [0.0, 1.0])
def test_the_ends_belong_to_the_outer_groups(score):
    points, _, counts = drawn(reliability([pair(score, True)]))
    assert points.tolist() == [[score, 1.0]]
    assert counts == ["1"]


@pytest.mark.parametrize("pairs", [[], [pair(0.5, None)]])
def test_without_truth_there_is_nothing_to_draw(pairs):
    assert reliability(pairs) is None
