"""Vehicles: a side profile drawn out over the width, with painted sides and strips."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from loopclosure.images.simulator.surface import Rgb, Surface, box, plain, polygon, shade

_SCALE = 40
_GLASS: Rgb = (44, 52, 60)

PAINTS: tuple[Rgb, ...] = (
    (204, 206, 208), (40, 42, 46), (122, 126, 132), (236, 236, 232), (158, 30, 32), (34, 62, 116), (86, 98, 108),
    (60, 84, 66),
    (186, 168, 132), (204, 118, 38), (64, 112, 150), (112, 28, 50), (216, 186, 60), (20, 30, 52), (150, 160, 150),
)  # fmt: skip


@dataclass(frozen=True)
class Model:
    """A kind of vehicle.

    Attributes
    ----------
    width_m : float
    profile_m : tuple of (float, float)
        Outline of the side from the rear bumper over the roof to the front bumper: (from the rear, height).
    strips : tuple of str
        What each stretch of the outline is.
    windows_m : tuple of (float, float, float, float)
        Side windows: rear, front, sill and top edge.
    wheels_m : tuple of float
        Where the wheels stand, from the rear.
    """

    width_m: float
    profile_m: tuple[tuple[float, float], ...]
    strips: tuple[str, ...]
    windows_m: tuple[tuple[float, float, float, float], ...]
    wheels_m: tuple[float, ...]
    wheel_m: float = 0.32

    @property
    def length_m(self) -> float:
        """From bumper to bumper."""
        return self.profile_m[-1][0]

    @property
    def height_m(self) -> float:
        """Of the roof."""
        return max(z for _, z in self.profile_m)


MODELS: dict[str, Model] = {
    "hatch": Model(
        1.76,
        ((0.0, 0.28), (0.03, 0.86), (0.42, 1.42), (1.0, 1.49), (2.15, 1.47), (2.95, 0.98), (3.85, 0.78), (3.95, 0.28)),
        ("rear", "glass", "roof", "roof", "glass", "hood", "front"),
        ((0.5, 1.42, 0.95, 1.38), (1.5, 2.62, 0.95, 1.38)),
        (0.68, 3.2),
    ),
    "sedan": Model(
        1.82,
        ((0.0, 0.28), (0.02, 0.9), (0.75, 0.98), (1.45, 1.42), (2.6, 1.43), (3.4, 0.98), (4.45, 0.76), (4.55, 0.28)),
        ("rear", "hood", "glass", "roof", "glass", "hood", "front"),
        ((1.05, 1.98, 0.95, 1.35), (2.05, 3.05, 0.95, 1.35)),
        (0.9, 3.7),
    ),
    "suv": Model(
        1.9,
        ((0.0, 0.36), (0.02, 1.02), (0.3, 1.66), (1.0, 1.74), (2.6, 1.7), (3.3, 1.12), (4.4, 0.98), (4.5, 0.36)),
        ("rear", "glass", "roof", "roof", "glass", "hood", "front"),
        ((0.35, 1.6, 1.1, 1.6), (1.68, 2.98, 1.1, 1.6)),
        (0.85, 3.6),
        0.37,
    ),
    "van": Model(
        2.0,
        ((0.0, 0.34), (0.0, 2.3), (0.25, 2.42), (3.9, 2.42), (4.7, 1.32), (5.3, 1.08), (5.4, 0.34)),
        ("doors", "roof", "roof", "glass", "hood", "front"),
        ((3.3, 4.25, 1.35, 2.0),),
        (1.1, 4.4),
        0.36,
    ),
    "bus": Model(
        2.5,
        ((0.0, 0.34), (0.0, 3.0), (0.2, 3.15), (10.3, 3.15), (10.5, 2.95), (10.6, 1.15), (10.6, 0.34)),
        ("busrear", "roof", "roof", "board", "glass", "front"),
        tuple((0.5 + 1.62 * k, 2.0 + 1.62 * k, 1.25, 2.55) for k in range(6)),
        (2.4, 8.3),
        0.48,
    ),
    "truck": Model(
        2.45,
        ((0.0, 0.55), (0.0, 3.3), (0.05, 3.35), (6.2, 3.35), (6.3, 2.5), (7.9, 2.5), (8.1, 1.5), (8.15, 0.4)),
        ("cargo", "roof", "roof", "cab", "roof", "glass", "front"),
        ((6.75, 7.8, 1.55, 2.25),),
        (1.3, 2.4, 7.0),
        0.48,
    ),
}


def paint_vehicle(kind: str, part: str, paint: Rgb, variant: int) -> Surface:
    """Paint the ``right`` or ``left`` side, the ``under`` side, or one strip of a vehicle."""
    model = MODELS[kind]
    rng = np.random.default_rng(variant)
    if part in ("right", "left"):
        return _side(model, kind, paint, rng, mirrored=part == "left")
    height, width = 32, round(model.width_m * _SCALE)
    if part in ("roof", "hood"):
        rgb = plain(height, width, shade(paint, 1.08))
        box(rgb, 0, 0, 3, height, shade(paint, 0.85))
        box(rgb, width - 3, 0, width, height, shade(paint, 0.85))
        return Surface(rgb)
    if part == "glass":
        return Surface(_pane(height, width, paint))
    if part == "under":
        rgb = plain(12, width, (18, 18, 19))
        return Surface(rgb)
    return _end(part, width, paint, rng)


def _pane(height: int, width: int, paint: Rgb) -> np.ndarray:
    ramp = np.linspace(0.6, 0.05, height)[:, None, None]
    rgb = ((1 - ramp) * np.array(_GLASS) + ramp * np.array((150, 170, 188))).repeat(width, axis=1).astype(np.uint8)
    for x in (0, width - 5):
        box(rgb, x, 0, x + 5, height, paint)
    box(rgb, 0, 0, width, 2, shade(paint, 0.9))
    return rgb


def _end(part: str, width: int, paint: Rgb, rng: np.random.Generator) -> Surface:
    """Paint the front or the rear: lamps, number plate, grille, bumper."""
    tall = {"busrear": 104, "doors": 78, "cargo": 110, "board": 24, "cab": 34}.get(part, 26)
    rgb = plain(tall, width, paint)
    glow = np.zeros_like(rgb)
    base = tall - (26 if tall > 26 else tall)
    if part == "front":
        box(rgb, width * 0.26, tall * 0.3, width * 0.74, tall * 0.62, (32, 34, 36))
        lamp, light = (238, 240, 236), (255, 250, 225)
    else:
        lamp, light = (168, 20, 22), (190, 16, 12)
    if part == "busrear":
        rgb[10:46, 8:-8] = _pane(36, width - 16, (30, 32, 34))
        box(rgb, 0, 58, width, 62, shade(paint, 0.7))
        box(rgb, width * 0.2, 66, width * 0.8, 82, shade(paint, 0.6))
    elif part == "doors":
        rgb[8:34, 8:-8] = _pane(26, width - 16, shade(paint, 0.7))
        box(rgb, width / 2 - 1, 4, width / 2 + 1, tall - 8, shade(paint, 0.5))
    elif part == "cargo":
        colour = PAINTS[int(rng.integers(len(PAINTS)))]
        box(rgb, 4, 4, width - 4, tall - 22, (206, 204, 198))
        box(rgb, 4, 24, width - 4, 58, colour)
        text = ("CARGO", "EXPRESS", "FRESH", "MOVE")[int(rng.integers(4))]
        cv2.putText(rgb, text, (10, 50), cv2.FONT_HERSHEY_DUPLEX, 0.62, (240, 238, 230), 2, cv2.LINE_AA)
        box(rgb, width / 2 - 1, 4, width / 2 + 1, tall - 22, (120, 120, 118))
        box(rgb, 0, tall - 22, width, tall, (48, 48, 50))
    elif part == "board":
        box(rgb, 6, 4, width - 6, tall - 2, (20, 20, 22))
        cv2.putText(
            rgb,
            str(10 + int(rng.integers(80))),
            (width // 2 - 14, tall - 6),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.5,
            (250, 180, 40),
            1,
        )
    if part in ("board", "cab"):
        return Surface(rgb, None, glow)
    for x in (0.03, 0.81):
        rect = (width * x, base + 5, width * (x + 0.16), base + 13)
        box(rgb, *rect, lamp)
        box(glow, *rect, light)
    box(rgb, 0, base + 18, width, tall, shade(paint, 0.42))
    box(rgb, width * 0.36, base + 12, width * 0.64, base + 18, (226, 224, 200))
    return Surface(rgb, None, glow)


def _side(model: Model, kind: str, paint: Rgb, rng: np.random.Generator, *, mirrored: bool) -> Surface:
    height, width = round(model.height_m * _SCALE), round(model.length_m * _SCALE)

    def at(x: float, z: float) -> tuple[float, float]:
        return x * _SCALE, height - z * _SCALE

    rgb, alpha = plain(height, width, paint), np.zeros((height, width), np.uint8)
    outline = [at(*point) for point in model.profile_m]
    polygon(alpha, outline, 255)
    fade = np.clip(1.08 - 0.34 * np.linspace(0, 1, height) ** 2, 0, 1.1)[:, None, None]
    rgb = np.clip(rgb * fade, 0, 255).astype(np.uint8)
    if kind == "bus":
        band = PAINTS[int(rng.integers(len(PAINTS)))]
        box(rgb, 0, height - 1.15 * _SCALE, width, height - 0.95 * _SCALE, band)
    if kind == "truck":
        box(rgb, 0, 0, 6.25 * _SCALE, height - 0.9 * _SCALE, (204, 202, 196))
        band = PAINTS[int(rng.integers(len(PAINTS)))]
        box(rgb, 0.5 * _SCALE, 0.6 * _SCALE, 5.7 * _SCALE, 1.5 * _SCALE, band)
        box(rgb, 0, height - 0.9 * _SCALE, 6.4 * _SCALE, height, (44, 44, 46))
    for rear, front, low, high in model.windows_m:
        slope = 0.0 if kind in ("bus", "van", "truck") else 0.3
        corners = [at(rear - slope * 0.4, low), at(rear + slope * 0.3, high), at(front - slope, high), at(front, low)]
        polygon(rgb, corners, _GLASS)
        polygon(
            rgb, [at(rear + 0.1, high), at(rear + 0.3, high), at(rear + 0.1, low), at(rear - 0.05, low)], (92, 106, 118)
        )
        if slope:
            box(
                rgb,
                front * _SCALE + 1,
                height - low * _SCALE,
                front * _SCALE + 2,
                height - 0.4 * _SCALE,
                shade(paint, 0.6),
            )
    box(rgb, 0, height - 0.42 * _SCALE, width, height - 0.28 * _SCALE, shade(paint, 0.4))
    radius = model.wheel_m * _SCALE
    for x in model.wheels_m:
        centre = (round(x * _SCALE), round(height - radius))
        cv2.circle(rgb, centre, round(radius * 1.18), (20, 20, 21), -1, cv2.LINE_AA)
        cv2.circle(alpha, centre, round(radius), 255, -1)
        cv2.circle(rgb, centre, round(radius * 0.58), (148, 150, 152), -1, cv2.LINE_AA)
        cv2.circle(rgb, centre, round(radius * 0.3), (84, 86, 88), -1, cv2.LINE_AA)
    if mirrored:
        rgb, alpha = rgb[:, ::-1].copy(), alpha[:, ::-1].copy()
    if kind == "truck":
        left = 2.6 if mirrored else 1.0
        at_pixel = (round(left * _SCALE), height - round(0.8 * _SCALE) - round(1.4 * _SCALE))
        cv2.putText(rgb, "TRANSPORT", at_pixel, cv2.FONT_HERSHEY_DUPLEX, 0.9, (236, 236, 230), 2, cv2.LINE_AA)
    return Surface(rgb, alpha)
