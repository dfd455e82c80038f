"""Painting the fronts and sides of buildings."""

from __future__ import annotations

import cv2
import numpy as np

from loopclosure.images.simulator.districts import Building
from loopclosure.images.simulator.ground_floors import paint_ground_floor
from loopclosure.images.simulator.randomness import smooth_noise
from loopclosure.images.simulator.surface import Surface, box, mixed, plain, shade, tinted
from loopclosure.images.simulator.windows import PIXELS_PER_M, Front, paint_glass, paint_window


def paint_front(building: Building, rng: np.random.Generator, *, lit: float, lamps: np.random.Generator) -> Surface:
    """Paint the street side of a building.

    Parameters
    ----------
    building : Building
    rng : numpy.random.Generator
        Of this building alone.
    lit : float
        Share of the windows with light behind them.
    lamps : numpy.random.Generator
        Which windows are lit: another evening, other windows.
    """
    height, width = round(building.height_m * PIXELS_PER_M), max(8, round(building.width_m * PIXELS_PER_M))
    wall = paint_wall(building, rng, height, width)
    front = Front(wall, np.zeros_like(wall), rng, lamps, lit)
    bottom = height - round(building.storeys_m[0] * PIXELS_PER_M)
    if building.glass:
        _curtain_wall(front, building, bottom)
    else:
        _upper_storeys(front, building, bottom)
    paint_ground_floor(front, building, bottom)
    _cornice(front, building)
    if rng.random() < 0.5:
        x = width - 5 if rng.random() < 0.5 else 3
        front.box(x, 8, x + 3, height, shade(building.wall, 0.62))
    _weather(front)
    if building.ivy:
        _ivy(front)
    return Surface(front.rgb, None, front.glow if front.glow.any() else None)


def paint_side(building: Building, rng: np.random.Generator, depth_m: float) -> Surface:
    """Paint the wall that stands at a right angle to the street: few windows."""
    height, width = round(building.height_m * 16), round(depth_m * 16)
    colour = building.wall if rng.random() < 0.5 else mixed(building.wall, (176, 166, 152), 0.6)
    rgb = tinted(plain(height, width, colour), 0.05 * smooth_noise(rng, height, width, 20))
    top = height
    for storey in building.storeys_m:
        top -= round(storey * 16)
        for x in np.arange(2.0, depth_m - 1.5, 2.8) * 16:
            if rng.random() < 0.35:
                box(rgb, x - 1, top + 11, x + 17, top + 37, shade(colour, 1.15))
                box(rgb, x, top + 12, x + 16, top + 36, (58, 66, 76))
    return Surface(rgb)


