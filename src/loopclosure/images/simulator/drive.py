"""The drive: a sequence of frames, each rendered from the seed and its number alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from loopclosure.images.simulator.actors import CAMERA_SPEED_MPS, Actors, Place
from loopclosure.images.simulator.camera import HEIGHT_M, Camera, Pose
from loopclosure.images.simulator.light import light_of_lap
from loopclosure.images.simulator.quads import Quads
from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.render import SAMPLES, Canvas, finished
from loopclosure.images.simulator.route import SHORTEST_LAP_M, closed_route
from loopclosure.images.simulator.scene import Scene
from loopclosure.images.simulator.settings import SimulationSettings
from loopclosure.images.simulator.sky import Sky
from loopclosure.images.simulator.street import PARKING_M, Street

_OPEN_END_M = 60.0
_PARKED_CLEARANCE_M = 1.9
_CALIBRATION_FRAMES, _CALIBRATION_WIDTH = 32, 96
_YAW_SHAKE_RAD, _PITCH_SHAKE_RAD = 0.006, 0.004


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One image of a drive.

    Attributes
    ----------
    index : int
        0-based.
    image : ndarray, (h, w, 3), uint8
        RGB.
    pose : Pose
        Of the camera, exact.
    covered : float
        Share of the image, 0..1, in which a moving person or car is what one sees.
    """

    index: int
    image: np.ndarray
    pose: Pose
    covered: float


@dataclass(frozen=True, eq=False)
class Lap:
    """What one lap looks at."""

    scene: Scene
    sky: Sky
    actors: Actors


