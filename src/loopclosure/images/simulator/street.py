"""The plan of the street: who has a front on it and where trees, lamps, signs and crossings stand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from loopclosure.images.simulator.districts import DISTRICTS, Building, District, design
from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.route import Route

# Distances to the left of the route, metres: the camera drives in the right one of two lanes.
KERBS_M = (-3.4, 6.4)
FRONTS_M = (-5.9, 8.9)
LANE_MARK_M = 1.5
ONCOMING_M = 3.0
PARKING_M = (-2.45, 5.45)
YARD_DEPTH_M = 10.5
GARDEN_DEPTH_M = 3.2
LAMP_HEIGHT_M, LAMP_ARM_M = 5.4, 1.3

Kind = Literal["building", "garden", "alley", "park"]


@dataclass(frozen=True)
class Lot:
    """A piece of one side of the street.

    Attributes
    ----------
    number : int
        Over both sides; names the random numbers of the lot.
    side : int
        0 right, 1 left of the route.
    start_m, end_m : float
        Along the route.
    """

    number: int
    side: int
    start_m: float
    end_m: float
    kind: Kind
    district: int


@dataclass(frozen=True)
class Item:
    """A thing that stands on the pavement."""

    kind: Literal["tree", "lamp", "sign", "bin", "bollard", "shelter"]
    s_m: float
    left_m: float
    number: int


class Street:
    """Everything that stays as it is from lap to lap, by its place along the route."""

    def __init__(self, route: Route, seed: int) -> None:
        self.route, self.seed = route, seed

    @cached_property
    def quarters(self) -> np.ndarray:
        """District of each stretch of about 45 m."""
        rng = stream(self.seed, Stream.DISTRICT)
        count = max(3, round(self.route.length_m / 45))
        steps = rng.integers(1, len(DISTRICTS), count)
        return (int(rng.integers(len(DISTRICTS))) + np.cumsum(steps)) % len(DISTRICTS)

    def district_at(self, s_m: float) -> int:
        """Return the number of the district at `s_m`."""
        share = (s_m % self.route.length_m) / self.route.length_m
        return int(self.quarters[int(share * len(self.quarters))])

    @cached_property
    def lots(self) -> tuple[tuple[Lot, ...], tuple[Lot, ...]]:
        """Lots of the right and of the left side, in the order of the route."""
        right = self._side_lots(0, 0)
        return right, self._side_lots(1, len(right))

    @cached_property
    def crossings_m(self) -> np.ndarray:
        """Where people cross the road."""
        count = max(1, int(self.route.length_m // 70))
        rng = stream(self.seed, Stream.GROUND)
        return (np.arange(count) + rng.uniform(0.2, 0.8, count)) * self.route.length_m / count

    def near_crossing(self, s_m: float, reach_m: float) -> bool:
        """Whether a crossing is within `reach_m`."""
        length = self.route.length_m
        return bool((np.abs((self.crossings_m - s_m + length / 2) % length - length / 2) < reach_m).any())

    @cached_property
    def lamps(self) -> tuple[Item, ...]:
        """Street lamps, alternating between the sides."""
        count = 2 * max(2, round(self.route.length_m / 30))
        places = (np.arange(count) + 0.5) * self.route.length_m / count
        return tuple(Item("lamp", float(s), KERBS_M[k % 2] + (-0.45, 0.45)[k % 2], k) for k, s in enumerate(places))

    def lamp_heads(self) -> tuple[np.ndarray, np.ndarray]:
        """Return route positions (lamps,) and points (lamps, 3) of the shining heads."""
        s = np.array([lamp.s_m for lamp in self.lamps])
        inward = np.array([lamp.left_m + (LAMP_ARM_M if lamp.left_m < 0 else -LAMP_ARM_M) for lamp in self.lamps])
        points, _ = self.route.at(s, inward)
        return s, np.concatenate([points, np.full((len(s), 1), LAMP_HEIGHT_M)], axis=1)

    @cached_property
    def items(self) -> tuple[Item, ...]:
        """Trees, signs and small furniture of the pavements."""
        rng = stream(self.seed, Stream.FURNITURE)
        found: list[Item] = []
        for side in (0, 1):
            outward = (-1, 1)[side]
            s = float(rng.uniform(2, 6))
            while s < self.route.length_m - 2:
                district = DISTRICTS[self.district_at(s)]
                kind, along = self._next_item(district, rng)
                if kind is not None and not self.near_crossing(s, 2.5):
                    found.append(
                        Item(kind, s, KERBS_M[side] + outward * (0.4 if kind != "shelter" else 0.7), len(found))
                    )
                s += along
        return tuple(found)

    @staticmethod
    def _next_item(
        district: District, rng: np.random.Generator
    ) -> tuple[Literal["tree", "sign", "bin", "bollard", "shelter"] | None, float]:
        draw = rng.random()
        if draw < district.trees:
            return "tree", float(rng.uniform(6.5, 10.0))
        if draw < district.trees + 0.12:
            return "sign", float(rng.uniform(3, 7))
        if draw < district.trees + 0.2:
            return "bin", float(rng.uniform(2, 6))
        if draw < district.trees + 0.3:
            return "bollard", float(rng.uniform(1.5, 3))
        if draw < district.trees + 0.34:
            return "shelter", float(rng.uniform(6, 9))
        return None, float(rng.uniform(3, 9))

    def building(self, lot: Lot, width_m: float) -> Building:
        """Return the building of a lot."""
        return _building(self.seed, lot.number, lot.district, width_m)

    def _side_lots(self, side: int, first_number: int) -> tuple[Lot, ...]:
        route, rng = self.route, stream(self.seed, Stream.LOT, side)
        fine = np.linspace(0, route.length_m, max(400, round(route.length_m * 4)) + 1)
        points, headings = route.at(fine[:-1], FRONTS_M[side])
        steps = np.hypot(*(np.roll(points, -1, axis=0) - points).T)
        front = np.concatenate([[0.0], np.cumsum(steps)])
        edges = [0.0]
        while edges[-1] < front[-1]:
            district = DISTRICTS[self.district_at(float(np.interp(edges[-1], front, fine)))]
            edges.append(edges[-1] + float(rng.uniform(*district.width_m)))
        s = np.interp(np.array(edges) * front[-1] / edges[-1], front, fine)
        turned = np.interp(s, fine[:-1], np.unwrap(headings))
        lots = []
        for k in range(len(s) - 1):
            middle = (s[k] + s[k + 1]) / 2
            number = self.district_at(float(middle))
            straight = abs(turned[k + 1] - turned[k]) < 0.05
            kind = self._kind(DISTRICTS[number], rng, straight)
            lots.append(Lot(first_number + k, side, float(s[k]), float(s[k + 1]), kind, number))
        return tuple(lots)

    @staticmethod
    def _kind(district: District, rng: np.random.Generator, straight: bool) -> Kind:
        draw = rng.random(2)
        if not straight:
            return "building"
        if draw[0] < district.gaps:
            return "alley" if draw[1] < 0.5 else "park"
        return "garden" if draw[1] < district.gardens else "building"


@lru_cache(maxsize=4096)
def _building(seed: int, number: int, district: int, width_m: float) -> Building:
    return design(DISTRICTS[district], stream(seed, Stream.LOT, 2, number), width_m)
