"""Painting trees, hedges and shrubs."""

from __future__ import annotations

import cv2
import numpy as np

from loopclosure.images.simulator.randomness import smooth_noise
from loopclosure.images.simulator.surface import Rgb, Surface, polygon, shade

_GREENS: tuple[Rgb, ...] = (
    (70, 90, 46), (82, 102, 52), (60, 80, 44), (94, 108, 58), (56, 76, 54), (104, 106, 54), (128, 104, 52),
    (116, 74, 46),
)  # fmt: skip
_BARKS: tuple[Rgb, ...] = ((86, 68, 52), (104, 92, 78), (70, 60, 50))


def paint_tree(rng: np.random.Generator, height_m: float, width_m: float) -> Surface:
    """Paint one tree: a trunk with boughs under a crown of leaf clusters, light from above."""
    height, width = round(height_m * 32), round(width_m * 32)
    bark, green = _BARKS[int(rng.integers(len(_BARKS)))], _GREENS[int(rng.integers(len(_GREENS)))]
    rgb, alpha = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)
    rgb[:] = shade(green, 0.6)
    kind = int(rng.integers(3 if green[0] > green[1] else 4))
    crown_low, crown_wide = ((0.62, 0.46), (0.66, 0.47), (0.8, 0.3), (0.86, 0.42))[kind]
    _trunk(rng, rgb, alpha, bark, crown_low)
    count = int(260 * width_m / 4)
    v = np.sqrt(rng.uniform(0, 1, count))
    v = np.where(rng.random(count) < 0.5, v, rng.uniform(0, 1, count))
    profile = (np.sin(np.pi * v**0.8), np.sin(np.pi * np.sqrt(v)), np.sin(np.pi * v**0.7) ** 0.5, 0.12 + v)[kind]
    x = width * (0.5 + crown_wide * profile * rng.uniform(-1, 1, count) * 0.88)
    y = height * (0.04 + (crown_low - 0.04) * v)
    leaf = rng.uniform(0.05, 0.1, count) * width
    # Leaves that are high and to the outside take the light: painted last, over the dark inside of the crown.
    brightness = 0.5 + 0.6 * (1 - v) + 0.22 * (x / width - 0.5) + rng.normal(0, 0.16, count)
    for k in np.argsort(brightness):
        tone = shade(green, float(np.clip(brightness[k], 0.38, 1.25)))
        centre, axes = (round(x[k]), round(y[k])), (max(2, round(leaf[k])), max(2, round(leaf[k] * 0.7)))
        cv2.ellipse(rgb, centre, axes, float(rng.uniform(0, 180)), 0, 360, tone, -1)
        cv2.ellipse(alpha, centre, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1)
    speckle = smooth_noise(rng, height, width, 2)
    crown = np.arange(height)[:, None] < crown_low * height * 0.97
    rgb = np.where(crown[..., None], np.clip(rgb * (1 + 0.3 * speckle[..., None]), 0, 255), rgb).astype(np.uint8)
    ragged = cv2.GaussianBlur(alpha, (0, 0), 2.5).astype(np.float32) + 95 * speckle
    alpha = np.where(crown, np.where(ragged > 128, 255, 0), alpha).astype(np.uint8)
    return Surface(rgb, alpha)


def paint_hedge(rng: np.random.Generator, height_m: float, width_m: float) -> Surface:
    """Paint clipped leaves, ragged along the upper edge."""
    height, width = max(8, round(height_m * 32)), max(8, round(width_m * 32))
    green = np.array(_GREENS[int(rng.integers(5))])
    tone = 0.85 + 0.3 * smooth_noise(rng, height, width, 4) + 0.12 * smooth_noise(rng, height, width, 16)
    tone += np.linspace(0.2, -0.35, height)[:, None]
    edge = np.arange(height)[:, None] > 2.5 + 2.5 * smooth_noise(rng, 1, width, 5)[:1]
    return Surface(np.clip(tone[..., None] * green, 0, 255).astype(np.uint8), np.where(edge, 255, 0).astype(np.uint8))


def _trunk(rng: np.random.Generator, rgb: np.ndarray, alpha: np.ndarray, bark: Rgb, crown_low: float) -> None:
    height, width = alpha.shape
    middle, half = width * 0.5, max(2.5, 0.035 * width + 1.5)
    top = height * (crown_low - 0.25)
    shapes = [
        [
            (middle - half * 1.35, height),
            (middle - half * 0.7, top),
            (middle + half * 0.7, top),
            (middle + half * 1.35, height),
        ]
    ]
    for _ in range(4):
        foot, tip = (
            height * (crown_low + rng.uniform(-0.02, 0.12)),
            (middle + width * rng.uniform(-0.3, 0.3), height * rng.uniform(0.25, 0.5)),
        )
        shapes.append([(middle - half * 0.5, foot), tip, (middle + half * 0.5, foot - 4)])
    for points in shapes:
        polygon(rgb, points, bark)
        polygon(alpha, points, 255)
    dark = [
        (middle + half * 0.1, height),
        (middle + half * 0.1, top),
        (middle + half * 0.7, top),
        (middle + half * 1.35, height),
    ]
    polygon(rgb, dark, shade(bark, 0.72))
