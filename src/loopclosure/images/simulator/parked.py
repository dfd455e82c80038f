"""Placing vehicles as rectangles; parked cars, which differ between the laps."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from loopclosure.images.simulator.light import Light
from loopclosure.images.simulator.quads import Lazy, Quads
from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.street import PARKING_M
from loopclosure.images.simulator.surface import Rgb, Texture
from loopclosure.images.simulator.vehicles import MODELS, PAINTS, paint_vehicle

if TYPE_CHECKING:
    from loopclosure.images.simulator.scene import Block, Scene

UP = np.array([0.0, 0.0, 1.0])
LAMPED = ("front", "rear", "doors", "busrear", "cargo")
SLOT_M = 6.0
_OCCUPIED = 0.6
_KINDS = ("hatch", "hatch", "hatch", "sedan", "sedan", "sedan", "suv", "suv", "van")


def add_parked_cars(scene: Scene, block: Block, low_m: float, high_m: float) -> None:
    """Add the cars that are parked along a stretch in this lap."""
    street = scene.street
    for side in (0, 1):
        if not scene.parked[side]:
            continue
        for slot in range(int(np.ceil(low_m / SLOT_M)), int(np.ceil(high_m / SLOT_M))):
            rng = stream(street.seed, Stream.PARKED, scene.lap, side, slot)
            s = (slot + 0.5) * SLOT_M + rng.uniform(-0.35, 0.35)
            if rng.random() > _OCCUPIED or s > street.route.length_m - 3 or street.near_crossing(s, 4.8):
                continue
            kind, paint = _KINDS[int(rng.integers(len(_KINDS)))], PAINTS[int(rng.integers(len(PAINTS)))]
            point, heading = street.route.at(s, PARKING_M[side] + rng.uniform(-0.12, 0.12))
            yaw = float(heading) + (np.pi if side else 0.0) + rng.normal(0, 0.02)
            light = scene.light_at(np.append(point, 1.5), s)
            block.quads.extend(
                vehicle(kind, paint, int(rng.integers(8)), point, yaw, scene.light, light, driving=False)
            )
            block.casters += vehicle_casters(kind, point, yaw)


def vehicle(
    kind: str,
    paint: Rgb,
    variant: int,
    middle: np.ndarray,
    yaw: float,
    light: Light,
    received: np.ndarray,
    *,
    driving: bool,
) -> Quads:
    """Return a vehicle as rectangles.

    Parameters
    ----------
    kind, paint, variant
        See `paint_vehicle`.
    middle : ndarray, (2,)
        Its place on the ground.
    yaw : float
        Where its front points, radians.
    light : Light
    received : ndarray, (3,)
        Light on a level surface at its place.
    driving : bool
        Whether its lamps may be on.
    """
    parts, edges, normals = _shape(kind)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    placed = turn @ edges
    placed[:, :2, 2] += middle
    sunny = np.maximum(0.0, normals @ turn.T @ light.sun) * light.casts_shadows
    tints = received * ((0.78 + 0.22 * normals[:, 2]) * (0.86 + 0.2 * sunny))[:, None]
    textures = []
    for k, part in enumerate(parts):
        shining = driving and light.lamps_on and part in LAMPED
        level = (round(float(received[0]), 1), round(float(received[1]), 1), round(float(received[2]), 1))
        textures.append(_texture(kind, part, paint, variant, level if shining else None))
        if shining:
            tints[k] = 1.0
    quads = Quads()
    quads.add_many(placed, textures, tints)
    return quads


@lru_cache(maxsize=len(MODELS))
def _shape(kind: str) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return parts, rectangles (n, 3, 3) and normals (n, 3) of a vehicle that stands in the origin and points to x."""
    model = MODELS[kind]
    half, top, long = np.array([0, model.width_m / 2, 0]), UP * model.height_m, np.array([model.length_m, 0, 0])
    rear = -long / 2
    found = [
        ("right", rear - half + top, long, -top),
        ("left", rear + long + half + top, -long, -top),
    ]
    points = [rear + np.array([x, 0, z]) for x, z in model.profile_m]
    for part, low, high in zip(model.strips, points[:-1], points[1:], strict=True):
        # Seen from behind while the outline climbs, from the front while it falls.
        if high[2] >= low[2]:
            found.append((part, high + half, -2 * half, low - high))
        else:
            found.append((part, low - half, 2 * half, high - low))
    for x in (model.wheels_m[0], model.wheels_m[-1]):
        axle = rear + np.array([x, 0, 0.36])
        found += [("under", axle + half, -2 * half, -UP * 0.34), ("under", axle - half, 2 * half, -UP * 0.34)]
    edges = np.stack([np.stack([across, down, origin], axis=1) for _, origin, across, down in found])
    normals = np.cross(edges[:, :, 0], -edges[:, :, 1])
    return tuple(part for part, *_ in found), edges, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def vehicle_casters(kind: str, middle: np.ndarray, yaw: float) -> list[np.ndarray]:
    """Return polygons that throw the shadow of a vehicle."""
    model = MODELS[kind]
    ahead, leftward = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    rear = np.append(middle, 0.0) - ahead * model.length_m / 2
    half = leftward * model.width_m / 2
    outline = np.stack([rear + ahead * x + UP * z for x, z in model.profile_m])
    floor = np.stack(
        [rear - half, rear + half, rear + half + ahead * model.length_m, rear - half + ahead * model.length_m]
    )
    roof = outline[np.argsort(-outline[:, 2])[:2]]
    return [outline - half, outline + half, floor + UP * 0.31, np.concatenate([roof - half, roof[::-1] + half])]


@lru_cache(maxsize=600)
def _texture(kind: str, part: str, paint: Rgb, variant: int, shining: tuple[float, float, float] | None) -> Lazy:
    return Lazy(partial(_painted, kind, part, paint, variant, shining))


def _painted(kind: str, part: str, paint: Rgb, variant: int, shining: tuple[float, float, float] | None) -> Texture:
    surface = paint_vehicle(kind, part, paint, variant)
    rgb = surface.rgb
    if shining is not None and surface.glow is not None:
        rgb = np.clip(rgb * np.array(shining) + surface.glow, 0, 255).astype(np.uint8)
    return Texture(rgb, surface.alpha)
