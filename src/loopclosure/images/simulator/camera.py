"""The pinhole camera: world metres to pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

HEIGHT_M = 1.5
FOCAL_WIDTHS = 0.65
HORIZON_HEIGHTS = 0.56
NEAR_M = 0.3


@dataclass(frozen=True)
class Pose:
    """Where the camera is and looks.

    Attributes
    ----------
    x_m, y_m, z_m : float
        Position; z is the height above the street.
    yaw_rad : float
        Viewing direction, counter-clockwise from x.
    pitch_rad : float
        Positive looks up.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    pitch_rad: float = 0.0


class Camera:
    """A pinhole camera at `pose` with square pixels; pixel (0, 0) is the centre of the upper left pixel.

    With the right, down and forward distances (X, Y, Z) of a point from the camera its pixel is
    ``(c_x + f X / Z, c_y + f Y / Z)``, where ``f = 0.65 width``, ``c_x`` the middle column and ``c_y`` at 0.56 of
    the height: the street shows more above the horizon than below.

    Examples
    --------
    >>> camera = Camera(Pose(0, 0, 1.5, 0), width=320, height=240)
    >>> camera.project([[10.0, 0.0, 1.5]])[0].tolist()
    [[159.5, 133.9]]
    """

    def __init__(self, pose: Pose, *, width: int, height: int, scale: int = 1) -> None:
        self.pose = pose
        self.width, self.height = width * scale, height * scale
        self.focal_px = FOCAL_WIDTHS * width * scale
        self.centre_px = (
            (width - 1) / 2 * scale + (scale - 1) / 2,
            (HORIZON_HEIGHTS * height - 0.5) * scale + (scale - 1) / 2,
        )
        cy, sy, cp, sp = (f(a) for a in (pose.yaw_rad, pose.pitch_rad) for f in (math.cos, math.sin))
        right, forward = np.array([sy, -cy, 0.0]), np.array([cp * cy, cp * sy, sp])
        self.position_m = np.array([pose.x_m, pose.y_m, pose.z_m])
        self.rotation = np.stack([right, np.cross(forward, right), forward])
        self.matrix = np.array(
            [[self.focal_px, 0, self.centre_px[0]], [0, self.focal_px, self.centre_px[1]], [0, 0, 1]]
        )

    def project(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (n, 2) and depths (n,) of world points (n, 3); a depth <= 0 is behind the camera."""
        seen = (np.asarray(points_m, dtype=float) - self.position_m) @ self.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = seen[:, :2] / seen[:, 2:] * self.focal_px + np.array(self.centre_px)
        return pixels, seen[:, 2]
