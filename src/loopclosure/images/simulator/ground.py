"""Painting the ground: road, marks, kerbs, pavements, yards, in tiles."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from loopclosure.images.simulator.randomness import Stream, smooth_noise, stream
from loopclosure.images.simulator.street import FRONTS_M, KERBS_M, LANE_MARK_M, Street
from loopclosure.images.simulator.surface import Surface

TILE_M = 8.0
_PIXELS_PER_M = 24
_REACH_M = 30.0

_PAVINGS = (((168, 162, 154), 0.6), ((150, 140, 128), 0.4), ((178, 174, 170), 0.9), ((162, 158, 150), 0.75))


@lru_cache(maxsize=256)
def paint_tile(street: Street, column: int, row: int) -> Surface:
    """Paint the tile whose lower left corner is (column, row) * TILE_M; its picture has north above."""
    size = round(TILE_M * _PIXELS_PER_M)
    rng = stream(street.seed, Stream.GROUND, 1, column % (1 << 32), row % (1 << 32))
    step = (np.arange(size) + 0.5) / _PIXELS_PER_M
    points = np.stack(
        np.broadcast_arrays(column * TILE_M + step[None, :], row * TILE_M + TILE_M - step[:, None]), axis=-1
    )
    s, left = street.route.locate(points, _REACH_M)
    rgb = np.empty((size, size, 3), np.float32)
    rgb[:] = (116, 112, 100)
    known = np.isfinite(left)
    outside = known & ((left < FRONTS_M[0]) | (left > FRONTS_M[1]))
    road = (left > KERBS_M[0]) & (left < KERBS_M[1])
    if road.any():
        rgb[road] = _road(street, s[road], left[road])
    pavement = known & ~outside & ~road
    if pavement.any():
        rgb[pavement] = _pavement(street, s[pavement], left[pavement])
    if outside.any():
        rgb[outside] = _yards(street, s[outside], left[outside])
    grain = 0.05 * rng.standard_normal((size, size)).astype(np.float32) + 0.06 * smooth_noise(rng, size, size, 5)
    return Surface(np.clip(rgb * (1 + grain[..., None]), 0, 255).astype(np.uint8))


def _road(street: Street, s: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Asphalt with worn wheel tracks, patches, marks, manholes and crossings."""
    wave = 0.05 * np.sin(s / 7.3 + 2 * np.sin(s / 19)) + 0.03 * np.sin(left * 1.7 + s / 5)
    tracks = -0.07 * sum(np.exp(-(((left - t) / 0.32) ** 2)) for t in (-0.8, 0.8, 2.2, 3.8))
    tone = 106 * (1 + wave + tracks)
    block = np.floor(s / 5.0).astype(int)
    dice = stream(street.seed, Stream.GROUND, 2).random((int(street.route.length_m / 5) + 2, 6)).astype(np.float32)
    chosen = dice[np.clip(block, 0, len(dice) - 1)]
    along, centre = s - block * 5.0, KERBS_M[0] + 0.8 + chosen[:, 0] * (KERBS_M[1] - KERBS_M[0] - 1.6)
    patch = (
        (chosen[:, 1] < 0.3)
        & (np.abs(left - centre) < 0.3 + 0.9 * chosen[:, 2])
        & (along > 0.8)
        & (along < 1.6 + 3 * chosen[:, 3])
    )
    tone = np.where(patch, tone * (0.74 + 0.2 * chosen[:, 4]), tone)
    trench = (chosen[:, 5] < 0.12) & (np.abs(along - 2.5) < 0.3)
    tone = np.where(trench, tone * 0.78, tone)
    cover = (chosen[:, 5] > 0.72) & (np.hypot(along - 2.0, left - centre) < 0.33)
    tone = np.where(
        cover, np.where(np.hypot(along - 2.0, left - centre) < 0.27, 66 + 14 * (np.floor(along * 16) % 2), 46), tone
    )
    gutter = np.minimum(left - KERBS_M[0], KERBS_M[1] - left)
    tone = np.where(gutter < 0.3, tone * 0.84, tone)
    colour = np.stack([tone, tone * 0.99, tone * 0.98], axis=-1)
    wear = 0.75 + 0.2 * np.sin(s * 3.1 + left * 5)
    near = np.abs(
        (street.crossings_m[:, None] - s + street.route.length_m / 2) % street.route.length_m
        - street.route.length_m / 2
    ).min(axis=0)
    dashes = (np.abs(left - LANE_MARK_M) < 0.07) & (s % 6.0 < 3.0) & (near > 3.5)
    bays = ((np.abs(left + 1.45) < 0.05) | (np.abs(left - 4.45) < 0.05)) & (near > 3.5) & (s % 1.0 < 0.55)
    zebra = (near < 1.5) & ((left + 0.25) % 1.0 < 0.5)
    stop = (np.abs(near - 2.6) < 0.15) & (left < LANE_MARK_M)
    white = dashes | zebra | stop | bays
    return np.where(white[:, None], colour + (np.array([222, 220, 212]) - colour) * wear[:, None], colour)


def _pavement(street: Street, s: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Slabs between the kerb stone and the fronts; each quarter has its own."""
    right = left < 0
    out = np.where(right, KERBS_M[0] - left, left - KERBS_M[1])
    quarter = street.quarters[
        np.clip((s / street.route.length_m * len(street.quarters)).astype(int), 0, len(street.quarters) - 1)
    ]
    base = np.array([p[0] for p in _PAVINGS], float)[quarter]
    slab = np.array([p[1] for p in _PAVINGS])[quarter]
    column, row = np.floor(s / slab), np.floor(out / slab)
    tone = 1 + 0.09 * np.sin(column * 12.9898 + row * 78.233 + 3 * np.sin(column * 4.1)) + 0.03 * np.sin(s / 3)
    joint = ((s % slab) < 0.035) | ((out % slab) < 0.035)
    tone = np.where(joint, tone * 0.8, tone)
    kerb = out < 0.16
    tone = np.where(kerb, np.where((s % 1.0) < 0.03, 0.85, 1.14), tone)
    wall = np.where(right, left - FRONTS_M[0], FRONTS_M[1] - left)
    return base * (tone * np.clip(0.78 + 0.45 * wall, 0.7, 1.0))[:, None]


def _yards(street: Street, s: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Lawns, alleys and park ground behind the line of the fronts."""
    colour = np.empty((len(s), 3))
    for side in (0, 1):
        here = (left < 0) == (side == 0)
        if not here.any():
            continue
        lots = street.lots[side]
        number = np.clip(np.searchsorted([lot.start_m for lot in lots], s[here], side="right") - 1, 0, len(lots) - 1)
        grounds = {"garden": (88, 116, 58), "park": (82, 108, 54), "alley": (104, 102, 98), "building": (96, 92, 86)}
        colour[here] = np.array([grounds[lot.kind] for lot in lots], float)[number]
    return colour * (1 + 0.1 * np.sin(s * 2.1 + left * 3.7) * np.sin(s * 0.7 - left * 1.3))[:, None]
