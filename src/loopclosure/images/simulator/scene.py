"""The standing world of one lap, built block by block where the camera comes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np

from loopclosure.images.simulator.buildings import add_building
from loopclosure.images.simulator.furniture import add_item, add_lamp, add_yard
from loopclosure.images.simulator.ground import TILE_M, paint_tile
from loopclosure.images.simulator.light import Light
from loopclosure.images.simulator.parked import add_parked_cars
from loopclosure.images.simulator.quads import Lazy, Quads
from loopclosure.images.simulator.shadows import shadow_mask
from loopclosure.images.simulator.street import Street
from loopclosure.images.simulator.surface import Surface, Texture, lit

BLOCK_M = 10.0
VIEW_M = 110.0
BEHIND_M = 12.0
_SHADOW_REACH_M = 36.0
_LAMP_REACH_M = 26.0
_KEPT_BLOCKS = 26
_KEPT_TILES = 160
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Block:
    """What stands along one stretch of the street: rectangles, and polygons that throw shadows."""

    quads: Quads = field(default_factory=Quads)
    casters: list[np.ndarray] = field(default_factory=list)


class Scene:
    """One lap's street under its light.

    Parameters
    ----------
    street : Street
    light : Light
    lap : int
    shadows : bool
    parked : tuple of bool
        Whether cars park on the right and on the left.
    """

    def __init__(self, street: Street, light: Light, *, lap: int, shadows: bool, parked: tuple[bool, bool]) -> None:
        self.street, self.light, self.lap, self.parked = street, light, lap, parked
        self.shadows = shadows and light.casts_shadows
        self.blocks = max(1, math.ceil(street.route.length_m / BLOCK_M))
        self.block = lru_cache(maxsize=_KEPT_BLOCKS)(self._build_block)
        self.tile = lru_cache(maxsize=_KEPT_TILES)(self._ground_tile)
        self.tiles_of_block = lru_cache(maxsize=256)(self._tiles_of_block)
        self._lamp_s, self._lamp_points = street.lamp_heads()

    def visible_blocks(self, s_m: float, heading: int) -> list[int]:
        """Return the blocks in front of a camera at `s_m` that looks along (+1) or against (-1) the route."""
        low, high = (s_m - BEHIND_M, s_m + VIEW_M) if heading > 0 else (s_m - VIEW_M, s_m + BEHIND_M)
        first, last = math.floor(low / BLOCK_M), math.floor(high / BLOCK_M)
        return sorted({k % self.blocks for k in range(first, last + 1)})

    def ground(self, blocks: list[int]) -> Quads:
        """Return the ground tiles of some blocks."""
        quads = Quads()
        for column, row in sorted({tile for k in blocks for tile in self.tiles_of_block(k)}):
            corner = np.array([column * TILE_M, (row + 1) * TILE_M, 0.0])
            quads.add(corner, np.array([TILE_M, 0, 0]), np.array([0, -TILE_M, 0]), self.tile(column, row))
        return quads

    def standing(self, blocks: list[int]) -> Quads:
        """Return all that stands in some blocks."""
        quads = Quads()
        for number in blocks:
            quads.extend(self.block(number).quads)
        return quads

    def lamps_near(self, s_m: float) -> np.ndarray:
        """Return the lamp heads (lamps, 3) around a place."""
        return self._lamp_points[np.abs(self._around(self._lamp_s, s_m)) < _LAMP_REACH_M]

    def light_at(self, points_m: np.ndarray, s_m: float, normal: np.ndarray = UP) -> np.ndarray:
        """Return the light (..., 3) on small things around `s_m`."""
        return self.light.on(points_m, normal, self.lamps_near(s_m)) * self.light.exposure

    def texture(
        self, paint: Callable[[], Surface], s_m: float, origin: np.ndarray, across: np.ndarray, down: np.ndarray
    ) -> Lazy:
        """Return the texture of a large surface around `s_m`, with lamps and cast shadows on it."""
        return Lazy(partial(self._lit, paint, s_m, origin, across, down))

    def _lit(
        self, paint: Callable[[], Surface], s_m: float, origin: np.ndarray, across: np.ndarray, down: np.ndarray
    ) -> Texture:
        surface = paint()
        normal = np.cross(across, -down)
        normal = normal / np.linalg.norm(normal)
        mask = self._shadow(s_m, origin, across, down) if self.shadows else None
        rows, columns = mask.shape if mask is not None else (12, 12)
        v, u = (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns
        points = origin + u[None, :, None] * across + v[:, None, None] * down
        sunlit = 1.0 if mask is None else 1 - mask
        light = self.light.on(points, np.broadcast_to(normal, points.shape), self.lamps_near(s_m), sunlit)
        return lit(surface, light * self.light.exposure, glowing=self.light.lamps_on)

    def _shadow(self, s_m: float, origin: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray | None:
        first, last = math.floor((s_m - _SHADOW_REACH_M) / BLOCK_M), math.floor((s_m + _SHADOW_REACH_M) / BLOCK_M)
        blocks = sorted({k % self.blocks for k in range(first, last + 1)})
        casters = [polygon for k in blocks for polygon in self.block(k).casters]
        return shadow_mask(casters, self.light.sun, origin, across, down)

    def _build_block(self, number: int) -> Block:
        block, street = Block(), self.street
        low, high = number * BLOCK_M, (number + 1) * BLOCK_M
        for side in street.lots:
            for lot in side:
                if low <= lot.start_m < high:
                    if lot.kind in ("building", "garden"):
                        add_building(self, block, lot)
                    if lot.kind != "building":
                        add_yard(self, block, lot)
        for item in street.items:
            if low <= item.s_m < high:
                add_item(self, block, item)
        for lamp in street.lamps:
            if low <= lamp.s_m < high:
                add_lamp(self, block, lamp)
        add_parked_cars(self, block, low, min(high, street.route.length_m))
        return block

    def _tiles_of_block(self, number: int) -> tuple[tuple[int, int], ...]:
        s = np.arange(number * BLOCK_M, (number + 1) * BLOCK_M + 1, 2.0)
        low, high = -8.0, 11.0
        for side, lots in enumerate(self.street.lots):
            if any(lot.kind != "building" and lot.start_m < s[-1] and lot.end_m > s[0] for lot in lots):
                low, high = (low - 9, high) if side == 0 else (low, high + 9)
        points, _ = self.street.route.at(s[:, None], np.arange(low, high + 1, 2.0)[None, :])
        return tuple(sorted({(int(x), int(y)) for x, y in np.floor(points.reshape(-1, 2) / TILE_M)}))

    def _ground_tile(self, column: int, row: int) -> Lazy:
        corner = np.array([column * TILE_M, (row + 1) * TILE_M, 0.0])
        across, down = np.array([TILE_M, 0, 0]), np.array([0, -TILE_M, 0])
        middle = (corner + across / 2 + down / 2)[:2]
        s, _ = self.street.route.locate(middle[None], 40.0)
        return self.texture(partial(paint_tile, self.street, column, row), float(s[0]), corner, across, down)

    def _around(self, s: np.ndarray, centre_m: float) -> np.ndarray:
        length = self.street.route.length_m
        return (s - centre_m + length / 2) % length - length / 2
