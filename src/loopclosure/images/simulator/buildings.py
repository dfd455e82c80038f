"""Placing buildings: fronts, side walls, roofs, chimneys, awnings of depth."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from loopclosure.images.simulator.districts import Building
from loopclosure.images.simulator.facades import paint_front, paint_side
from loopclosure.images.simulator.randomness import Stream, smooth_noise, stream
from loopclosure.images.simulator.street import FRONTS_M, GARDEN_DEPTH_M, Lot
from loopclosure.images.simulator.surface import Rgb, Surface, plain, polygon, shade, tinted

if TYPE_CHECKING:
    from loopclosure.images.simulator.scene import Block, Scene

DEPTH_M = 9.0
UP = np.array([0.0, 0.0, 1.0])


def front_line(scene: Scene, lot: Lot, setback_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and the right foot (3,) of a lot's front, as seen from the street."""
    left_m = FRONTS_M[lot.side] + (setback_m if lot.side else -setback_m)
    ends, _ = scene.street.route.at(np.array([lot.start_m, lot.end_m - 1e-6]), left_m)
    feet = np.concatenate([ends, np.zeros((2, 1))], axis=1)
    return (feet[0], feet[1]) if lot.side else (feet[1], feet[0])


def add_building(scene: Scene, block: Block, lot: Lot) -> None:
    """Add the building of a lot, and what throws shadows of it."""
    left, right = front_line(scene, lot, GARDEN_DEPTH_M if lot.kind == "garden" else 0.0)
    across = right - left
    width = float(np.linalg.norm(across))
    building = scene.street.building(lot, width)
    outward = np.cross(across / width, UP)
    back, top, s = -outward * DEPTH_M, UP * building.height_m, (lot.start_m + lot.end_m) / 2
    seed = scene.street.seed
    evening = scene.lap if scene.light.lit_windows > 0 else 0
    paint = partial(_front, building, seed, lot.number, scene.light.lit_windows, evening)
    _add(scene, block, s, paint, left + top, across, -top)
    for number, (corner, along) in enumerate(((left + back + top, -back), (right + top, back))):
        paint = partial(paint_side, building, stream(seed, Stream.FACADE, lot.number, 2 + number), DEPTH_M)
        _add(scene, block, s, paint, corner, along, -top)
    block.casters += [
        np.stack([a, b, b + top, a + top])
        for a, b in ((left, right), (left, left + back), (right, right + back), (left + back, right + back))
    ]
    if building.roof == "pitched":
        _add_roof(scene, block, building, s, left + top, right + top, outward)
    else:
        block.casters.append(np.stack([left + top, right + top, right + back + top, left + back + top]))


def _add_roof(
    scene: Scene, block: Block, building: Building, s: float, left: np.ndarray, right: np.ndarray, outward: np.ndarray
) -> None:
    rise, half = UP * building.roof_rise_m, -outward * DEPTH_M / 2
    eave = outward * 0.35 - UP * 0.1
    across = right - left
    down = eave - half - rise
    rng = stream(scene.street.seed, Stream.FACADE, round(s * 100), 9)
    _add(scene, block, s, partial(_roof, building, rng, float(np.linalg.norm(down))), left + half + rise, across, down)
    gable = partial(_gable, building)
    _add(scene, block, s, gable, left + 2 * half + rise, -2 * half, -rise)
    _add(scene, block, s, gable, right + rise, 2 * half, -rise)
    block.casters.append(np.stack([left + eave, right + eave, right + half + rise, left + half + rise]))
    block.casters.append(np.stack([left + 2 * half, right + 2 * half, right + half + rise, left + half + rise]))
    if building.chimney >= 0:
        _add_chimney(scene, block, building, s, left + half + rise + across * building.chimney, across, outward)


def _add_chimney(
    scene: Scene, block: Block, building: Building, s: float, foot: np.ndarray, across: np.ndarray, outward: np.ndarray
) -> None:
    along = across / np.linalg.norm(across) * 0.9
    toward, top = outward * 0.6, UP * 0.9
    down = -UP * 1.8
    brick: Rgb = (128, 76, 60) if building.material != "siding" else (150, 140, 130)
    for corner, edge in ((foot + toward + top, along), (foot + top, toward), (foot + along + toward + top, -toward)):
        _add(scene, block, s, partial(_plain, brick), corner, edge, down)


def _add(
    scene: Scene,
    block: Block,
    s: float,
    paint: partial[Surface],
    origin: np.ndarray,
    across: np.ndarray,
    down: np.ndarray,
) -> None:
    block.quads.add(origin, across, down, scene.texture(paint, s, origin, across, down))


@lru_cache(maxsize=96)
def _front(building: Building, seed: int, number: int, lit: float, evening: int) -> Surface:
    rng, lamps = stream(seed, Stream.FACADE, number), stream(seed, Stream.FACADE, number, 10 + evening)
    return paint_front(building, rng, lit=lit, lamps=lamps)


def _plain(colour: Rgb) -> Surface:
    rgb = plain(24, 16, colour)
    rgb[:4] = shade(colour, 0.8)
    return Surface(rgb)


def _roof(building: Building, rng: np.random.Generator, slope_m: float) -> Surface:
    """Rows of tiles, and sometimes roof windows."""
    height, width = max(8, round(slope_m * 16)), max(8, round(building.width_m * 16))
    rows = np.arange(height)[:, None]
    tones = rng.uniform(-0.1, 0.1, (height // 4 + 1, width // 5 + 1))
    amount = tones[rows // 4, np.arange(width)[None, :] // 5] + 0.1 * smooth_noise(rng, height, width, 24)
    rgb = tinted(plain(height, width, building.roof_colour), np.where(rows % 4 == 0, amount - 0.2, amount))
    if rng.random() < 0.5:
        for x in np.arange(1.5, building.width_m - 1.5, 2.6) * 16:
            left, top = round(x), round(height * 0.35)
            rgb[top : top + 20, left : left + 14] = (66, 74, 84)
            rgb[top : top + 2, left : left + 14] = (200, 200, 196)
    rgb[:3] = shade(building.roof_colour, 0.75)
    return Surface(rgb)


def _gable(building: Building) -> Surface:
    rgb, alpha = plain(48, 96, building.wall), np.zeros((48, 96), np.uint8)
    polygon(alpha, [(0, 48), (48, 0), (96, 48)], 255)
    return Surface(rgb, alpha)