class Drive:
    """A drive of two laps along one street; indexing renders one frame, the same in any order.

    Parameters
    ----------
    settings : SimulationSettings or None
        None: the defaults.

    Attributes
    ----------
    first_lap : int
        Frames of the first lap; the frame ``first_lap + k`` revisits frame ``k`` (``first_lap - 1 - k`` in reverse).
    spacing_m : float
        Distance between frames along the street.
    route : Route
        The street's exact curve.

    Examples
    --------
    >>> drive = Drive(SimulationSettings(frames=4, width=64, height=48))
    >>> len(drive), drive[3].image.shape
    (4, (48, 64, 3))
    """

    def __init__(self, settings: SimulationSettings | None = None) -> None:
        self.settings = settings = settings or SimulationSettings()
        self.first_lap = settings.frames - settings.frames // 2 if settings.revisit else settings.frames
        self.spacing_m = max(settings.spacing_m, SHORTEST_LAP_M / self.first_lap)
        self.street = _street(self.first_lap * self.spacing_m + (0 if settings.revisit else _OPEN_END_M), settings.seed)
        self.route = self.street.route
        self._laps = [self._lap(k) for k in range(2 if settings.revisit else 1)]
        self._density = [self._calibrated(k) if settings.covered > 0 else 0.0 for k in range(len(self._laps))]

    def _lap(self, lap: int) -> Lap:
        settings = self.settings
        light = light_of_lap(
            (settings.revisit_light or settings.light) if lap else settings.light, lap=lap, seed=settings.seed
        )
        at = settings.lateral_offset_m if lap else 0.0
        right, left = (settings.parked_cars and abs(at - strip) > _PARKED_CLEARANCE_M for strip in PARKING_M)
        scene = Scene(self.street, light, lap=lap, shadows=settings.shadows, parked=(right, left))
        return Lap(scene, Sky(light, lap=lap, seed=settings.seed), Actors(scene, settings.seed))

    def __len__(self) -> int:
        return self.settings.frames

    def __iter__(self) -> Iterator[SimulatedFrame]:
        return (self[index] for index in range(len(self)))

    def place(self, index: int) -> Place:
        """Return where the camera is along the route at a frame, and when."""
        lap = int(index >= self.first_lap)
        step = index - self.first_lap * lap
        time = step * self.spacing_m / CAMERA_SPEED_MPS
        if lap and self.settings.direction == "reverse":
            return Place(lap, (self.first_lap - 1 - step) * self.spacing_m, self.settings.lateral_offset_m, -1, time)
        return Place(lap, step * self.spacing_m, self.settings.lateral_offset_m * lap, 1, time)

    def pose(self, index: int) -> Pose:
        """Return the exact pose of the camera at a frame."""
        place = self.place(index)
        point, yaw = self.route.at(place.s_m, place.left_m)
        shake = stream(self.settings.seed, Stream.FRAME, index).normal(0, 1, 2)
        turn = float(yaw) + (math.pi if place.heading < 0 else 0.0) + _YAW_SHAKE_RAD * shake[0]
        return Pose(
            float(point[0]), float(point[1]), HEIGHT_M, math.remainder(turn, math.tau), _PITCH_SHAKE_RAD * shake[1]
        )

    def __getitem__(self, index: int) -> SimulatedFrame:
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a drive of {len(self)} frames")
        index %= len(self)
        place, pose = self.place(index), self.pose(index)
        lap = self._laps[place.lap]
        camera = Camera(pose, width=self.settings.width, height=self.settings.height, scale=SAMPLES)
        canvas = Canvas(camera)
        canvas.colour[:] = (*lap.scene.light.seen((104, 102, 98)), 255)
        lap.sky.draw(Camera(pose, width=self.settings.width, height=self.settings.height), canvas.colour)
        blocks = lap.scene.visible_blocks(place.s_m, place.heading)
        canvas.draw(lap.scene.ground(blocks))
        movers = lap.actors.at(place, self._density[place.lap])
        if self.settings.shadows:
            canvas.darken_ground(movers.shades, 0.45)
        canvas.draw(lap.scene.standing(blocks))
        covered = np.zeros(canvas.inverse_depth.shape, np.uint8)
        canvas.draw(movers.quads, label=covered)
        image = finished(canvas, lap.scene.light, stream(self.settings.seed, Stream.FRAME, index, 1))
        return SimulatedFrame(index, image, pose, float(covered.mean()))

    def _calibrated(self, number: int) -> float:
        """Return the density of actors at which they cover the wanted share of the view in one lap."""
        settings, lap = self.settings, self._laps[number]
        first, last = (self.first_lap, settings.frames) if number else (0, self.first_lap)
        frames = np.unique(np.linspace(first, last - 1, _CALIBRATION_FRAMES).round().astype(int))
        views = [self._small_view(int(index)) for index in frames]
        low, high = 0.0, 1.0
        for _ in range(6):
            middle = (low + high) / 2
            shares = [_share(canvas, lap.actors.at(place, middle).quads) for canvas, place in views]
            low, high = (middle, high) if np.mean(shares) < settings.covered else (low, middle)
        return (low + high) / 2

    def _small_view(self, index: int) -> tuple[Canvas, Place]:
        """Return a small picture in which only the depth of what stands is drawn."""
        settings, place = self.settings, self.place(index)
        width = min(settings.width, _CALIBRATION_WIDTH)
        canvas = Canvas(Camera(self.pose(index), width=width, height=round(settings.height * width / settings.width)))
        scene = self._laps[place.lap].scene
        canvas.draw(scene.standing(scene.visible_blocks(place.s_m, place.heading)).solid())
        return canvas, place


def _share(canvas: Canvas, quads: Quads) -> float:
    """Return the share of a view that rectangles would cover; the view stays as it was."""
    label, depth = np.zeros(canvas.inverse_depth.shape, np.uint8), canvas.inverse_depth.copy()
    canvas.draw(quads, label=label)
    canvas.inverse_depth = depth
    return float(label.mean())


@lru_cache(maxsize=4)
def _street(length_m: float, seed: int) -> Street:
    """Return the street; drives along the same one share what is painted."""
    return Street(closed_route(length_m, seed), seed)
