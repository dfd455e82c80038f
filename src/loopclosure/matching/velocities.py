"""Search for straight trajectories of several speeds through a matrix of differences (SeqSLAM).

Source: Milford and Wyeth, ICRA 2012; the public implementation OpenSeqSLAM (2013).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from loopclosure.errors import ConfigError


def search(
    differences: np.ndarray, *, ds: int = 10, slowest: float = 0.8, fastest: float = 1.2, window: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """Match every query with the trajectory around it, as OpenSeqSLAM does after the drive.

    A trajectory has ``ds + 1`` points, and the query stands in its middle. Its match is the best start plus ``ds / 2``,
    whatever the speed.

    Parameters
    ----------
    differences : ndarray of float, shape (n_queries, n_references)
        From `enhance_contrast`: not negative, smaller = more alike.
    ds : int
        Steps of a trajectory, frames; an odd number is raised by one.
    slowest, fastest : float
        Speeds between which is searched, references a query.
    window : int
        Starts within half of it of the best one do not count as second best, frames.

    Returns
    -------
    matches : ndarray of int64, shape (n_queries,)
        0-based references; -1 where no whole trajectory passes, as for the first and last ``ds / 2`` queries.
    ratios : ndarray of float64, shape (n_queries,)
        Best cost over second best cost, in [0, 1], **smaller = more unique**; infinity without a match.

    Examples
    --------
    >>> matches, ratios = search(1 - np.eye(8), ds=4)
    >>> matches.tolist()
    [-1, -1, 2, 3, 4, 5, -1, -1]
    """
    ds += ds % 2
    costs = _trajectory_costs(differences, _offsets(ds, slowest, fastest))
    matches = np.full(len(differences), -1)
    ratios = np.full(len(differences), np.inf)
    if costs.size == 0:
        return matches, ratios
    starts = costs.argmin(axis=1)
    best = costs.min(axis=1)
    near = np.abs(np.arange(costs.shape[1]) - starts[:, None]) <= window // 2
    second = np.where(near, np.inf, costs).min(axis=1)
    found = np.isfinite(best)
    queries = np.flatnonzero(found) + ds // 2
    matches[queries] = starts[found] + ds // 2
    # Two costs of zero are equally good.
    ratios[queries] = np.divide(best[found], second[found], out=np.ones(len(queries)), where=second[found] > 0)
    return matches, ratios


def uniqueness(scores: np.ndarray, window: int = 10) -> float:
    """Return how much less the best trajectory costs than the best one elsewhere; larger = more alike.

    This is OpenSeqSLAM's ratio turned round, ``1 - best / second best``. Deviation: where nothing is left to compare
    with, the best trajectory counts as not unique, because an early frame must not be a loop for want of others.

    Parameters
    ----------
    scores : ndarray of float, shape (n_references,)
        From `TrajectorySearch.push`: not positive; NaN where there is no candidate.
    window : int
        References within half of it of the best one do not count as elsewhere, frames.

    Returns
    -------
    float
        In [0, 1].

    Examples
    --------
    >>> round(uniqueness(np.array([-0.2, -0.3, -0.4]), window=2), 3)
    0.5
    """
    costs = np.where(np.isnan(scores), np.inf, -scores)
    if costs.size == 0:
        return 0.0
    best = costs.argmin()
    elsewhere = costs[np.abs(np.arange(costs.size) - best) > window // 2]
    second = elsewhere.min(initial=np.inf)
    return float(1 - costs[best] / second) if 0 < second < np.inf else 0.0


class TrajectorySearch:
    """The same search online: trajectories end at the current frame, and a new frame costs one row.

    Deviation from OpenSeqSLAM: there the query stands in the middle of its trajectory and is matched ``ds / 2`` frames
    late; here the match is the end of the trajectory, whatever the speed, and its cost a mean and not a sum.

    Parameters
    ----------
    ds : int
        Steps of a trajectory, frames; it has ``ds + 1`` points.
    slowest, fastest : float
        Speeds between which is searched, references a query.

    Notes
    -----
    Rows may grow: in one stream row t has t entries, against another traverse all rows have the same length.

    Examples
    --------
    >>> trajectories = TrajectorySearch(ds=2)
    >>> scores = [trajectories.push(row) for row in 1 - np.eye(4)]
    >>> int(np.nanargmax(scores[3]))
    3
    """

    def __init__(self, *, ds: int = 10, slowest: float = 0.8, fastest: float = 1.2) -> None:
        self._offsets = _offsets(ds, slowest, fastest)
        self._rows: deque[np.ndarray] = deque(maxlen=ds + 1)

    def push(self, differences: np.ndarray) -> np.ndarray:
        """Take the row of a new frame and score every trajectory that ends at it.

        Parameters
        ----------
        differences : ndarray of float32, shape (n_references,)
            Smaller = more alike, such as from `enhance_row`; infinity where there is no candidate.

        Returns
        -------
        ndarray of float32, shape (n_references,)
            Negative mean difference along the best trajectory that ends at each reference, larger = more alike; NaN
            where none is complete.
        """
        self._rows.append(np.asarray(differences, np.float32))
        n = len(differences)
        if len(self._rows) < self._offsets.shape[1] or n == 0:
            return np.full(n, np.nan, np.float32)
        reach = self._offsets.max()
        # Infinity stands before the first reference and, in older and shorter rows, after the last one.
        padded = np.full((len(self._rows), reach + n), np.inf)
        for steps_back, row in enumerate(reversed(self._rows)):
            padded[steps_back, reach : reach + len(row)] = row[:n]
        costs = np.full(n, np.inf)
        for trajectory in reach - self._offsets:
            points = (row[start : start + n] for row, start in zip(padded, trajectory, strict=True))
            np.minimum(costs, sum(points), out=costs)
        costs /= len(padded)
        return np.where(np.isfinite(costs), -costs, np.nan).astype(np.float32)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {f"row{i}": row for i, row in enumerate(self._rows)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> TrajectorySearch:
        """Take over the state that `to_arrays` gave."""
        self._rows.extend(arrays[f"row{i}"] for i in range(len(arrays)))
        return self


def _offsets(ds: int, slowest: float, fastest: float) -> np.ndarray:
    """Return the references passed up to each point of a trajectory, floored; one row a speed, whole steps in all."""
    if ds < 1 or not 0 < slowest <= fastest:
        raise ConfigError(
            f"found trajectories of {ds} steps at speeds {slowest} to {fastest}, "
            "wanted at least 1 step and 0 < slowest <= fastest"
        )
    passed = np.arange(round(slowest * ds), round(fastest * ds) + 1)
    return np.arange(ds + 1) * passed[:, None] // ds


def _trajectory_costs(differences: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Cost of the best speed for every first query (rows) and first reference (columns)."""
    n_queries, n_references = differences.shape
    n_starts = max(n_queries - offsets.shape[1] + 1, 0)
    padded = np.full((n_queries, n_references + offsets.max()), np.inf)
    padded[:, :n_references] = differences
    costs = np.full((n_starts, n_references), np.inf)
    for trajectory in offsets:
        points = (padded[i : i + n_starts, o : o + n_references] for i, o in enumerate(trajectory))
        np.minimum(costs, sum(points), out=costs)
    return costs
