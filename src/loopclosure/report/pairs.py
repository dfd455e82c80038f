"""Pairs of frames: what truth says of them, which to show, and how they look side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from loopclosure.errors import TruthError
from loopclosure.evaluation.truth import Truth
from loopclosure.perception import Frames
from loopclosure.records import Decision
from loopclosure.report.style import EMPTY, INK, MARKS, MUTED, new_figure

_ACROSS = 2  # pairs in a row
_WIDTH, _TITLE = 9.6, 0.35  # inches
_SHAPE = 0.7  # height over width where there is no image


class Pair(NamedTuple):
    """The best candidate of a frame.

    Attributes
    ----------
    query, match : int
        0-based positions.
    score : float
        Larger = more alike.
    accepted : bool
        Whether it was reported as a loop.
    right : bool or None
        What truth says; None where there is no truth or it ignores the pair.
    """

    query: int
    match: int
    score: float
    accepted: bool
    right: bool | None = None


def judge(decisions: Iterable[Decision], truth: Truth | None = None, *, tolerance: int = 0) -> list[Pair]:
    """Return the candidates of all decisions that have one, in order, with the verdict of truth.

    Parameters
    ----------
    decisions : iterable of Decision
        One a frame.
    truth : Truth, optional
        For the same frames.
    tolerance : int
        A match within so many reference frames of a true match of its query is right.

    Returns
    -------
    list of Pair

    Raises
    ------
    TruthError
        If the truth is of another size than the decisions.

    Examples
    --------
    >>> from loopclosure.records import Reason
    >>> judge([Decision(0, None, None, False, None, Reason.TOO_RECENT), Decision(1, 0, 0.9, True, None, "accepted")])
    [Pair(query=1, match=0, score=0.9, accepted=True, right=None)]
    """
    rows = list(decisions)
    pairs = [Pair(d.query, d.match, d.score, d.accepted) for d in rows if d.match is not None and d.score is not None]
    if truth is None:
        return pairs
    if truth.n_queries != len(rows) or max((pair.match for pair in pairs), default=-1) >= truth.n_references:
        raise TruthError(
            f"the truth has {truth.n_queries} queries and {truth.n_references} references, the run {len(rows)} frames: "
            "are they of one sequence?"
        )
    query, match = (np.array([pair[side] for pair in pairs], np.int64) for side in (0, 1))
    right = truth.frames_off(query, match) <= tolerance
    told = truth.allows(query, match) & (right | ~truth.is_ignored(query, match))
    return [
        pair._replace(right=bool(yes)) if known else pair for pair, yes, known in zip(pairs, right, told, strict=True)
    ]


def spread(pairs: Iterable[Pair], most: int, *, apart: int) -> list[Pair]:
    """Choose at most `most` pairs by falling score, none within `apart` query frames of one that is already chosen."""
    chosen: list[Pair] = []
    for pair in sorted(pairs, key=lambda pair: -pair.score):
        if len(chosen) == most:
            break
        if all(abs(pair.query - other.query) >= apart for other in chosen):
            chosen.append(pair)
    return chosen


def loop_pairs(pairs: Sequence[Pair], queries: Frames, references: Frames | None) -> Figure:
    """Draw pairs side by side, query | match, with frame numbers, score and verdict.

    Parameters
    ----------
    pairs : sequence of Pair
        At most a few dozen.
    queries, references : frames
        Images uint8 (h, w, 3) by position; None for a frame that cannot be read. One stream is given twice;
        references are None where their images are not at hand.

    Returns
    -------
    matplotlib.figure.Figure
    """
    images = [(queries[pair.query], None if references is None else references[pair.match]) for pair in pairs]
    rows = max(1, -(-len(pairs) // _ACROSS))
    figure = new_figure(_WIDTH, rows * (_WIDTH / (2 * _ACROSS) * _tallest(images) + _TITLE))
    grid = figure.subplots(rows, 2 * _ACROSS, squeeze=False).reshape(-1, 2)
    for axes in grid.flat:
        axes.set_axis_off()
    for pair, shown, (left, right) in zip(pairs, images, grid, strict=False):
        mark = MARKS[pair.right]
        _show(left, shown[0], pair)
        _show(right, shown[1], pair)
        left.set_title(f"query {pair.query}", loc="left", fontsize=8.5, color=INK)
        right.set_title(f"match {pair.match}", loc="left", fontsize=8.5, color=INK)
        verdict = f"{mark.sign} {mark.label}" if pair.right is not None else ""
        right.set_title(f"score {pair.score:.2f}  {verdict}", loc="right", fontsize=8.5, color=mark.color)
    if not pairs:
        figure.text(0.5, 0.5, "no pairs", ha="center", va="center", color=MUTED)
    return figure


def _tallest(images: Sequence[tuple[np.ndarray | None, ...]]) -> float:
    """Return the largest height over width, within reason."""
    shapes = [image.shape[0] / image.shape[1] for pair in images for image in pair if image is not None]
    return min(2.0, max(shapes, default=_SHAPE))


def _show(axes: Axes, image: np.ndarray | None, pair: Pair) -> None:
    axes.set_axis_on()
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=MARKS[pair.right].color, linewidth=1.8, linestyle=MARKS[pair.right].dashes)
    if image is None:
        axes.set(facecolor=EMPTY, aspect=_SHAPE)
        axes.text(0.5, 0.5, "no image", ha="center", va="center", color=MUTED, fontsize=8.5, transform=axes.transAxes)
    else:
        axes.imshow(image)
