"""Light: how bright a surface is, by day, dusk and night."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.settings import LightName

Colour = tuple[float, float, float]

_LAMP_REACH_M = 6.5


@dataclass(frozen=True)
class Light:
    """The light of one lap. Colours are factors of the surface colour, RGB.

    Attributes
    ----------
    sun : ndarray, (3,)
        Unit vector towards the sun.
    sun_colour, ambient : tuple of float
        Direct light on a surface that faces the sun; light from all sides.
    lamp_colour : tuple of float
        Street lamps, 0 by day.
    lit_windows : float
        Share of the windows with light behind them.
    zenith, horizon : tuple of float
        Sky colours, 0..255.
    haze_m : float
        Distance at which haze takes 63 % of the contrast.
    noise : float
        Standard deviation of the sensor noise, grey levels.
    bloom : float
        How much bright spots spill over.
    exposure : float
        Gain of the camera.
    """

    sun: np.ndarray
    sun_colour: Colour
    ambient: Colour
    lamp_colour: Colour
    lit_windows: float
    zenith: Colour
    horizon: Colour
    haze_m: float
    noise: float
    bloom: float
    exposure: float

    @property
    def lamps_on(self) -> bool:
        """Whether street lamps and head lights are switched on."""
        return max(self.lamp_colour) > 0

    def seen(self, colour: Colour) -> tuple[int, int, int]:
        """Return `colour` (0..255) as it looks in the shade."""
        red, green, blue = (int(min(c * a * self.exposure, 255)) for c, a in zip(colour, self.ambient, strict=True))
        return red, green, blue

    @property
    def casts_shadows(self) -> bool:
        """Whether the sun is strong enough to throw shadows."""
        return max(self.sun_colour) > 0.05

    def on(
        self, points_m: np.ndarray, normal: np.ndarray, lamps_m: np.ndarray, sunlit: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """Return the light (..., 3) that falls on `points_m` (..., 3) of surfaces with unit `normal` (..., 3).

        Parameters
        ----------
        lamps_m : ndarray, (lamps, 3)
            Street lamps near by; they have no shadows.
        sunlit : ndarray, (...) or float
            Share of the sun that arrives, 0 in a cast shadow.
        """
        facing = np.maximum(np.asarray(normal @ self.sun), 0.0) * sunlit
        sky = 0.85 + 0.15 * np.asarray(normal)[..., 2]
        light = sky[..., None] * np.array(self.ambient) + facing[..., None] * np.array(self.sun_colour)
        if self.lamps_on and len(lamps_m):
            towards = lamps_m - points_m[..., None, :]
            square = (towards**2).sum(axis=-1)
            cosine = (towards * np.asarray(normal)[..., None, :]).sum(axis=-1) / np.sqrt(square + 1e-9)
            glow = np.maximum(0.3 + 0.7 * cosine, 0.05) / (1 + square / _LAMP_REACH_M**2) ** 1.5
            light = light + glow.sum(axis=-1)[..., None] * np.array(self.lamp_colour)
        return np.broadcast_to(light, (*points_m.shape[:-1], 3))


def light_of_lap(name: LightName, *, lap: int, seed: int) -> Light:
    """Return the light of one lap: the sun stands elsewhere and the exposure differs a little in each."""
    rng = stream(seed, Stream.LIGHT, lap)
    azimuth = stream(seed, Stream.LIGHT).uniform(0, 2 * np.pi) + lap * rng.uniform(1.2, 2.4)
    elevation = np.deg2rad(rng.uniform(36, 52) if name == "day" else rng.uniform(14, 20))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    exposure = float(rng.uniform(0.94, 1.06))
    if name == "day":
        return Light(
            sun, (0.80, 0.71, 0.55), (0.74, 0.77, 0.81), (0, 0, 0), 0.0,
            (86, 138, 205), (206, 222, 236), 330.0, 1.5, 0.0, exposure,
        )  # fmt: skip
    if name == "dusk":
        return Light(
            sun, (0.46, 0.26, 0.11), (0.50, 0.43, 0.48), (0.42, 0.29, 0.14), 0.4,
            (62, 72, 122), (246, 168, 112), 190.0, 2.5, 0.7, exposure,
        )  # fmt: skip
    return Light(
        sun, (0.0, 0.0, 0.0), (0.17, 0.18, 0.25), (1.25, 0.90, 0.48), 0.3,
        (9, 12, 27), (40, 38, 52), 200.0, 6.0, 1.3, exposure,
    )  # fmt: skip
