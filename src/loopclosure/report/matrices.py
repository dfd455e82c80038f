"""The score matrix, with the loops that were accepted and the loops that there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from loopclosure.evaluation.truth import Truth
from loopclosure.report.pairs import Pair
from loopclosure.report.style import EMPTY, GRID, INK, MAP, MARKS, MUTED, dress, key, mark_handle, new_figure

_NONE, _IGNORED, _TRUE = 0, 1, 2
_TRUTH_COLORS = ("#f7f8f9", "#ccd2d9", "#56B4E9")
_LONGEST = 3  # a matrix more elongated than this is not drawn to scale


def similarity_matrix(
    matrix: np.ndarray,
    *,
    frames: tuple[int, int] | None = None,
    truth: Truth | None = None,
    loops: Sequence[Pair] = (),
    distance: bool = False,
) -> Figure:
    """Draw sequence scores and, beside them, truth.

    Parameters
    ----------
    matrix : ndarray of float, shape (rows, columns)
        Scores, larger = more alike, NaN where no pair is a candidate; one cell may stand for several frames.
    frames : tuple of n_queries and n_references, optional
        What the matrix shows; its own shape if absent.
    truth : Truth, optional
        Drawn in a second panel, for the same frames.
    loops : sequence of Pair
        Accepted loops, drawn over both panels, by what truth says of them.
    distance : bool
        Draw 1 - score in place of the score.

    Returns
    -------
    matplotlib.figure.Figure
        Queries run down, matches run right.
    """
    frames = frames or (matrix.shape[0], matrix.shape[1])
    step = max(1, -(-max(frames) // max(1, *matrix.shape)))
    figure = new_figure(5.6 if truth is None else 10, 5.2, gap=0.06)
    panels = figure.subplots(1, 1 if truth is None else 2, squeeze=False)[0]
    _draw_scores(panels[0], 1 - matrix if distance else matrix, step, distance=distance)
    if truth is not None:
        _draw_truth(panels[1], truth, step)
    for axes in panels:
        _draw_loops(axes, loops)
        _frame(axes, frames)
    key(figure, _legend(matrix, loops, truth))
    return figure


def _draw_scores(axes: Axes, values: np.ndarray, step: int, *, distance: bool) -> None:
    shown = np.ma.masked_invalid(values)
    dress(axes, title="Distances" if distance else "Scores", x="match (frame)", y="query (frame)", grid=False)
    axes.add_patch(
        Rectangle((0, 0), 1, 1, transform=axes.transAxes, facecolor=EMPTY, edgecolor=GRID, hatch="////", zorder=-1)
    )
    if not shown.count():
        axes.text(0.5, 0.5, "no pair was a candidate", ha="center", va="center", color=MUTED, transform=axes.transAxes)
        return
    picture = axes.imshow(shown, cmap=MAP, extent=_extent(values.shape, step), interpolation_stage="rgba")
    bar = axes.figure.colorbar(picture, ax=axes, shrink=0.6, pad=0.02, aspect=30)
    bar.set_label("distance, 1 - score" if distance else "score, larger = more alike", color=INK, fontsize=9)
    bar.ax.tick_params(colors=MUTED, labelsize=8.5, length=3)
    bar.outline.set_visible(False)


def _draw_truth(axes: Axes, truth: Truth, step: int) -> None:
    cells = np.full((-(-truth.n_queries // step), -(-truth.n_references // step)), _NONE, np.uint8)
    for pairs, kind in ((truth.ignored, _IGNORED), (truth.pairs, _TRUE)):
        rows, columns = pairs.nonzero()
        cells[rows // step, columns // step] = kind
    dress(axes, title="Truth", x="match (frame)", y="query (frame)", grid=False)
    colors = ListedColormap(_TRUTH_COLORS)
    extent = _extent(cells.shape, step)
    axes.imshow(cells, cmap=colors, vmin=_NONE, vmax=_TRUE, extent=extent, interpolation_stage="rgba")


def _draw_loops(axes: Axes, loops: Sequence[Pair]) -> None:
    for right, mark in MARKS.items():
        chosen = [loop for loop in loops if loop.right is right]
        x, y = [loop.match for loop in chosen], [loop.query for loop in chosen]
        size = 28 if right is False else 7  # a mistake must be found among hundreds
        axes.scatter(x, y, s=size, marker=mark.marker, color=mark.color, edgecolors="white", linewidths=0.3)


def _extent(shape: tuple[int, ...], step: int) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top in frames: the centre of frame 0 is at 0."""
    return -0.5, shape[1] * step - 0.5, shape[0] * step - 0.5, -0.5


def _frame(axes: Axes, frames: tuple[int, int]) -> None:
    """Show all frames and no more: the last cell may reach further."""
    axes.set(xlim=(-0.5, max(frames[1], 1) - 0.5), ylim=(max(frames[0], 1) - 0.5, -0.5))
    axes.set_aspect("equal" if max(frames) <= _LONGEST * min(frames) else "auto")


def _legend(matrix: np.ndarray, loops: Sequence[Pair], truth: Truth | None) -> list:
    handles: list = [mark_handle(mark) for right, mark in MARKS.items() if any(loop.right is right for loop in loops)]
    if truth is not None:
        handles.append(Patch(facecolor=_TRUTH_COLORS[_TRUE], label="true match"))
        if truth.ignored.nnz:
            handles.append(Patch(facecolor=_TRUTH_COLORS[_IGNORED], label="ignored by the truth"))
    if np.isnan(matrix).any():
        handles.append(Patch(facecolor=EMPTY, edgecolor=MUTED, hatch="////", linewidth=0, label="no candidate"))
    return handles
