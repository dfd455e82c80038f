"""The path of the robot and the loops on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from loopclosure.errors import TruthError
from loopclosure.evaluation.truth import Truth
from loopclosure.report.pairs import Pair
from loopclosure.report.style import INK, MARKS, MUTED, dress, key, mark_handle, new_figure

_BAND: dict[str, Any] = {"color": "#56B4E9", "alpha": 0.45, "linewidth": 7, "solid_capstyle": "round"}


def trajectory(
    poses_xy_m: np.ndarray,
    loops: Sequence[Pair],
    truth: Truth | None = None,
    *,
    reference_xy_m: np.ndarray | None = None,
) -> Figure:
    """Draw the path in metres, each loop as a mark at its query and a line to its match.

    Parameters
    ----------
    poses_xy_m : ndarray of float, shape (frames, 2)
        Position of each frame, metres; NaN where it is not known.
    loops : sequence of Pair
        Accepted loops, by what truth says of them.
    truth : Truth, optional
        Frames that have a true match are drawn as a broad band.
    reference_xy_m : ndarray of float, shape (references, 2), optional
        Positions of the other traverse; one stream matches itself.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    TruthError
        If the poses are not of the same frames as the loops.
    """
    queries = _positions(poses_xy_m, last=max((loop.query for loop in loops), default=-1))
    references = queries if reference_xy_m is None else reference_xy_m
    references = _positions(references, last=max((loop.match for loop in loops), default=-1))
    figure = new_figure(6.4, 5.6)
    axes = figure.subplots()
    dress(axes, x="x (m)", y="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    if reference_xy_m is not None:
        axes.plot(*references.T, color=MUTED, linewidth=1, linestyle=":", label="reference path")
    if truth is not None:
        axes.plot(*_revisited(queries, truth).T, label="seen before (truth)", **_BAND)
    axes.plot(*queries.T, color=MUTED, linewidth=1.4, label="path")
    marks = [_draw_loops(axes, queries, references, loops, right) for right in MARKS]
    for name, row, below in (("start", 0, 7), ("end", -1, -14)) if len(queries) else ():
        axes.annotate(name, queries[row], (7, below), textcoords="offset points", color=INK, fontsize=8.5)
        axes.plot(*queries[row], marker="o", markersize=5, color=INK, markerfacecolor="white", zorder=5)
    key(figure, [*axes.get_legend_handles_labels()[0], *(mark for mark in marks if mark)])
    return figure


def _draw_loops(
    axes: Axes, queries: np.ndarray, references: np.ndarray, loops: Sequence[Pair], right: bool | None
) -> Line2D | None:
    """Draw the loops of one verdict and return their legend entry."""
    chosen = [loop for loop in loops if loop.right is right]
    if not chosen:
        return None
    mark = MARKS[right]
    starts, ends = queries[[loop.query for loop in chosen]], references[[loop.match for loop in chosen]]
    lines = list(np.stack([starts, ends], axis=1))
    axes.add_collection(LineCollection(lines, colors=mark.color, linestyles=mark.dashes, linewidths=0.8, alpha=0.7))
    x, y = starts.T
    axes.scatter(x, y, s=24, marker=mark.marker, color=mark.color, edgecolors="white", linewidths=0.5, zorder=4)
    return mark_handle(mark, line=True)


def _revisited(queries: np.ndarray, truth: Truth) -> np.ndarray:
    """Return the positions of frames that have a true match, NaN for the others."""
    if truth.n_queries != len(queries):
        raise TruthError(f"there are {len(queries)} poses, but the truth has {truth.n_queries} queries")
    return np.where((truth.matches_per_query() > 0)[:, None], queries, np.nan)


def _positions(poses: np.ndarray, *, last: int) -> np.ndarray:
    if poses.ndim != 2 or poses.shape[1] != 2 or len(poses) <= last:
        raise TruthError(f"the poses are of shape {poses.shape}, wanted (frames, 2) with at least {last + 1} frames")
    return poses
