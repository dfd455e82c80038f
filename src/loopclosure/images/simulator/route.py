"""The closed street that is driven: straight pieces and circular bends, exact everywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopclosure.images.simulator.randomness import Stream, stream

SHORTEST_LAP_M = 120.0
BLOCK_M = 42.0
RADIUS_RIGHT_M, RADIUS_LEFT_M = 8.0, 11.0


@dataclass(frozen=True)
class Route:
    """A closed curve of straight and circular pieces, by its length `s` in metres.

    Attributes
    ----------
    start_m : ndarray, (pieces + 1,)
        Where each piece begins; the last value is the length of the whole lap.
    position_m : ndarray, (pieces, 2)
    heading_rad : ndarray, (pieces,)
        At the beginning of each piece, counter-clockwise from x.
    curvature : ndarray, (pieces,)
        Per metre; positive turns left, 0 is straight.
    """

    start_m: np.ndarray
    position_m: np.ndarray
    heading_rad: np.ndarray
    curvature: np.ndarray

    @property
    def length_m(self) -> float:
        """Length of one lap."""
        return float(self.start_m[-1])

    def at(self, s_m: np.ndarray | float, left_m: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (..., 2) `left_m` to the left of the route at `s_m`, and the headings (...)."""
        s = np.mod(np.asarray(s_m, dtype=float), self.length_m)
        piece = np.clip(np.searchsorted(self.start_m, s, side="right") - 1, 0, len(self.curvature) - 1)
        along, first, bend = s - self.start_m[piece], self.heading_rad[piece], self.curvature[piece]
        heading = first + bend * along
        # The chord of an arc: its direction is the mean heading, its length sinc-shortened; exact for bend = 0 too.
        half = 0.5 * bend * along
        chord = along * np.sinc(half / np.pi)
        x = self.position_m[piece, 0] + chord * np.cos(first + half) - left_m * np.sin(heading)
        y = self.position_m[piece, 1] + chord * np.sin(first + half) + left_m * np.cos(heading)
        return np.stack([x, y], axis=-1), heading

    def locate(self, points_m: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return route length and signed distance to the left of the points (..., 2).

        Points further than `reach_m` from the route have the distance ``inf`` and the length 0.
        """
        low, high = points_m.reshape(-1, 2).min(axis=0) - reach_m, points_m.reshape(-1, 2).max(axis=0) + reach_m
        s, left = np.zeros(points_m.shape[:-1]), np.full(points_m.shape[:-1], np.inf)
        for piece in range(len(self.curvature)):
            length = self.start_m[piece + 1] - self.start_m[piece]
            ends = np.stack([self.position_m[piece], self.position_m[(piece + 1) % len(self.curvature)]])
            # An arc of up to a quarter circle leaves the box of its ends by less than its length.
            slack = 0.0 if self.curvature[piece] == 0 else length
            if (ends.max(axis=0) + slack < low).any() or (ends.min(axis=0) - slack > high).any():
                continue
            along, off = self._locate_on(piece, points_m)
            better = (along >= -1e-6) & (along <= length + 1e-6) & (np.abs(off) < np.minimum(np.abs(left), reach_m))
            s[better], left[better] = self.start_m[piece] + along[better], off[better]
        return s, left

    def _locate_on(self, piece: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        heading, bend = self.heading_rad[piece], self.curvature[piece]
        ahead, leftward = (
            np.array([math.cos(heading), math.sin(heading)]),
            np.array([-math.sin(heading), math.cos(heading)]),
        )
        relative = points - self.position_m[piece]
        x, y = relative @ ahead, relative @ leftward
        if bend == 0:
            return x, y
        radius = 1 / bend
        turned = np.arctan2(x, (radius - y) * np.sign(bend))
        return turned / abs(bend), radius - np.sign(bend) * np.hypot(x, radius - y)


def closed_route(length_m: float, seed: int) -> Route:
    """Return a closed street of exactly `length_m` metres around city blocks, different for every seed.

    The outline of a random tree on a grid is a closed walk that never meets itself; its corners are moved a little
    and rounded.
    """
    rng = stream(seed, Stream.COURSE)
    cells = max(1, round(length_m / (4 * BLOCK_M)))
    corners = _outline(_random_tree(rng, cells)).astype(float)
    corners += rng.uniform(-0.07, 0.07, corners.shape)
    return _rounded(corners, length_m)


def _random_tree(rng: np.random.Generator, cells: int) -> dict[tuple[int, int], set[tuple[int, int]]]:
    """Grow a tree of grid cells; each cell knows the directions in which it is linked."""
    links: dict[tuple[int, int], set[tuple[int, int]]] = {(0, 0): set()}
    order = [(0, 0)]
    directions = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    while len(links) < cells:
        cell = (
            order[int(rng.integers(max(0, len(order) - 4), len(order)))]
            if rng.random() < 0.7
            else (order[int(rng.integers(len(order)))])
        )
        dx, dy = directions[int(rng.integers(4))]
        new = (cell[0] + dx, cell[1] + dy)
        if new not in links:
            links[cell].add((dx, dy))
            links[new] = {(-dx, -dy)}
            order.append(new)
    return links


def _outline(links: dict[tuple[int, int], set[tuple[int, int]]]) -> np.ndarray:
    """Walk clockwise around the tree over the quarters of its cells, (4 * cells, 2) integers."""
    # quarter of the cell: (side that is blocked by a link, next quarter in the same cell)
    turns = {(0, 0): ((-1, 0), (0, 1)), (0, 1): ((0, 1), (1, 1)), (1, 1): ((1, 0), (1, 0)), (1, 0): ((0, -1), (0, 0))}
    cell, quarter = (0, 0), (0, 0)
    walk = []
    for _ in range(4 * len(links)):
        walk.append((2 * cell[0] + quarter[0], 2 * cell[1] + quarter[1]))
        side, following = turns[quarter]
        if side in links[cell]:
            cell = (cell[0] + side[0], cell[1] + side[1])
            quarter = (quarter[0] ^ abs(side[0]), quarter[1] ^ abs(side[1]))
        else:
            quarter = following
    return np.array(walk)


def _rounded(corners: np.ndarray, length_m: float) -> Route:
    """Scale the closed polygon and round its corners so that the whole is `length_m` long."""
    leg = np.roll(corners, -1, axis=0) - corners
    direction = np.arctan2(leg[:, 1], leg[:, 0])
    turn = np.mod(direction - np.roll(direction, 1) + np.pi, 2 * np.pi) - np.pi
    radius = np.where(turn > 0, RADIUS_LEFT_M, RADIUS_RIGHT_M)
    # Slight bends are made wide: their arcs would otherwise be as short as a kink.
    radius = np.where(np.abs(turn) < 0.5, 40.0, radius)
    cut, arc = radius * np.tan(np.abs(turn) / 2), radius * np.abs(turn)
    legs = np.hypot(*leg.T)
    scale = (length_m - (arc - 2 * cut).sum()) / legs.sum()
    straight = legs * scale - cut - np.roll(cut, -1)
    pieces = np.stack([straight, np.roll(arc, -1)], axis=1).ravel()
    begin = corners * scale + cut[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    corner_in = begin + straight[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    start = np.concatenate([[0.0], np.cumsum(pieces)])
    start[-1] = length_m
    bend = np.roll(np.sign(turn) / radius, -1)
    return Route(
        start,
        np.stack([begin, corner_in], axis=1).reshape(-1, 2),
        np.repeat(direction, 2),
        np.stack([np.zeros_like(bend), bend], axis=1).ravel(),
    )
