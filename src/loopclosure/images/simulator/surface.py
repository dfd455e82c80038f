"""Painted surfaces and the tools of painting: all pictures are RGB uint8."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

Rgb = tuple[int, int, int]

_SHOULDER = np.float32(185)


@dataclass(frozen=True)
class Surface:
    """What is painted on one rectangle, before any light falls on it.

    Attributes
    ----------
    rgb : ndarray, (h, w, 3), uint8
    alpha : ndarray, (h, w), uint8, or None
        0 where one sees through; None is opaque.
    glow : ndarray, (h, w, 3), uint8, or None
        Light that the surface itself gives when lamps are on.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None
    glow: np.ndarray | None = None


class Texture:
    """A surface in its light, in halving sizes: RGBA uint8 with a border of one texel.

    The border repeats the edge colours and is transparent, so that interpolation ends a surface exactly at its edge.
    """

    def __init__(self, rgb: np.ndarray, alpha: np.ndarray | None = None) -> None:
        self.levels: list[np.ndarray] = []
        while True:
            self.levels.append(_bordered(rgb, alpha))
            height, width = rgb.shape[:2]
            if min(height, width) < 8:
                break
            size = (width // 2, height // 2)
            rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
            alpha = None if alpha is None else cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)

    def level(self, pixels: float) -> np.ndarray:
        """Return the picture whose number of texels suits a view of so many pixels."""
        height, width = self.levels[0].shape[:2]
        wanted = 0.5 * np.log2(max(height * width / max(pixels, 1.0), 1.0)) - 0.25
        return self.levels[min(int(max(wanted, 0.0)), len(self.levels) - 1)]


def lit(surface: Surface, light: np.ndarray, *, glowing: bool) -> Texture:
    """Return the surface under `light` (rows, columns, 3), a coarse grid that is stretched over it."""
    height, width = surface.rgb.shape[:2]
    factors = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    seen = surface.rgb * factors
    if glowing and surface.glow is not None:
        seen += surface.glow
    # A soft shoulder, as cameras have: bright walls keep their colour.
    excess = np.maximum(seen - _SHOULDER, 0)
    seen = np.minimum(seen, _SHOULDER) + excess / (1 + excess / (255 - _SHOULDER))
    return Texture(seen.astype(np.uint8), surface.alpha)


def tinted(rgb: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Make each pixel of `rgb` lighter or darker by the share `amount` (h, w) or (h, w, 3)."""
    factor = amount if amount.ndim == rgb.ndim else amount[..., None]
    return np.clip(rgb * (1 + factor), 0, 255).astype(np.uint8)


def plain(height: int, width: int, colour: Rgb) -> np.ndarray:
    """Return a picture of one colour."""
    return np.full((height, width, 3), colour, np.uint8)


def shade(colour: Rgb, factor: float) -> Rgb:
    """Return `colour` made lighter (factor > 1) or darker."""
    red, green, blue = (int(min(255, max(0, round(c * factor)))) for c in colour)
    return red, green, blue


def mixed(first: Rgb, second: Rgb, share: float) -> Rgb:
    """Return `share` of `second` in `first`."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(first, second, strict=True))
    return red, green, blue


def box(picture: np.ndarray, left: float, top: float, right: float, bottom: float, colour: Rgb) -> None:
    """Fill the rectangle between four pixel positions."""
    if right > left and bottom > top:
        height, width = picture.shape[:2]
        x0, x1 = (int(min(max(round(x), 0), width)) for x in (left, right))
        y0, y1 = (int(min(max(round(y), 0), height)) for y in (top, bottom))
        picture[y0:y1, x0:x1] = colour


def polygon(picture: np.ndarray, points: list[tuple[float, float]], colour: Rgb | int) -> None:
    """Fill a polygon with smooth edges; points are (x, y) pixels."""
    fixed = np.round(np.array(points, dtype=float) * 16).astype(np.int32)
    cv2.fillPoly(picture, [fixed], colour, lineType=cv2.LINE_AA, shift=4)


def _bordered(rgb: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
    height, width = rgb.shape[:2]
    out = np.empty((height + 2, width + 2, 4), np.uint8)
    out[..., :3] = cv2.copyMakeBorder(rgb, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    out[..., 3] = 0
    out[1:-1, 1:-1, 3] = 255 if alpha is None else alpha
    return out
