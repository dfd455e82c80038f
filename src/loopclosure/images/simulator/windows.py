"""Painting windows, doors and the light behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.images.simulator.districts import Building
from loopclosure.images.simulator.surface import Rgb, box, mixed, polygon, shade

PIXELS_PER_M = 32
Rect = tuple[float, float, float, float]
"""Left, top, right and bottom, pixels."""

_FLOWERS: tuple[Rgb, ...] = ((52, 96, 44), (190, 50, 70), (70, 112, 50))
_LAMP_LIGHT: tuple[Rgb, ...] = ((255, 204, 120), (255, 222, 160), (250, 184, 96), (214, 226, 255), (255, 214, 140))


@dataclass
class Front:
    """The front of a building that is being painted.

    Attributes
    ----------
    rgb, glow : ndarray, (h, w, 3), uint8
        Its colours; the light that comes out of it when lamps are on.
    rng, lamps : numpy.random.Generator
        What was built; which lamps are lit this evening.
    lit : float
        Share of the windows with light behind them.
    """

    rgb: np.ndarray
    glow: np.ndarray
    rng: np.random.Generator
    lamps: np.random.Generator
    lit: float

    def box(self, left: float, top: float, right: float, bottom: float, colour: Rgb) -> None:
        """Fill the rectangle between four pixel positions."""
        box(self.rgb, left, top, right, bottom, colour)

    def warm(self) -> Rgb:
        """Draw the colour of a lamp."""
        return _LAMP_LIGHT[int(self.lamps.integers(len(_LAMP_LIGHT)))]

    def pick(self, choices: tuple[Rgb, ...]) -> Rgb:
        """Draw one of some colours."""
        return choices[int(self.rng.integers(len(choices)))]


def paint_window(front: Front, building: Building, rect: Rect) -> None:
    """Paint a window in its surround, with what the building has around its windows."""
    left, top, right, bottom = rect
    frame = building.frame
    _paint_surround(front, building, rect)
    front.box(left, top, right, bottom, frame)
    paint_glass(front, (left + 2, top + 2, right - 2, bottom - 2))
    for share in np.linspace(0, 1, building.panes[0] + 1)[1:-1]:
        front.box(left + share * (right - left) - 1, top, left + share * (right - left) + 1, bottom, frame)
    for share in np.linspace(0, 1, building.panes[1] + 1)[1:-1]:
        front.box(left, top + share * (bottom - top) - 1, right, top + share * (bottom - top) + 1, frame)
    front.box(left, top, right, top + 2, shade(frame, 0.5))
    if building.shutters is not None:
        wing, gap = 0.42 * (right - left), _surround(building)
        for x in (left - wing - gap, right + gap):
            front.box(x, top, x + wing, bottom, building.shutters)
            for y in np.arange(top + 3, bottom - 2, 4):
                front.box(x + 2, y, x + wing - 2, y + 1, shade(building.shutters, 0.72))
    if building.flower_boxes and front.rng.random() < 0.6:
        front.box(left - 2, bottom - 5, right + 2, bottom + 2, (92, 62, 44))
        for x in np.arange(left, right, 3):
            front.box(x, bottom - 9 + front.rng.integers(3), x + 3, bottom - 4, front.pick(_FLOWERS))


def _surround(building: Building) -> int:
    return 4 if building.surround else 2


def _paint_surround(front: Front, building: Building, rect: Rect) -> None:
    left, top, right, bottom = rect
    wide, trim, middle = _surround(building), building.trim, (left + right) / 2
    front.box(left - wide, top - wide, right + wide, bottom + 1, trim)
    front.box(left - wide - 2, bottom + 1, right + wide + 2, bottom + 4, shade(trim, 1.05))
    front.box(left - wide, bottom + 4, right + wide, bottom + 6, shade(building.wall, 0.66))
    if building.arched:
        half = (right - left) / 2 + wide
        arc = [(middle + half * np.cos(a), top - 0.45 * half * np.sin(a)) for a in np.linspace(0, np.pi, 9)]
        polygon(front.rgb, arc, trim)
    if building.pediment:
        polygon(front.rgb, [(left - 7, top - 5), (middle, top - 14), (right + 7, top - 5)], shade(trim, 1.04))
        front.box(left - 7, top - 5, right + 7, top - 3, shade(trim, 0.8))


def paint_glass(front: Front, rect: Rect, *, curtains: float = 0.6) -> None:
    """Paint a pane: the sky above, the dark room below, sometimes curtains; by night sometimes a lamp."""
    left, top, right, bottom = (round(v) for v in rect)
    left, top = max(left, 0), max(top, 0)
    view = front.rgb[top:bottom, left:right]
    if view.size == 0:
        return
    rng = front.rng
    bright = rng.uniform(0.5, 1.0)
    ramp = np.linspace(bright, 0.2 * bright, view.shape[0])[:, None, None]
    view[:] = (1 - ramp) * np.array((34, 40, 48)) + ramp * np.array((134, 156, 180))
    drapes = rng.random() < curtains
    if drapes:
        cloth = mixed(
            (214, 206, 190), front.pick(((150, 120, 96), (190, 196, 206), (120, 132, 120), (226, 224, 218))), 0.6
        )
        if rng.random() < 0.4:
            view[: int(view.shape[0] * rng.uniform(0.25, 0.9))] = shade(cloth, 0.86)
        else:
            part = max(1, int(view.shape[1] * rng.uniform(0.15, 0.3)))
            view[:, :part] = view[:, -part:] = shade(cloth, 0.78)
    if front.lamps.random() < front.lit:
        warm, level = front.warm(), front.lamps.uniform(0.45, 0.95)
        fall = np.linspace(1.0, 0.7, view.shape[0])[:, None, None]
        tone = 0.55 + 0.45 * view.astype(np.float32) / 255 if drapes else 1.0
        front.glow[top:bottom, left:right] = np.array(warm) * level * fall * tone


def paint_door(
    front: Front, building: Building, left: float, top: float, bottom: float, *, glazed: bool, colour: Rgb
) -> None:
    """Paint a door, of glass or panelled."""
    right = left + 1.05 * PIXELS_PER_M
    front.box(left - 4, top - 3, right + 4, bottom, building.trim)
    front.box(left, top, right, bottom, colour)
    if glazed:
        paint_glass(front, (left + 4, top + 4, right - 4, bottom - 0.3 * PIXELS_PER_M), curtains=0)
    else:
        middle = (top + bottom) / 2
        paint_glass(front, (left + 5, top + 4, right - 5, top + 12), curtains=0)
        for a, b in ((top + 17, middle), (middle + 5, bottom - 8)):
            front.box(left + 5, a, right - 5, b, shade(colour, 0.8))
            front.box(left + 6, a + 1, right - 5, b, shade(colour, 1.12))
    front.box(right - 5, bottom - 34, right - 3, bottom - 30, (206, 180, 96))
