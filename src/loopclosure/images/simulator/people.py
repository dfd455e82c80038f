"""Painting people who walk."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from loopclosure.images.simulator.surface import Rgb, Surface, polygon, shade

LOOKS, PHASES = 48, 4
WIDTH_M, HEIGHT_M = 1.0, 1.9
_SCALE = 56
_HIP_M, _SHOULDER_M = 0.92, 1.46
_SWINGS = (0.9, 0.35, -0.9, -0.35)

_SKINS: tuple[Rgb, ...] = ((226, 184, 154), (198, 146, 112), (150, 102, 74), (104, 70, 52), (236, 200, 176))
_HAIRS: tuple[Rgb, ...] = ((40, 32, 28), (88, 60, 38), (150, 118, 72), (120, 116, 112), (60, 40, 30), (30, 30, 34))
_TOPS: tuple[Rgb, ...] = (
    (44, 58, 92), (150, 42, 44), (58, 62, 60), (210, 204, 194), (86, 110, 82), (188, 150, 84), (30, 30, 34),
    (120, 84, 124),
    (62, 122, 140), (196, 110, 70), (104, 92, 76), (230, 190, 60), (206, 152, 160), (76, 44, 36),
)  # fmt: skip
_BOTTOMS: tuple[Rgb, ...] = ((40, 48, 72), (34, 34, 36), (94, 86, 74), (70, 84, 110), (120, 112, 98), (58, 44, 40))


@dataclass(frozen=True)
class _Look:
    """How one person is built and dressed."""

    skin: Rgb
    hair: Rgb
    top: Rgb
    bottom: Rgb
    size: float
    build: float
    coat: bool
    skirt: bool
    long_hair: bool
    bag: Rgb | None


def paint_person(look: int, phase: int, view: str) -> Surface:
    """Paint one of `LOOKS` people in one of `PHASES` of a step.

    Parameters
    ----------
    look, phase : int
    view : {"front", "back", "side"}
        Side walks to the right.
    """
    person = _look(look)
    figure, swing = _Figure(person.size * _SCALE), _SWINGS[phase]
    _legs(figure, person, view, swing)
    low = 0.55 if person.skirt else 0.72
    if person.skirt or person.coat:
        wide = person.build
        cloth = [(-0.17 * wide, 1.0), (0.17 * wide, 1.0), (0.24 * wide, low), (-0.24 * wide, low)]
        figure.shape(cloth, person.bottom if person.skirt else person.top)
    _arm(figure, person, view, -1, -swing)
    _torso(figure, person, view)
    _arm(figure, person, view, 1, swing)
    if person.bag is not None and view != "front":
        x = -0.16 if view == "side" else 0.0
        figure.shape([(x - 0.13, 1.42), (x + 0.13, 1.42), (x + 0.14, 1.05), (x - 0.14, 1.05)], person.bag)
    _head(figure, person, view)
    return Surface(figure.rgb, figure.alpha)


def _look(number: int) -> _Look:
    rng = np.random.default_rng([17, number])
    skin, hair, top, bottom = (c[int(rng.integers(len(c)))] for c in (_SKINS, _HAIRS, _TOPS, _BOTTOMS))
    return _Look(
        skin=skin,
        hair=hair,
        top=shade(top, rng.uniform(0.8, 1.15)),
        bottom=shade(bottom, rng.uniform(0.8, 1.2)),
        size=float(rng.uniform(0.88, 1.0)),
        build=float(rng.uniform(0.9, 1.15)),
        coat=bool(rng.random() < 0.3),
        skirt=bool(rng.random() < 0.2),
        long_hair=bool(rng.random() < 0.4),
        bag=shade(_TOPS[number % 7], 0.8) if rng.random() < 0.45 else None,
    )


class _Figure:
    """A person on a transparent ground; positions are metres from the middle and from the ground."""

    def __init__(self, scale: float) -> None:
        height, width = round(HEIGHT_M * _SCALE), round(WIDTH_M * _SCALE)
        self.scale, self.height, self.width = scale, height, width
        self.rgb, self.alpha = np.full((height, width, 3), 60, np.uint8), np.zeros((height, width), np.uint8)

    def _at(self, x: float, z: float) -> tuple[float, float]:
        return self.width / 2 + x * self.scale, self.height - z * self.scale

    def shape(self, points: list[tuple[float, float]], colour: Rgb) -> None:
        pixels = [self._at(*p) for p in points]
        polygon(self.rgb, pixels, colour)
        polygon(self.alpha, pixels, 255)

    def limb(self, points: list[tuple[float, float]], thick: float, colour: Rgb) -> None:
        line = np.array([self._at(*p) for p in points]).round().astype(np.int32)
        cv2.polylines(self.rgb, [line], False, colour, max(1, round(thick * self.scale)), cv2.LINE_AA)
        cv2.polylines(self.alpha, [line], False, 255, max(1, round(thick * self.scale)))

    def dot(self, point: tuple[float, float], radius: float, colour: Rgb) -> None:
        x, y = self._at(*point)
        cv2.circle(self.rgb, (round(x), round(y)), max(1, round(radius * self.scale)), colour, -1, cv2.LINE_AA)
        cv2.circle(self.alpha, (round(x), round(y)), max(1, round(radius * self.scale)), 255, -1)


def _legs(figure: _Figure, person: _Look, view: str, swing: float) -> None:
    aside = view == "side"
    apart, reach, knee, toe = (0.03, 0.24, 0.03, 0.13) if aside else (0.09 * person.build, 0.06, 0.0, 0.01)
    for side, tone in ((-1, 0.78), (1, 1.0)):
        x, step = side * apart, side * swing
        foot, lift = x + step * reach, 0.05 * max(0.0, -step)
        leg = [(x, _HIP_M), (x + step * reach * 0.6 + knee, 0.5 + lift), (foot, 0.08 + lift)]
        figure.limb(leg, 0.15 * person.build, shade(person.bottom, tone))
        figure.limb([(foot, 0.05 + lift), (foot + (toe if aside else toe * side), 0.04 + lift)], 0.1, (34, 30, 28))


def _torso(figure: _Figure, person: _Look, view: str) -> None:
    wide, hips, waist = (0.13 if view == "side" else 0.19) * person.build, 0.16 * person.build, _HIP_M - 0.02
    figure.shape([(-wide, _SHOULDER_M), (wide, _SHOULDER_M), (hips, waist), (-hips, waist)], person.top)
    figure.shape([(0.02, _SHOULDER_M), (wide, _SHOULDER_M), (hips, waist), (0.05, waist)], shade(person.top, 0.86))


def _arm(figure: _Figure, person: _Look, view: str, side: int, swing: float) -> None:
    """Draw the arm on one side; seen from the side, the far one (-1) and the near one."""
    if view == "side":
        points = [(0.0, 1.4), (-0.1 * swing, 1.15), (-0.2 * swing, 0.9)]
    else:
        x = side * 0.2 * person.build
        points = [(x, 1.4), (1.18 * x, 1.15), (1.12 * x, 0.9 + 0.04 * swing)]
    figure.limb(points, 0.11, shade(person.top, 0.72 if side < 0 else 0.94))
    figure.dot((points[-1][0], points[-1][1] - 0.04), 0.05, person.skin)


def _head(figure: _Figure, person: _Look, view: str) -> None:
    figure.limb([(0, 1.46), (0, 1.56)], 0.1, shade(person.skin, 0.85))
    if person.long_hair:
        figure.shape([(-0.12, 1.72), (0.12, 1.72), (0.13, 1.45), (-0.13, 1.45)], person.hair)
    if view == "back":
        figure.dot((0, 1.67), 0.115, person.hair)
        return
    figure.dot((0, 1.69), 0.12, person.hair)
    figure.dot((0.035 if view == "side" else 0.0, 1.65), 0.1, person.skin)