def paint_wall(building: Building, rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Paint bare masonry, (height, width, 3)."""
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    grain = 0.022 * rng.standard_normal((height, width)).astype(np.float32)
    stains = 0.05 * smooth_noise(rng, height, width, 60) + 0.03 * smooth_noise(rng, height, width, 14)
    bond = {"brick": (4, 9, 0.13, 0.10), "stone": (14, 28, 0.07, -0.16), "panel": (96, 110, 0.02, -0.20)}
    if building.material in bond:
        tall, wide, variety, joint = bond[building.material]
        course = rows // tall
        column = (columns + (course % 2) * (wide // 2)) // wide
        tones = rng.uniform(-variety, variety, (height // tall + 1, width // wide + 3))
        amount = tones[course, column] + grain + stains
        lines = (rows % tall == 0) | ((columns + (course % 2) * (wide // 2)) % wide == 0)
        amount = np.where(lines, amount + joint, amount)
    elif building.material == "siding":
        amount = np.where(rows % 6 == 0, -0.2, 0.04 * (rows % 6) / 6) + grain + 0.5 * stains
    else:
        amount = grain + stains
    return tinted(plain(height, width, building.wall), amount.astype(np.float32))


def _upper_storeys(front: Front, building: Building, bottom: int) -> None:
    p = PIXELS_PER_M
    width = front.rgb.shape[1]
    bays = max(1, round(building.width_m / building.bay_m))
    bay = width / bays
    wide, tall = min(building.window_m[0] * p, bay * 0.8), building.window_m[1] * p
    for number, storey in enumerate(building.storeys_m[1:]):
        top = bottom - storey * p
        shrink = 0.8 if number == len(building.storeys_m) - 2 and number > 0 else 1.0
        sill = bottom - min(0.85 * p, storey * p - tall * shrink - 0.35 * p)
        for k in range(bays):
            middle = (k + 0.5) * bay
            rect = (middle - wide / 2, sill - tall * shrink, middle + wide / 2, sill)
            paint_window(front, building, rect)
            if building.balconies and (k + number) % building.balconies == 0:
                _balcony(front, building, middle, bay, sill, bottom)
        if building.string_course:
            front.box(0, bottom - 0.14 * p, width, bottom, building.trim)
            front.box(0, bottom, width, bottom + 2, shade(building.wall, 0.6))
        bottom = round(top)


def _balcony(front: Front, building: Building, middle: float, bay: float, sill: float, floor: float) -> None:
    rail = (52, 52, 56) if building.material != "plaster" else building.trim
    left, right, top = middle - bay * 0.44, middle + bay * 0.44, floor - 1.0 * PIXELS_PER_M
    front.box(left + 4, sill - 8, right - 4, floor - 3, shade(building.frame, 0.5))
    for x in np.arange(left, right, 5):
        front.box(x, top, x + 1.6, floor, rail)
    front.box(left, top, right, top + 3, rail)
    front.box(left - 3, floor - 4, right + 3, floor + 2, shade(building.trim, 0.92))
    front.box(left - 3, floor + 2, right + 3, floor + 9, shade(building.wall, 0.55))


def _curtain_wall(front: Front, building: Building, bottom: int) -> None:
    width = front.rgb.shape[1]
    p = PIXELS_PER_M
    columns = max(2, round(building.width_m / building.bay_m))
    tint = np.array(building.wall)
    for storey in building.storeys_m[1:]:
        top = round(bottom - storey * p)
        for k in range(columns):
            rect = (k * width / columns, top + 0.75 * p, (k + 1) * width / columns - 2, bottom)
            paint_glass(front, rect, curtains=0.25)
            x0, y0, x1, y1 = (max(0, round(v)) for v in rect)
            front.rgb[y0:y1, x0:x1] = (0.55 * front.rgb[y0:y1, x0:x1] + 0.45 * tint * front.rng.uniform(0.8, 1.1)).clip(
                0, 255
            )
        front.box(0, top, width, top + 0.75 * p, shade(building.wall, 0.72))
        front.box(0, top + 0.75 * p, width, top + 0.75 * p + 2, building.frame)
        bottom = top
    for k in range(columns + 1):
        front.box(k * width / columns - 2, 0, k * width / columns + 1, front.rgb.shape[0], building.frame)


def _cornice(front: Front, building: Building) -> None:
    width = front.rgb.shape[1]
    deep = round(building.cornice_m * PIXELS_PER_M)
    front.box(0, 0, width, deep, building.trim)
    front.box(0, deep * 0.6, width, deep * 0.75, shade(building.trim, 0.75))
    if deep > 12:
        for x in range(3, width, 13):
            front.box(x, deep * 0.75, x + 6, deep + 4, shade(building.trim, 0.9))
    front.rgb[deep : deep + 5] = (front.rgb[deep : deep + 5] * 0.6).astype(np.uint8)
    if building.quoins:
        for number, y in enumerate(range(deep, front.rgb.shape[0] - 40, 14)):
            wide = 16 if number % 2 else 10
            front.box(0, y, wide, y + 12, building.trim)
            front.box(width - wide, y, width, y + 12, building.trim)


def _weather(front: Front) -> None:
    """Soot above the ground, streaks of rain down the wall."""
    height, width = front.rgb.shape[:2]
    streaks = cv2.resize(
        front.rng.uniform(-1, 1, (3, max(2, width // 5))).astype(np.float32),
        (width, height),
        interpolation=cv2.INTER_CUBIC,
    )
    soot = 0.16 * np.minimum(0, np.linspace(height / 40, -1, height, dtype=np.float32))[:, None]
    front.rgb[:] = tinted(front.rgb, 0.05 * streaks + soot)


def _ivy(front: Front) -> None:
    height, width = front.rgb.shape[:2]
    rng = front.rng
    reach = np.linspace(1.6, -1.3, height)[::-1, None] + 0.9 * smooth_noise(rng, height, width, 45)
    side = np.linspace(1.2, -1.2, width)[None, :] * (1 if rng.random() < 0.5 else -1)
    leaves = reach + side + 0.7 * smooth_noise(rng, height, width, 5) > 1.1
    tone = (0.75 + 0.45 * smooth_noise(rng, height, width, 4))[..., None] * np.array((58, 88, 40))
    front.rgb[leaves] = tone.clip(0, 255).astype(np.uint8)[leaves]
    front.glow[leaves] = 0
