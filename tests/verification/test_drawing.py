"""The picture of a verification shows what was found."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.report.style import png
from loopclosure.report.verification import draw_verification
from loopclosure.verification import GRID, Verification, cells


@pytest.mark.parametrize("count", [0, 3, 500])
@pytest.mark.parametrize("shape", [(60, 100, 3), (200, 50, 3)])
def test_dots_lines_and_dimmed_cells(count, shape):
    rng = np.random.default_rng(count)
    query, match = np.full((90, 160, 3), 200, np.uint8), np.full(shape, 200, np.uint8)
    left = rng.uniform(0, (159, 89), (count, 2)).astype(np.float32)
    right = rng.uniform(0, (shape[1] - 1, shape[0] - 1), (count, 2)).astype(np.float32)
    found = Verification(False, count, 0.1, 600, "fundamental", left, right)
    figure = draw_verification(query, match, found, ("a $b", "c"))
    axes = figure.axes[0]
    (lines,) = axes.collections
    assert len(lines.get_segments()) == min(count, 80)
    assert [len(dots.get_xdata()) for dots in axes.lines] == [count, count]
    dark = (~cells(left, (160, 90))).sum() + (~cells(right, shape[1::-1])).sum()
    assert len(axes.patches) == dark
    if count:
        start, end = lines.get_segments()[0]
        np.testing.assert_allclose(start, left[0] + 0.5, rtol=1e-5)
        scale = 90 / shape[0]
        np.testing.assert_allclose(end, (right[0] + 0.5) * scale + [160 * 1.02, 0], rtol=1e-5)
    said = [text.get_text() for text in axes.texts]
    assert f"not verified: {count} of 600 matches agree, in 19 of {GRID[0] * GRID[1]} cells" in said[-1]
    assert said[:2] == ["a $b", "c"]
    assert png(figure).startswith(b"\x89PNG")
