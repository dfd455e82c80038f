"""Heat maps, matches and clusters drawn over the images that they speak of."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Patch
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation

from loopclosure.report.heatmaps import Match, View, cluster_shares
from loopclosure.report.style import INK, LEGEND, MUTED, line_styles, new_figure

HEAT = "inferno"
_WIDTH, _HEAD, _FOOT = 9.6, 0.3, 0.5  # inches
_FAINT, _STRONG = 0.25, 0.75  # how much of an overlay is the heat, where it is 0 and where it is 1
_SHOWN = 6  # clusters with a colour
_LINE = "#56B4E9"


def heat_overlay(image: np.ndarray, heat: np.ndarray) -> np.ndarray:
    """Lay heat over the grey image.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        RGB.
    heat : ndarray of float, shape (H, W)
        0..1.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
    """
    colors = mpl.colormaps[HEAT](heat)[..., :3]
    share = (_FAINT + (_STRONG - _FAINT) * heat)[..., None]
    return np.round(255 * (share * colors + (1 - share) * _grey(image))).astype(np.uint8)


def draw_heat(
    views: Sequence[View], heats: Sequence[np.ndarray], names: Sequence[str], pairs: Sequence[Match] = ()
) -> Figure:
    """Draw one image or two with their matches, and their heat maps below.

    Parameters
    ----------
    views : sequence of one or two View
    heats : sequence of ndarray of float, shape (H, W)
        One an image, 0..1.
    names : sequence of str
        One an image.
    pairs : sequence of Match
        Joined by lines and numbered in order.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, grid = _grid(views, rows=2)
    for column, (view, heat, name) in enumerate(zip(views, heats, names, strict=True)):
        _show(grid[0, column], view.image, name)
        _show(grid[1, column], heat_overlay(view.image, heat))
    for number, match in enumerate(pairs, 1):
        _join(grid[0], views, match, number)
    scale = ScalarMappable(cmap=HEAT)
    bar = figure.colorbar(scale, ax=grid[1], location="bottom", shrink=0.35, aspect=40, pad=0.03)
    bar.set_ticks([0, 1], labels=["nothing", "most"])
    bar.set_label("adds to the similarity" if len(views) > 1 else "adds to the descriptor", color=INK, fontsize=9)
    bar.ax.tick_params(colors=MUTED, labelsize=8.5, length=0)
    bar.outline.set_visible(False)
    return figure


def draw_clusters(views: Sequence[View], names: Sequence[str]) -> Figure:
    """Draw which NetVLAD cluster takes each position, for the clusters that add most to the similarity.

    Returns
    -------
    matplotlib.figure.Figure
        Every position of such a cluster bears its colour and its number.
    """
    shares = cluster_shares(views[0], views[-1])
    shown = [int(k) for k in np.argsort(-shares)[:_SHOWN] if shares[k] > 0]
    colors = {k: str(style["color"]) for k, style in zip(shown, line_styles(len(shown)), strict=True)}
    figure, grid = _grid(views, rows=1)
    for axes, view, name in zip(grid[0], views, names, strict=True):
        _show(axes, _colored(view, colors), name)
        _number(axes, view, colors)
    whole = float(shares.sum())
    handles = [Patch(color=color, label=f"cluster {k}: {shares[k]:.3f} of {whole:.3f}") for k, color in colors.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, **LEGEND)
    return figure


def _grid(views: Sequence[View], *, rows: int) -> tuple[Figure, np.ndarray]:
    width = _WIDTH * (1 if len(views) > 1 else 0.6)
    tallest = max(min(2.0, view.image.shape[0] / view.image.shape[1]) for view in views)
    figure = new_figure(width, rows * width / len(views) * tallest + _HEAD + _FOOT)
    figure.set_layout_engine("constrained", wspace=0.02, h_pad=0.07)
    return figure, figure.subplots(rows, len(views), squeeze=False)


def _show(axes: Axes, image: np.ndarray, name: str = "") -> None:
    axes.imshow(image)
    axes.set_axis_off()
    axes.set_title(name, loc="left", fontsize=9.5, color=INK, parse_math=False)


def _join(axes: np.ndarray, views: Sequence[View], match: Match, number: int) -> None:
    """Draw a line and a number at both its ends: lines along one row of cells could not be told apart."""
    ends = [_center(view, place) for view, place in zip(views, (match.left, match.right), strict=True)]
    line = ConnectionPatch(ends[0], ends[1], "data", "data", axesA=axes[0], axesB=axes[1], color=_LINE, linewidth=1)
    line.set_path_effects([withStroke(linewidth=2, foreground="black", alpha=0.4)])
    line.set_in_layout(False)
    axes[0].figure.add_artist(line)
    disc = {"boxstyle": "circle,pad=0.25", "facecolor": _LINE, "edgecolor": "black", "linewidth": 0.6}
    for panel, end in zip(axes, ends, strict=True):
        label = Annotation(
            str(number), end, xycoords=panel.transData, ha="center", va="center", fontsize=6.5, bbox=disc
        )
        label.set(in_layout=False, zorder=5)  # above the lines, which lie above the axes
        panel.figure.add_artist(label)


def _center(view: View, place: tuple[int, int]) -> tuple[float, float]:
    """Return x and y of a map position in pixels of the image."""
    (height, width), (rows, columns) = view.image.shape[:2], view.clusters.shape
    return (place[1] + 0.5) * width / columns - 0.5, (place[0] + 0.5) * height / rows - 0.5


def _colored(view: View, colors: dict[int, str]) -> np.ndarray:
    """Return the grey image, dimmed, with the cells of the clusters in their colours."""
    (height, width), (rows, columns) = view.image.shape[:2], view.clusters.shape
    clusters = view.clusters[np.arange(height) * rows // height][:, np.arange(width) * columns // width]
    picture = 0.4 + 0.6 * _grey(view.image)
    for cluster, color in colors.items():
        cells = clusters == cluster
        picture[cells] = 0.65 * np.array(to_rgb(color)) + 0.35 * picture[cells]
    return np.round(255 * picture).astype(np.uint8)


def _number(axes: Axes, view: View, colors: dict[int, str]) -> None:
    outline = [withStroke(linewidth=1.4, foreground="black")]
    for cluster in colors:
        for place in np.argwhere(view.clusters == cluster):
            x, y = _center(view, (int(place[0]), int(place[1])))
            axes.text(x, y, str(cluster), ha="center", va="center", color="white", fontsize=6, path_effects=outline)


def _grey(image: np.ndarray) -> np.ndarray:
    """Return luma as three equal channels, 0..1."""
    luma = image @ np.array([0.299, 0.587, 0.114]) / 255
    return np.repeat(luma[..., None], 3, axis=2)
