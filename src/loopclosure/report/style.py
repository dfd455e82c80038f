"""How every picture looks: one palette for print, screens and colour-blind readers, nothing global.

Lines and marks are from the palette of Okabe and Ito; no meaning rests on colour alone.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import cycle, islice
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from PIL import Image

DPI = 150
INK, MUTED, GRID, EMPTY = "#1c2430", "#5d6673", "#dde1e6", "#eef0f2"
MAP = "cividis"


class Mark(NamedTuple):
    """How a verdict is drawn."""

    label: str
    sign: str
    color: str
    marker: str
    dashes: str


MARKS: dict[bool | None, Mark] = {
    True: Mark("right", "✓", "#009E73", "o", "-"),
    False: Mark("wrong", "✗", "#D55E00", "X", "--"),
    None: Mark("accepted", "", "#CC79A7", "s", "-"),
}
"""By what truth says of a pair; None where it says nothing."""

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1c2430")
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 2, 1, 2)), (0, (3, 1)))
_MARKERS = ("o", "s", "^", "D", "v", "P")


def line_styles(count: int) -> list[dict[str, object]]:
    """Return `count` line styles; colour, dashes and marker have different periods, so that they tell lines apart."""
    columns = (islice(cycle(values), count) for values in (_COLORS, _DASHES, _MARKERS))
    return [{"color": color, "linestyle": dash, "marker": marker} for color, dash, marker in zip(*columns, strict=True)]


def new_figure(width: float, height: float, *, gap: float = 0.02) -> Figure:
    """Return an empty figure, sides in inches, with a canvas of its own; `gap` is a share of a panel's width."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(wspace=gap), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, *, title: str = "", x: str, y: str, grid: bool = True) -> None:
    """Give axes their labels and the house look."""
    axes.set_xlabel(x, color=INK, fontsize=9.5)
    axes.set_ylabel(y, color=INK, fontsize=9.5)
    axes.set_title(title, color=INK, fontsize=10.5, loc="left", pad=8)
    axes.tick_params(which="both", color=MUTED, labelcolor=MUTED, labelsize=8.5, length=3)
    for side, spine in axes.spines.items():
        spine.set_color(GRID)
        spine.set_visible(not grid or side in ("left", "bottom"))
    if grid:
        axes.grid(color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)


def key(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend under all panels."""
    if handles:
        figure.legend(
            handles=handles, loc="outside lower center", ncols=len(handles) if len(handles) < 5 else 3, **LEGEND
        )


LEGEND = {"frameon": False, "fontsize": 8.5, "labelcolor": INK}


def mark_handle(mark: Mark, *, line: bool = False) -> Line2D:
    """Return the legend entry of a verdict."""
    dashes = mark.dashes if line else "none"
    handle = Line2D([], [], label=f"{mark.label} loop", color=mark.color, marker=mark.marker, linestyle=dashes)
    handle.set(markersize=7, markeredgecolor="white")
    return handle


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG, opaque: without the fourth channel it is a sixth smaller."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    stream = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").save(stream, "png", dpi=(DPI, DPI))
    return stream.getvalue()
