"""Inlier matches drawn over the two frames that they join."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from loopclosure.report.style import INK, MARKS, new_figure
from loopclosure.verification import GRID, Verification, cells

_WIDTH, _HEAD, _GAP = 9.6, 0.6, 0.02  # inches, inches, share of the width of the query
_MOST_LINES = 80
_DIMMED, _UNVERIFIED = 0.4, "#56B4E9"


def draw_verification(
    query: np.ndarray,
    match: np.ndarray,
    verification: Verification,
    names: tuple[str, str] = ("query", "match"),
) -> Figure:
    """Draw two frames side by side, every inlier as a dot, lines between them, and the cells without inliers dimmed.

    Parameters
    ----------
    query, match : ndarray of uint8, shape (h, w, 3)
        RGB.
    verification : Verification
        Of these two images, in this order.
    names : tuple of str
        Written above the images.

    Returns
    -------
    matplotlib.figure.Figure
        At most 80 lines, evenly chosen, so that the images stay visible.
    """
    height, width = query.shape[:2]
    scale = height / match.shape[0]  # both are shown equally high
    left, right = width * (1 + _GAP), width * (1 + _GAP) + match.shape[1] * scale
    figure = new_figure(_WIDTH, _WIDTH * min(2.0, height / right) + _HEAD)
    axes = figure.subplots()
    axes.set(xlim=(0, right), ylim=(height, 0), aspect="equal")
    axes.set_axis_off()
    starts, ends = verification.query_points + 0.5, (verification.match_points + 0.5) * scale + (left, 0)
    _show(axes, query, (0, width, height, 0), verification.query_points)
    _show(axes, match, (left, right, height, 0), verification.match_points)
    color = MARKS[True].color if verification.verified else _UNVERIFIED
    chosen = np.linspace(0, len(starts) - 1, min(len(starts), _MOST_LINES)).astype(int)
    axes.add_collection(
        LineCollection(list(np.stack([starts[chosen], ends[chosen]], axis=1)), colors=color, linewidths=0.7, alpha=0.8)
    )
    for points in (starts, ends):
        axes.plot(*points.T, "o", markersize=3, color=color, markeredgecolor="white", markeredgewidth=0.4)
    for x, name in zip((0, left), names, strict=True):
        axes.text(x, -0.02 * height, name, va="bottom", fontsize=9.5, color=INK, parse_math=False)
    axes.text(0, 1.03 * height, caption(verification), va="top", fontsize=9.5, color=INK)
    return figure


def caption(verification: Verification) -> str:
    """Say in one line what was found.

    Examples
    --------
    >>> none = np.zeros((0, 2), np.float32)
    >>> caption(Verification(False, 0, 0.0, 4, None, none, none))
    'not verified: 0 of 4 matches agree, in 0 of 192 cells (support 0.0)'
    """
    found = verification
    total = GRID[0] * GRID[1]
    return (
        f"{'verified' if found.verified else 'not verified'}: {found.inliers} of {found.matches} matches agree, "
        f"in {round(found.spread * total)} of {total} cells (support {found.support:.1f})"
    )


def _show(axes: Axes, image: np.ndarray, extent: tuple[float, float, float, float], points: np.ndarray) -> None:
    """Draw an image, with a veil over the cells in which no inlier lies."""
    axes.imshow(image, extent=extent)
    columns, rows = GRID
    filled = cells(points, (image.shape[1], image.shape[0]))
    left, right, bottom, top = extent
    width, height = (right - left) / columns, (bottom - top) / rows
    for row, column in np.argwhere(~filled):
        corner = left + column * width, top + row * height
        axes.add_patch(Rectangle(corner, width, height, color="black", alpha=_DIMMED, linewidth=0))
