"""Random numbers that depend on what they are for, never on the order in which they are asked."""

from __future__ import annotations

from enum import IntEnum

import cv2
import numpy as np


class Stream(IntEnum):
    """What random numbers are for: each purpose has its own stream."""

    COURSE = 1
    DISTRICT = 2
    LOT = 3
    FACADE = 4
    GROUND = 5
    FURNITURE = 6
    TREE = 7
    PARKED = 8
    CAR = 9
    PERSON = 10
    WALKERS = 11
    TRAFFIC = 12
    LIGHT = 13
    SKY = 14
    FRAME = 15
    SKYLINE = 16


def stream(seed: int, purpose: Stream, *key: int) -> np.random.Generator:
    """Return the generator of one purpose and one thing, for example one building.

    Examples
    --------
    >>> bool(stream(0, Stream.LOT, 5).random() == stream(0, Stream.LOT, 5).random())
    True
    """
    return np.random.default_rng([seed, int(purpose), *key])


def smooth_noise(rng: np.random.Generator, height: int, width: int, cell: float) -> np.ndarray:
    """Return (height, width) float32 noise in about -1..1 whose spots are `cell` pixels wide."""
    rows, columns = max(2, round(height / cell) + 1), max(2, round(width / cell) + 1)
    coarse = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
