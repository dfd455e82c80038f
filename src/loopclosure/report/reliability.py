"""Do the probabilities of a run mean what they say? Of the candidates of 90 %, nine in ten should be right."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from loopclosure.report.pairs import Pair
from loopclosure.report.style import GRID, INK, MUTED, dress, new_figure

_EDGES = np.array([0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1])


def reliability(pairs: Iterable[Pair]) -> Figure | None:
    """Draw the share of right candidates over the probability that they were given.

    Parameters
    ----------
    pairs : iterable of Pair
        Whose score is a probability; those on which truth says nothing are left out.

    Returns
    -------
    matplotlib.figure.Figure or None
        With the 95 % interval of each share (Wilson 1927), as if frames were independent, and how many candidates it
        is made of; None where truth judges none.
    """
    judged = [(pair.score, pair.right) for pair in pairs if pair.right is not None]
    if not judged:
        return None
    score, right = np.array(judged, float).T
    group = np.clip(np.searchsorted(_EDGES, score, side="right") - 1, 0, len(_EDGES) - 2)
    groups = np.unique(group)
    counts = np.array([(group == one).sum() for one in groups])
    given = np.array([score[group == one].mean() for one in groups])
    share = np.array([right[group == one].mean() for one in groups])
    intervals = [
        binomtest(int(right[group == one].sum()), int(count)).proportion_ci(method="wilson")
        for one, count in zip(groups, counts, strict=True)
    ]
    low, high = np.array([(interval.low, interval.high) for interval in intervals]).T
    figure = new_figure(6.4, 5)
    axes = figure.subplots()
    dress(axes, x="probability of a loop, as reported", y="share of right candidates")
    axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.06))
    axes.plot([0, 1], [0, 1], color=GRID, linewidth=1.5, zorder=1)
    axes.errorbar(given, share, np.maximum((share - low, high - share), 0), fmt="o", color=INK, capsize=3)
    for x, y, count in zip(given, high, counts, strict=True):
        axes.annotate(f"{count}", (x, y), (0, 4), textcoords="offset points", ha="center", color=MUTED, fontsize=8)
    return figure
