"""The paper's figures: spectrum (12), truth (17), distances (18, 19), precision over recall by layer (20, 21)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from loopclosure.compression.spectrum import DEGENERATE, energy_share
from loopclosure.evaluation import paper
from loopclosure.evaluation.experiments import GridResult
from loopclosure.evaluation.truth import Truth
from loopclosure.report.style import EMPTY, INK, MAP, MUTED, dress, key, line_styles, new_figure

_PANEL_COLUMNS = 3


def ratio_name(gamma: float | None) -> str:
    """Return what a ratio is called in tables and figures."""
    return "no KL" if gamma is None else f"{100 * gamma:.0f} %"


def spectra(grid: Sequence[GridResult]) -> Figure:
    """Draw the sorted eigenvalues of every layer, and the energy that the first components hold (Eq. 15).

    Layers differ in size, so components are counted in percent; the marks are the paper's ratios.
    """
    energies = {result.cell.layer: result.cell.energies for result in grid if result.cell.energies.size}
    figure = new_figure(9.6, 3.9)
    left, right = figure.subplots(1, 2)
    dress(left, title="Eigenvalues", x="component (% of the basis)", y="share of the largest")
    dress(right, title="Energy kept, Eq. 15", x="components kept (% of the basis)", y="share of the energy (%)")
    left.set_yscale("log")
    for (layer, values), style in zip(energies.items(), line_styles(len(energies)), strict=True):
        position = 100 * np.arange(1, len(values) + 1) / len(values)
        signal = values > DEGENERATE * values.max(initial=0)
        line = {**style, "label": layer, "linewidth": 1.7, "markevery": 0.15, "markersize": 4}
        left.plot(position[signal], values[signal] / values.max(initial=1), **line)
        right.plot(position, 100 * energy_share(values), **line)
    for gamma in paper.GAMMAS:
        for axes in (left, right):
            axes.axvline(100 * (1 - gamma), color=MUTED, linestyle=":", linewidth=1)
        right.annotate(
            ratio_name(gamma), (100 * (1 - gamma), 2), (2, 0), textcoords="offset points", fontsize=8, color=MUTED
        )
    left.set(xlim=(0, 101), ylim=(max(1e-6, left.get_ylim()[0]), 1.6))
    right.set(xlim=(0, 101), ylim=(0, 104))
    key(figure, left.get_lines()[: len(energies)])
    return figure


def truth_matrix(truth: Truth) -> Figure:
    """Draw all true pairs."""
    figure = new_figure(4.8, 4.8)
    axes = figure.subplots()
    dress(axes, x="match (frame)", y="query (frame)", grid=False)
    for pairs, color in ((truth.ignored, "#b9c1ca"), (truth.pairs, line_styles(1)[0]["color"])):
        query, match = pairs.nonzero()
        axes.plot(match, query, linestyle="none", marker="s", markersize=1.4, markeredgewidth=0, color=color)
    axes.set(xlim=(0, truth.n_references), ylim=(truth.n_queries, 0), aspect="equal")
    return figure


def distance_matrices(grid: Sequence[GridResult], frames: int) -> Figure:
    """Draw the distances of all sequences: a row a layer, a column a ratio, one scale a row."""
    layers = list(dict.fromkeys(result.cell.layer for result in grid))
    columns = len(grid) // len(layers)
    figure = new_figure(2.05 * columns + 0.9, 2.05 * len(layers) + 0.4, gap=0.03)
    panels = figure.subplots(len(layers), columns, squeeze=False)
    for row, layer in enumerate(layers):
        cells = [result.cell for result in grid if result.cell.layer == layer]
        values = np.concatenate([(1 - cell.matrix)[~np.isnan(cell.matrix)] for cell in cells])
        low, high = np.quantile(values, (0.002, 0.998)) if values.size else (0.0, 1.0)
        for axes, cell in zip(panels[row], cells, strict=True):
            first = axes is panels[row][0]
            title = ratio_name(cell.gamma) if row == 0 else ""
            x = "match (frame)" if row == len(layers) - 1 else ""
            dress(axes, title=title, x=x, y=f"{layer}\nquery (frame)" if first else "", grid=False)
            axes.set_facecolor(EMPTY)
            axes.xaxis.set_major_locator(MaxNLocator(4, integer=True) if x else NullLocator())
            axes.yaxis.set_major_locator(MaxNLocator(4, integer=True) if first else NullLocator())
            extent = (-0.5, frames - 0.5, frames - 0.5, -0.5)
            picture = axes.imshow(
                np.ma.masked_invalid(1 - cell.matrix), cmap=MAP, vmin=low, vmax=high, extent=extent, aspect="auto"
            )
        bar = figure.colorbar(picture, ax=panels[row], pad=0.01, aspect=18, shrink=0.85)
        bar.ax.tick_params(colors=MUTED, labelsize=7.5, length=2)
        bar.set_label("distance", color=INK, fontsize=8.5)
        bar.outline.set_visible(False)
    return figure


def curves_by_layer(grid: Sequence[GridResult]) -> Figure:
    """Draw precision over recall, a panel a layer, a line a ratio."""
    layers = list(dict.fromkeys(result.cell.layer for result in grid))
    columns = 2 if len(layers) in (2, 4) else min(len(layers), _PANEL_COLUMNS)
    rows = -(-len(layers) // columns)
    figure = new_figure((4.2 if columns < _PANEL_COLUMNS else 3.3) * columns, 2.9 * rows + 0.4, gap=0.04)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, layer in zip(panels, layers, strict=False):
        results = [result for result in grid if result.cell.layer == layer]
        dress(axes, title=layer, x="recall", y="precision")
        axes.set(xlim=(0, 1.01), ylim=(0, 1.03))
        for result, style in zip(results, line_styles(len(results)), strict=True):
            _draw_steps(axes, result, style)
    for axes in panels[len(layers) :]:
        axes.set_visible(False)
    for axes in panels:
        axes.label_outer()
    key(figure, panels[0].get_lines())
    return figure


def _draw_steps(axes: Axes, result: GridResult, style: dict[str, Any]) -> None:
    curve = result.curve
    recall = np.append(np.zeros(min(1, len(curve.recall))), curve.recall)  # the first step begins at 0
    precision = np.append(curve.precision[:1], curve.precision)
    axes.plot(
        recall,
        precision,
        drawstyle="steps-pre",
        label=ratio_name(result.cell.gamma),
        linewidth=1.5,
        markevery=0.2,
        markersize=3.5,
        **style,
    )
