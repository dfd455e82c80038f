"""Drawing rectangles with a depth buffer, then what the air and the sensor do."""

from __future__ import annotations

import cv2
import numpy as np

from loopclosure.images.simulator.camera import NEAR_M, Camera
from loopclosure.images.simulator.light import Light
from loopclosure.images.simulator.quads import Lazy, Quads

SAMPLES = 2
"""Samples a pixel along each axis."""

_FARTHEST_M = 400.0
_OPAQUE = 112


class Canvas:
    """A picture in the making, `SAMPLES` times as wide and high, with the inverse depth of every sample."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.colour = np.zeros((camera.height, camera.width, 4), np.uint8)
        self.inverse_depth = np.full((camera.height, camera.width), 1 / _FARTHEST_M, np.float32)
        self._x = np.arange(camera.width, dtype=np.float32)
        self._y = np.arange(camera.height, dtype=np.float32)[:, None]

    def draw(self, quads: Quads, *, label: np.ndarray | None = None) -> None:
        """Draw rectangles, each where nothing drawn before is nearer.

        Parameters
        ----------
        quads : Quads
        label : ndarray, (h, w), uint8, or None
            Set to 1 where one of the rectangles is what one sees.
        """
        edges, tints, facing = quads.arrays()
        if len(edges) == 0:
            return
        seen = self.camera.rotation @ self._turned(edges, facing)
        seen[:, :, 2] -= self.camera.rotation @ self.camera.position_m
        across, down, origin = (seen[:, :, k] for k in range(3))
        corners = np.stack([origin, origin + across, origin + across + down, origin + down], axis=1)
        bounds = self._bounds(corners)
        size = np.linalg.det(seen)
        maybe = np.flatnonzero(
            (np.where(facing, np.abs(size), size) > 1e-9)
            & (bounds[:, 0] < bounds[:, 2])
            & (bounds[:, 1] < bounds[:, 3])
        )
        to_quads = np.linalg.inv(self.camera.matrix @ seen[maybe])
        # The nearest first: what they hide need not be painted.
        for k in np.argsort(corners[maybe, :, 2].mean(axis=1), kind="stable"):
            number = maybe[k]
            self._draw_one(quads.textures[number], tints[number], to_quads[k], bounds[number], label)

    def _turned(self, edges: np.ndarray, facing: np.ndarray) -> np.ndarray:
        """Turn the rectangles that always face the camera."""
        if not facing.any():
            return edges
        edges = edges.copy()
        towards = edges[facing, :2, 2] - self.camera.position_m[:2]
        towards /= np.maximum(np.hypot(*towards.T), 1e-9)[:, None]
        right = np.stack([towards[:, 1], -towards[:, 0], np.zeros(len(towards))], axis=1)
        across = right * edges[facing, 0, 0][:, None]
        edges[facing, :, 2] -= across / 2
        edges[facing, :, 0] = across
        return edges

    def _bounds(self, corners: np.ndarray) -> np.ndarray:
        """Return pixel boxes (n, 4), left, top, right, bottom, of rectangles (n, 4, 3) in front of the near plane."""
        depth = corners[:, :, 2]
        pixels = corners[:, :, :2] / np.maximum(depth, NEAR_M)[:, :, None]
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        for k in np.flatnonzero((depth.min(axis=1) < NEAR_M) & (depth.max(axis=1) > NEAR_M)):
            cut = _cut(corners[k])
            low[k], high[k] = cut.min(axis=0), cut.max(axis=0)
        high[(depth.max(axis=1) <= NEAR_M) | (depth.min(axis=1) > _FARTHEST_M)] = -np.inf
        size = np.array([self.camera.width, self.camera.height])
        low = np.clip(np.floor(low * self.camera.focal_px + self.camera.centre_px), 0, size)
        high = np.clip(np.ceil(high * self.camera.focal_px + self.camera.centre_px) + 1, 0, size)
        return np.concatenate([low, high], axis=1).astype(int)

    def _draw_one(
        self, texture: Lazy, tint: np.ndarray, to_quad: np.ndarray, bounds: np.ndarray, label: np.ndarray | None
    ) -> None:
        left, top, right, bottom = bounds.tolist()
        width, height = right - left, bottom - top
        # The last row of the homography is the inverse depth itself: it is affine in the pixel.
        slope_x, slope_y, start = to_quad[2].tolist()
        plane = self._x[:width] * np.float32(slope_x) + (
            self._y[:height] * np.float32(slope_y) + np.float32(start + slope_x * left + slope_y * top)
        )
        behind = self.inverse_depth[top:bottom, left:right]
        visible = plane > behind
        if not visible.any():
            return
        picture = texture.get().level(width * height)
        rows, columns = picture.shape[0] - 2, picture.shape[1] - 2
        # Pixels of this box to texels: texel centres are whole numbers, and the border is one texel wide.
        texels = to_quad * np.array([[columns], [rows], [1.0]])
        texels[:2] += 0.5 * texels[2]
        texels[:, 2] += texels[:, 0] * left + texels[:, 1] * top
        patch = cv2.warpPerspective(
            picture,
            texels,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        visible &= patch[..., 3] > _OPAQUE
        red, green, blue = tint.tolist()
        if (red, green, blue) != (1.0, 1.0, 1.0):
            patch = cv2.multiply(patch, (red, green, blue, 1.0))
        mask = visible.view(np.uint8)
        cv2.copyTo(patch, mask, self.colour[top:bottom, left:right])
        cv2.copyTo(plane, mask, behind)
        if label is not None:
            label[top:bottom, left:right] |= mask

    def darken_ground(self, outlines: list[np.ndarray], strength: float) -> None:
        """Lay soft shadows over the ground, to be called before anything stands on it; outlines are (m, 3) metres."""
        mask = np.zeros(self.colour.shape[:2], np.uint8)
        for outline in outlines:
            pixels, depth = self.camera.project(outline)
            if depth.min() > NEAR_M:
                fixed = np.clip(np.round(pixels * 16), -(1 << 20), 1 << 20).astype(np.int32)
                cv2.fillConvexPoly(mask, fixed, 255, shift=4)
        left, top, width, height = cv2.boundingRect(mask)
        if width:
            part = self.colour[top : top + height, left : left + width]
            factor = 255 - cv2.blur(mask[top : top + height, left : left + width], (5, 5)) * np.float32(strength)
            part[:] = cv2.multiply(part, cv2.merge([factor] * 4), scale=1 / 255, dtype=cv2.CV_8U)


def _cut(corners: np.ndarray) -> np.ndarray:
    """Return x / z and y / z (m, 2) of the part of a rectangle (4, 3) in front of the near plane."""
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] >= NEAR_M:
            kept.append(a)
        if (a[2] - NEAR_M) * (b[2] - NEAR_M) < 0:
            kept.append(a + (b - a) * (NEAR_M - a[2]) / (b[2] - a[2]))
    inside = np.array(kept)
    return inside[:, :2] / inside[:, 2:]


def finished(canvas: Canvas, light: Light, rng: np.random.Generator) -> np.ndarray:
    """Return the image (h, w, 3) uint8: averaged samples under haze, bloom, and sensor noise."""
    size = (canvas.camera.width // SAMPLES, canvas.camera.height // SAMPLES)
    image = cv2.resize(canvas.colour, size, interpolation=cv2.INTER_AREA)[..., :3].astype(np.float32)
    near = cv2.resize(canvas.inverse_depth, size, interpolation=cv2.INTER_AREA)
    haze = 1 - np.exp(np.float32(-1 / light.haze_m) / near)
    haze[near <= 1.02 / _FARTHEST_M] = 0
    image += (np.array(light.horizon, np.float32) - image) * haze[..., None]
    if light.bloom > 0:
        image = _bloomed(image, light.bloom)
    image += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(light.noise)
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def _bloomed(image: np.ndarray, strength: float) -> np.ndarray:
    wide = image.shape[1]
    bright = np.maximum(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) - 165, 0)
    halo = cv2.GaussianBlur(bright, (0, 0), wide / 250) + cv2.GaussianBlur(bright, (0, 0), wide / 70)
    return image + strength * cv2.resize(halo, (wide, image.shape[0]), interpolation=cv2.INTER_LINEAR)
