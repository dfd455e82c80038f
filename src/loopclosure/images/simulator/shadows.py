"""Cast shadows: polygons thrown along the sun onto a plane."""

from __future__ import annotations

import cv2
import numpy as np

_PIXELS_PER_M = 8
_SOFT_M = 0.12


def shadow_mask(
    casters: list[np.ndarray], sun: np.ndarray, origin: np.ndarray, across: np.ndarray, down: np.ndarray
) -> np.ndarray | None:
    """Return the share of the sun (h, w) that is taken away over a rectangle; None where it gets none or all.

    Parameters
    ----------
    casters : list of ndarray, (m, 3)
        Flat polygons, metres.
    sun : ndarray, (3,)
        Unit vector towards the sun.
    origin, across, down : ndarray, (3,)
        The rectangle: upper left corner and edges, as seen from the front.
    """
    wide, tall = float(np.linalg.norm(across)), float(np.linalg.norm(down))
    normal = np.cross(across, -down) / (wide * tall)
    slope = float(sun @ normal)
    if slope <= 0.03 or not casters:
        return None
    mask = np.zeros((max(2, round(tall * _PIXELS_PER_M)), max(2, round(wide * _PIXELS_PER_M))), np.uint8)
    scale = np.array([mask.shape[1] / wide**2, mask.shape[0] / tall**2])
    first = np.concatenate([[0], np.cumsum([len(polygon) for polygon in casters])])
    corners = np.concatenate(casters)
    height = (corners - origin) @ normal
    hit = corners - (height / slope)[:, None] * sun
    points = ((hit - origin) @ np.stack([across, down], axis=1)) * scale
    low, high = np.minimum.reduceat(points, first[:-1]), np.maximum.reduceat(points, first[:-1])
    touches = (high >= 0).all(axis=1) & (low <= mask.shape[::-1]).all(axis=1)
    # What lies in the plane or behind it throws nothing on it: the front itself, its neighbours.
    touches &= (np.maximum.reduceat(height, first[:-1]) > 0.3) & (np.minimum.reduceat(height, first[:-1]) > -0.3)
    if not touches.any():
        return None
    fixed = np.clip(np.round(points * 16), -(1 << 20), 1 << 20).astype(np.int32)
    for k in np.flatnonzero(touches):
        cv2.fillConvexPoly(mask, cv2.convexHull(fixed[first[k] : first[k + 1]]), 255, shift=4)
    return cv2.GaussianBlur(mask, (0, 0), _SOFT_M * _PIXELS_PER_M).astype(np.float32) / 255
