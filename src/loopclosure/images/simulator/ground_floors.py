"""Painting ground floors: shops, entrances, lobbies, garages."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from loopclosure.images.simulator.districts import Building
from loopclosure.images.simulator.surface import Rgb, mixed, polygon, shade
from loopclosure.images.simulator.windows import PIXELS_PER_M, Front, Rect, paint_door, paint_window

# fmt: off
_NAMES = (
    "BAKERY", "CAFE LUNA", "BOOKS", "PHARMACY", "OPTIK", "HOTEL", "BAR 21", "FLORIST", "PIZZA", "BANK", "SHOES",
    "BARBER", "TEA ROOM", "MARKET", "CYCLES", "GALLERY", "TAILOR", "RECORDS", "NOODLES", "DENTIST", "TOYS", "BISTRO",
    "HARDWARE", "WINES", "LAUNDRY", "PHOTO", "GRILL", "MUSIC", "KIOSK", "DELI", "FISH", "SALON", "COPY", "JEWELS",
    "SUSHI", "TATTOO", "ANTIQUES", "GYM", "TRAVEL", "PUB", "CHEMIST", "OPTICIAN", "CURRY", "FABRICS", "VINYL", "CLINIC",
)
# fmt: on
_SIGN_COLOURS: tuple[Rgb, ...] = (
    (150, 28, 32),
    (22, 66, 120),
    (24, 92, 62),
    (42, 40, 44),
    (196, 148, 40),
    (228, 222, 208),
    (104, 44, 92),
    (30, 120, 128),
    (190, 92, 34),
    (60, 78, 40),
)  # fmt: skip
_DOOR_COLOURS: tuple[Rgb, ...] = (
    (120, 34, 30), (28, 52, 88), (34, 74, 54), (46, 40, 38), (108, 74, 44), (190, 186, 176), (70, 90, 104),
    (150, 120, 50),
)  # fmt: skip


def paint_ground_floor(front: Front, building: Building, top: int) -> None:
    """Paint the ground floor of a building below the row `top`."""
    paint = {"shop": _shops, "home": _home_entrance, "lobby": _lobby, "garage": _garage}[building.ground_floor]
    paint(front, building, top)


def _shops(front: Front, building: Building, top: int) -> None:
    """Paint one or two shops: a sign over display windows and a door."""
    height, width = front.rgb.shape[:2]
    p = PIXELS_PER_M
    shops = 2 if building.width_m > 9 and front.rng.random() < 0.7 else 1
    for number in range(shops):
        left, right = width * number / shops, width * (number + 1) / shops
        sign, trim = front.pick(_SIGN_COLOURS), front.pick(_DOOR_COLOURS)
        front.box(left, top, right, height, shade(building.trim, 0.86))
        front.box(left + 5, top + 0.1 * p, right - 5, height, trim)
        _sign(front, sign, (left + 5, top + 0.12 * p, right - 5, top + 0.85 * p))
        floor, glass_top = height - 0.5 * p, top + 1.0 * p
        door = left + (right - left) * front.rng.uniform(0.15, 0.75)
        panes = max(2, round((right - left) / (1.6 * p)))
        edges = np.linspace(left + 9, right - 9, panes + 1)
        for a, b in pairwise(edges.tolist()):
            _display(front, (a + 2, glass_top, b - 2, floor))
        paint_door(front, building, door, glass_top, height, glazed=True, colour=trim)
        if front.rng.random() < 0.45:
            _awning(front, (left + 4, top + 0.9 * p, right - 4, top + 1.65 * p), sign)


def _sign(front: Front, colour: Rgb, rect: Rect) -> None:
    left, top, right, bottom = rect
    front.box(left, top, right, bottom, colour)
    front.box(left, bottom - 2, right, bottom, shade(colour, 0.6))
    text = _NAMES[int(front.rng.integers(len(_NAMES)))]
    ink: Rgb = (244, 238, 220) if sum(colour) < 400 else (48, 34, 30)
    font = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)[int(front.rng.integers(3))]
    size = 0.62
    (wide, tall), _ = cv2.getTextSize(text, font, size, 2)
    size *= min(1.0, 0.9 * (right - left) / wide, 0.62 * (bottom - top) / tall)
    (wide, tall), _ = cv2.getTextSize(text, font, size, 2)
    at = (round((left + right - wide) / 2), round((top + bottom + tall) / 2) - 1)
    cv2.putText(front.rgb, text, at, font, size, ink, 2, cv2.LINE_AA)
    if front.lamps.random() < 0.7:
        cv2.putText(front.glow, text, at, font, size, shade(ink, 0.8), 2, cv2.LINE_AA)


def _display(front: Front, rect: Rect) -> None:
    """Paint a shop window: reflections, and goods on shelves that shine at night."""
    left, top, right, bottom = (round(v) for v in rect)
    view = front.rgb[top:bottom, left:right]
    if view.size == 0:
        return
    rng = front.rng
    ramp = np.linspace(0.75, 0.1, view.shape[0])[:, None, None]
    back = np.array(front.pick(((70, 60, 50), (48, 52, 60), (92, 84, 74), (60, 48, 44))))
    view[:] = (1 - ramp) * back + ramp * np.array((120, 138, 152))
    goods: tuple[Rgb, ...] = (
        (196, 60, 48),
        (220, 190, 110),
        (70, 110, 160),
        (230, 226, 214),
        (90, 130, 80),
        (150, 90, 120),
    )
    for _ in range(int(rng.integers(3, 10))):
        x, wide, tall = rng.uniform(left, right - 4), rng.uniform(4, 14), rng.uniform(5, 22)
        shelf = bottom - int(rng.integers(0, 2)) * 0.35 * (bottom - top)
        front.box(x, shelf - tall, min(x + wide, right), shelf, shade(front.pick(goods), rng.uniform(0.5, 0.9)))
    if front.lit > 0 and front.lamps.random() < 0.85:
        front.glow[top:bottom, left:right] = view * 0.55 + np.array(front.warm()) * front.lamps.uniform(0.15, 0.4)
    if right - left > 30:
        x = left + rng.uniform(0, right - left - 27)
        polygon(front.rgb, [(x, bottom), (x + 8, bottom), (x + 24, top), (x + 16, top)], (148, 160, 170))


def _awning(front: Front, rect: Rect, colour: Rgb) -> None:
    left, top, right, bottom = rect
    second: Rgb = (236, 230, 218) if front.rng.random() < 0.6 else shade(colour, 0.85)
    for number, x in enumerate(np.arange(left, right, 11)):
        tone = colour if number % 2 else second
        front.box(x, top, min(x + 11, right), bottom - 6, tone)
        front.box(x, bottom - 6, min(x + 11, right), bottom, shade(tone, 0.75))
    front.rgb[round(bottom) : round(bottom) + 10, round(left) : round(right)] //= 2


def _home_entrance(front: Front, building: Building, top: int) -> None:
    """Paint a door between windows, on a plinth."""
    height, width = front.rgb.shape[:2]
    p = PIXELS_PER_M
    front.box(0, height - 0.55 * p, width, height, shade(building.trim, 0.62))
    bays = max(2, round(building.width_m / building.bay_m))
    bay = width / bays
    entrance = int(front.rng.integers(bays))
    tall = min(building.window_m[1] * p, height - top - 1.45 * p)
    for k in range(bays):
        middle = (k + 0.5) * bay
        if k == entrance:
            paint_door(
                front,
                building,
                middle - 0.52 * p,
                height - 2.3 * p,
                height - 3,
                glazed=False,
                colour=front.pick(_DOOR_COLOURS),
            )
            front.box(middle - 0.8 * p, height - 4, middle + 0.8 * p, height, (150, 146, 140))
            front.box(
                middle - 0.9 * p, height - 2.55 * p, middle + 0.9 * p, height - 2.4 * p, shade(building.trim, 1.03)
            )
        else:
            wide = min(building.window_m[0] * p, bay * 0.8)
            paint_window(front, building, (middle - wide / 2, height - p - tall, middle + wide / 2, height - p))


def _lobby(front: Front, building: Building, top: int) -> None:
    """Paint a glazed ground floor between pillars."""
    height, width = front.rgb.shape[:2]
    panes = max(3, round(building.width_m / 2.2))
    front.box(0, top, width, height, shade(building.trim, 0.7))
    for k in range(panes):
        _display(front, (k * width / panes + 5, top + 14, (k + 1) * width / panes - 5, height - 6))
    _sign(front, (46, 50, 58), (width * 0.3, top, width * 0.7, top + 13))
    paint_door(front, building, width * front.rng.uniform(0.3, 0.6), top + 16, height, glazed=True, colour=(60, 62, 66))


def _garage(front: Front, building: Building, top: int) -> None:
    """Paint a roller door beside a small one, sometimes sprayed on."""
    height, width = front.rgb.shape[:2]
    p, rng = PIXELS_PER_M, front.rng
    colour = mixed(front.pick(_DOOR_COLOURS), (150, 152, 154), 0.6)
    left, right = width * 0.1, width * rng.uniform(0.5, 0.65)
    front.box(left - 5, top + 0.3 * p, right + 5, height, building.trim)
    front.box(left, top + 0.45 * p, right, height, colour)
    for y in np.arange(top + 0.45 * p, height, 5):
        front.box(left, y, right, y + 1.5, shade(colour, 0.78))
    if rng.random() < 0.6:
        points = np.cumsum(rng.uniform(-14, 20, (9, 2)), axis=0) % (max(8.0, right - left - 14), 40) + (
            left + 6,
            height - 62,
        )
        cv2.polylines(front.rgb, [points.astype(np.int32)], False, front.pick(_SIGN_COLOURS), 4, cv2.LINE_AA)
    paint_door(
        front, building, min(right + 0.5 * p, width - 1.3 * p), height - 2.2 * p, height, glazed=False, colour=colour
    )
