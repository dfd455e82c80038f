"""The sky: a panorama with clouds, the sun's glow and a far skyline."""

from __future__ import annotations

import math

import cv2
import numpy as np

from loopclosure.images.simulator.camera import Camera
from loopclosure.images.simulator.light import Light
from loopclosure.images.simulator.randomness import Stream, stream

_PER_RAD = 260
_WIDTH = round(2 * math.pi * _PER_RAD)
_LOW_RAD, _HIGH_RAD = -0.10, 1.0
_MARGIN_RAD = 1.2


class Sky:
    """The sky of one lap as RGB by azimuth and elevation."""

    def __init__(self, light: Light, *, lap: int, seed: int) -> None:
        picture = _panorama(light, lap=lap, seed=seed)
        margin = round(_MARGIN_RAD * _PER_RAD)
        # Azimuth grows to the left in an image; the ends are repeated so that no view crosses a seam.
        picture = np.concatenate([picture[:, -margin:], picture, picture[:, :margin]], axis=1)
        self.picture = cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA)
        self._maps: tuple[tuple[int, int], np.ndarray, np.ndarray] | None = None

    def draw(self, camera: Camera, out: np.ndarray) -> None:
        """Fill `out` (h, w, 4), of the size of the camera or a multiple, as far down as the sky can be seen."""
        rows = min(camera.height, round(camera.centre_px[1] + 0.12 * camera.focal_px))
        size = (camera.width, rows)
        if self._maps is None or self._maps[0] != size:
            x = (np.arange(camera.width, dtype=np.float32) - camera.centre_px[0]) / camera.focal_px
            y = (np.arange(rows, dtype=np.float32) - camera.centre_px[1]) / camera.focal_px
            azimuth = np.broadcast_to(-np.arctan(x)[None, :], (rows, camera.width))
            elevation = np.arctan(-y[:, None] / np.hypot(1, x)[None, :])
            self._maps = (
                size, (azimuth + _MARGIN_RAD) * _PER_RAD, ((_HIGH_RAD - elevation) * _PER_RAD).astype(np.float32)
            )  # fmt: skip
        _, columns, lines = self._maps
        columns = columns + np.float32(camera.pose.yaw_rad % (2 * math.pi) * _PER_RAD)
        lines = lines - np.float32(camera.pose.pitch_rad * _PER_RAD)
        seen = cv2.remap(self.picture, columns, lines, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        times = out.shape[1] // camera.width
        out[: rows * times] = cv2.resize(seen, (out.shape[1], rows * times), interpolation=cv2.INTER_NEAREST)


def _panorama(light: Light, *, lap: int, seed: int) -> np.ndarray:
    height = round((_HIGH_RAD - _LOW_RAD) * _PER_RAD)
    elevation = np.linspace(_HIGH_RAD, _LOW_RAD, height)[:, None]
    azimuth = (np.arange(_WIDTH) / _PER_RAD)[None, :]
    rise = np.clip(elevation / 0.9, 0, 1)[..., None] ** 0.6
    sky = (1 - rise) * np.array(light.horizon) + rise * np.array(light.zenith)
    sky = np.broadcast_to(sky, (height, _WIDTH, 3)).astype(np.float32)
    sun_azimuth, sun_elevation = math.atan2(light.sun[1], light.sun[0]), math.asin(light.sun[2])
    apart = np.hypot((azimuth - sun_azimuth + np.pi) % (2 * np.pi) - np.pi, elevation - sun_elevation)
    if light.casts_shadows:
        warm = np.array((255, 236, 205)) if sun_elevation > 0.5 else np.array((255, 190, 120))
        glow = (0.45 * np.exp(-apart / 0.45) + np.exp(-((apart / 0.07) ** 2)))[..., None].clip(0, 1)
        sky = sky + (warm - sky) * glow
    cover = _clouds(stream(seed, Stream.SKY, lap), height, elevation)[..., None]
    cloud = 0.62 * np.array(light.horizon) + 0.38 * np.array((250, 248, 246)) * max(light.ambient)
    sky = sky + (cloud - sky) * cover * 0.8
    _skyline(stream(seed, Stream.SKYLINE), sky, light, height)
    return np.clip(sky, 0, 255).astype(np.uint8)


def _clouds(rng: np.random.Generator, height: int, elevation: np.ndarray) -> np.ndarray:
    """Share of cloud (height, width): spots that flatten towards the horizon."""
    total = np.zeros((height, _WIDTH), np.float32)
    for octave in range(5):
        columns, rows = 10 * 2**octave, 5 * 2**octave
        spots = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)
        spots = np.concatenate([spots, spots[:, :1]], axis=1)
        total += cv2.resize(spots, (_WIDTH, height), interpolation=cv2.INTER_CUBIC) * 0.6**octave
    stretched = np.clip((1 - np.exp(-2.2 * np.maximum(elevation, 0))) / (1 - math.exp(-2.2 * _HIGH_RAD)), 0, 1)
    rows_map = ((1 - stretched) * (height - 1)).astype(np.float32).repeat(_WIDTH, axis=1)
    columns_map = np.arange(_WIDTH, dtype=np.float32)[None, :].repeat(height, axis=0)
    flat = cv2.remap(total, columns_map, rows_map, cv2.INTER_LINEAR)
    amount = rng.uniform(-0.25, 0.35)
    return np.clip((flat + amount) * 1.4, 0, 1) * np.clip(elevation / 0.12, 0, 1)


def _skyline(rng: np.random.Generator, sky: np.ndarray, light: Light, height: int) -> None:
    """Roofs and tree tops far away, in the colour of the haze."""
    horizon = round(_HIGH_RAD * _PER_RAD)
    dim = np.array((118, 124, 132)) * (np.array(light.ambient) + 0.25 * np.array(light.sun_colour))
    for layer, share in ((1.5, 0.35), (1.0, 0.6)):
        x = 0
        while x < _WIDTH:
            wide = int(rng.integers(6, 34))
            tall = round(float(rng.uniform(0.02, 0.075)) * layer * _PER_RAD)
            colour = (1 - share) * np.array(light.horizon) + share * dim * rng.uniform(0.9, 1.1)
            sky[horizon - tall : height, x : x + wide] = colour
            if rng.random() < 0.3:
                for k in range(wide // 2):
                    sky[horizon - tall - k // 2 - 1 : horizon - tall, x + k : x + wide - k] = colour * 0.96
            x += wide
