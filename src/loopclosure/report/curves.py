"""Precision over recall, one line a method, a layer or a ratio."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from loopclosure.evaluation.metrics import PrecisionRecall, average_precision, recall_at_precision
from loopclosure.report.style import GRID, LEGEND, MUTED, dress, line_styles, new_figure

_F1 = (0.2, 0.4, 0.6, 0.8)


def precision_recall(curves: Mapping[str, PrecisionRecall], *, highlight: str | None = None) -> Figure:
    """Draw precision-recall curves as the steps that they are, over lines of equal F1.

    Parameters
    ----------
    curves : mapping of str to PrecisionRecall
        Drawn in order; a curve without points appears in the legend alone.
    highlight : str, optional
        Name of the curve that is drawn strongest.

    Returns
    -------
    matplotlib.figure.Figure
        Recall at 100 % precision is marked on the upper edge.

    Notes
    -----
    Between two points precision is that of the more generous threshold, as `average_precision` counts it.
    """
    figure = new_figure(6.4, 5)
    axes = figure.subplots()
    dress(axes, x="recall", y="precision")
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    _draw_equal_f1(axes)
    for (name, curve), style in zip(curves.items(), line_styles(len(curves)), strict=True):
        _draw_curve(axes, name, curve, style, strong=name == highlight or len(curves) == 1)
    if curves:
        legend = axes.legend(loc="lower left", **(LEGEND | {"frameon": True, "framealpha": 0.9, "edgecolor": "white"}))
        for text in legend.get_texts():
            text.set_parse_math(False)  # names are the user's
    return figure


def _draw_equal_f1(axes: Axes) -> None:
    for f1 in _F1:
        recall = np.linspace(f1 / (2 - f1), 1, 100)
        axes.plot(recall, f1 * recall / (2 * recall - f1), color=GRID, linewidth=1, zorder=1)
        axes.annotate(
            f"F1 {f1:g}", (1, f1 / (2 - f1)), (4, 0), textcoords="offset points", va="center", color=MUTED, fontsize=8
        )


def _draw_curve(axes: Axes, name: str, curve: PrecisionRecall, style: dict, *, strong: bool) -> None:
    recall = np.append(np.zeros(min(1, len(curve.recall))), curve.recall)  # the first step begins at 0
    precision = np.append(curve.precision[:1], curve.precision)
    at_100, area = recall_at_precision(curve, 1.0), average_precision(curve)
    label = f"{name}   AP {_number(area)}, R@100P {_number(at_100)}"
    width = 2.4 if strong else 1.5
    axes.plot(
        recall, precision, drawstyle="steps-pre", label=label, linewidth=width, markevery=0.15, markersize=4, **style
    )
    if at_100 is not None:
        mark = {"marker": style["marker"], "markeredgecolor": style["color"], "markerfacecolor": "white"}
        axes.plot([at_100], [1.0], linestyle="none", markersize=8, markeredgewidth=1.8, clip_on=False, zorder=5, **mark)


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.3f}"
