"""People who walk and vehicles that drive: coherent from frame to frame, other ones in each lap."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np

from loopclosure.images.simulator.parked import vehicle
from loopclosure.images.simulator.people import HEIGHT_M, LOOKS, PHASES, WIDTH_M, paint_person
from loopclosure.images.simulator.quads import Lazy, Quads
from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.scene import Scene
from loopclosure.images.simulator.street import ONCOMING_M
from loopclosure.images.simulator.surface import Texture
from loopclosure.images.simulator.vehicles import MODELS, PAINTS

CAMERA_SPEED_MPS = 2.0
_PEOPLE_PER_M = 2.4
_VIEW_M = 55.0
_TRAFFIC_SPEED_MPS, _HEADWAY_M = 3.5, 13.0
_LEAD_PERIOD_S = 30.0
_CARS, _TALL = ("hatch", "sedan", "suv", "hatch"), ("bus", "truck", "van", "bus")
_PER_CROSSING, _CROSSING_S = 8, 26.0


@dataclass
class Movers:
    """What moves in one frame: rectangles, and outlines on the ground that lie in its shade."""

    quads: Quads = field(default_factory=Quads)
    shades: list[np.ndarray] = field(default_factory=list)


@dataclass(frozen=True)
class Place:
    """Where the camera is: its lap, the way along the route, to its left, the way it looks (1 or -1), the time."""

    lap: int
    s_m: float
    left_m: float
    heading: int
    time_s: float


class Actors:
    """Everybody who may move in one lap; each has a rank, and those below the wanted density are there.

    Parameters
    ----------
    scene : Scene
        The lap's street and light.
    seed : int
    """

    def __init__(self, scene: Scene, seed: int) -> None:
        self.scene, self.seed = scene, seed
        self.route, self.lap = scene.street.route, scene.lap
        rng = stream(seed, Stream.WALKERS, self.lap)
        count = int(np.ceil(self.route.length_m * _PEOPLE_PER_M))
        self._s = rng.uniform(0, self.route.length_m, count)
        self._speed = rng.uniform(0.8, 1.6, count) * rng.choice([-1, 1], count)
        self._rank = rng.random(count)
        self._look = rng.integers(LOOKS, size=count)
        self._stride = rng.random(count)
        ways = rng.random(count)
        self._on_road = ways > 0.62
        self._left = np.where(ways < 0.31, rng.uniform(-5.4, -4.1, count), rng.uniform(7.1, 8.4, count))
        self._left = np.where(self._on_road, rng.uniform(-1.7, 1.7, count), self._left)

    def at(self, place: Place, density: float) -> Movers:
        """Return who is seen from a place when the share `density` (0..1) of all actors is there."""
        movers = Movers()
        if density <= 0:
            return movers
        lead = self._add_lead(movers, place, density)
        self._add_oncoming(movers, place, density)
        self._add_walkers(movers, place, density, lead)
        self._add_crossing(movers, place, density)
        return movers

    def _add_lead(self, movers: Movers, place: Place, density: float) -> tuple[float, float]:
        """Add the vehicle ahead, which falls back and pulls away; return where it begins and ends, metres ahead."""
        turns = place.time_s / _LEAD_PERIOD_S + 0.37 * self.lap
        cycle = int(np.floor(turns))
        rng = stream(self.seed, Stream.TRAFFIC, self.lap, cycle)
        kinds = _TALL if rng.random() < 1.6 * density - 0.1 else _CARS
        kind, paint = kinds[int(rng.integers(4))], PAINTS[int(rng.integers(len(PAINTS)))]
        nearest = 0.8 + 34 * (1 - density) ** 2
        gap = nearest + (0.2 + 24 * (1 - density)) * (0.5 + 0.5 * np.cos(2 * np.pi * (turns - cycle)))
        length = MODELS[kind].length_m
        self._add_vehicle(movers, place, gap + length / 2, place.left_m, kind, paint, int(rng.integers(8)), 1)
        return gap - 0.5, gap + length + 0.5

    def _add_oncoming(self, movers: Movers, place: Place, density: float) -> None:
        slots = max(1, int(self.route.length_m // _HEADWAY_M))
        driven = -place.heading * _TRAFFIC_SPEED_MPS * place.time_s
        s = np.arange(slots) * self.route.length_m / slots + driven
        ahead = place.heading * self._from(s, place.s_m)
        for slot in np.flatnonzero((ahead > -7) & (ahead < _VIEW_M + 20)):
            rng = stream(self.seed, Stream.TRAFFIC, self.lap, 1, int(slot))
            if rng.random() > density * 1.2:
                continue
            kinds = _TALL if rng.random() < 0.15 + 0.5 * density else _CARS
            kind, paint = kinds[int(rng.integers(4))], PAINTS[int(rng.integers(len(PAINTS)))]
            lane = max(ONCOMING_M, place.left_m + 2.2)
            self._add_vehicle(
                movers, place, float(ahead[slot]) + rng.uniform(-1, 1), lane, kind, paint, int(rng.integers(8)), -1
            )

    def _add_vehicle(
        self,
        movers: Movers,
        place: Place,
        ahead_m: float,
        left_m: float,
        kind: str,
        paint: tuple[int, int, int],
        variant: int,
        way: int,
    ) -> None:
        s = place.s_m + place.heading * ahead_m
        middle, heading = self.route.at(s, left_m)
        yaw = float(heading) + (0.0 if place.heading * way > 0 else np.pi)
        light = self.scene.light_at(np.append(middle, 1.5), s)
        movers.quads.extend(vehicle(kind, paint, variant, middle, yaw, self.scene.light, light, driving=True))
        along = np.array([np.cos(yaw), np.sin(yaw)]) * MODELS[kind].length_m / 2
        aside = np.array([-np.sin(yaw), np.cos(yaw)]) * (MODELS[kind].width_m / 2 + 0.1)
        corners = np.stack([middle + a * along + b * aside for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        movers.shades.append(np.concatenate([corners, np.zeros((4, 1))], axis=1))

    def _add_walkers(self, movers: Movers, place: Place, density: float, lead: tuple[float, float]) -> None:
        s = self._s + self._speed * place.time_s
        ahead = place.heading * self._from(s, place.s_m)
        here = (self._rank < density) & (ahead > -0.5) & (ahead < _VIEW_M)
        # Nobody walks through the vehicle ahead.
        here &= ~(self._on_road & (ahead > lead[0]) & (ahead < lead[1]))
        who = np.flatnonzero(here)
        left = np.where(self._on_road[who], self._left[who] + place.left_m, self._left[who])
        view = np.where(self._speed[who] * place.heading > 0, "back", "front")
        self._add_people(movers, place, ahead[who], left, who, view)

    def _add_crossing(self, movers: Movers, place: Place, density: float) -> None:
        for number, crossing in enumerate(self.scene.street.crossings_m):
            middle = place.heading * float(self._from(np.array([crossing]), place.s_m)[0])
            if not -2 < middle < _VIEW_M:
                continue
            rng = stream(self.seed, Stream.WALKERS, self.lap, 1, number)
            rank, start, along = (
                rng.random(_PER_CROSSING),
                rng.random(_PER_CROSSING),
                rng.uniform(-1.3, 1.3, _PER_CROSSING),
            )
            turn = (place.time_s / _CROSSING_S + start) % 1.0
            left = np.clip(np.abs(2 * turn - 1) * 1.6 - 0.3, 0, 1) * 11.6 - 4.3
            keep = rank < density + 0.15
            view = np.where((turn < 0.5) == (place.heading > 0), "side", "mirrored")
            who = np.arange(_PER_CROSSING) + _PER_CROSSING * number
            self._add_people(movers, place, (middle + along)[keep], left[keep], who[keep], view[keep])

    def _add_people(
        self, movers: Movers, place: Place, ahead: np.ndarray, left: np.ndarray, who: np.ndarray, view: np.ndarray
    ) -> None:
        if len(who) == 0:
            return
        # People step aside from the camera.
        aside = left - place.left_m
        left = place.left_m + np.where(aside < 0, -1, 1) * np.hypot(aside, 1.0 * np.exp(-((ahead / 3.0) ** 2)))
        points, _ = self.route.at(place.s_m + place.heading * ahead, left)
        feet = np.concatenate([points, np.zeros((len(who), 1))], axis=1)
        lamps_at = place.s_m + place.heading * 15.0
        light = self.scene.light_at(feet + np.array([0, 0, 1.3]), lamps_at, np.array([0.0, 0.0, 1.0])) * 0.92
        phase = (np.floor(place.time_s * 3.1 + self._stride[who % len(self._stride)] * PHASES)).astype(int) % PHASES
        looks = self._look[who % len(self._look)]
        mirrored = view == "mirrored"
        views = np.where(mirrored, "side", view)
        textures = [_person(*key) for key in zip(looks.tolist(), phase.tolist(), views.tolist(), strict=True)]
        movers.quads.add_many_facing(feet, np.where(mirrored, -WIDTH_M, WIDTH_M), HEIGHT_M, textures, light)
        movers.shades += list(feet[:, None] + _FOOTPRINT)

    def _from(self, s: np.ndarray, origin_m: float) -> np.ndarray:
        length = self.route.length_m
        return (s - origin_m + length / 2) % length - length / 2


_ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)
_FOOTPRINT = np.stack([0.3 * np.cos(_ANGLES), 0.3 * np.sin(_ANGLES), np.zeros(8)], axis=1)


@lru_cache(maxsize=LOOKS * PHASES * 3)
def _person(look: int, phase: int, view: str) -> Lazy:
    return Lazy(partial(_person_texture, look, phase, view))


def _person_texture(look: int, phase: int, view: str) -> Texture:
    surface = paint_person(look, phase, view)
    return Texture(surface.rgb, surface.alpha)
