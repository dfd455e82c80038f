"""Pictures that have corners and blobs everywhere."""

from __future__ import annotations

import cv2
import numpy as np


def texture(seed, height=300, width=400):
    """Return blobs of all sizes, uint8 (height, width, 3)."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(height // size, width // size, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
        for size in (5, 10, 20, 40)
    ]
    return np.clip(128 + 30 * sum(layers), 0, 255).astype(np.uint8)
