"""Distance between image sequences (paper 2.3, Eq. 20) for the few candidates that an index finds."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.scored import Scored
from loopclosure.matching.sequences import SequenceScores
from loopclosure.store import part

_FOUND = 300  # places that the index is asked for, a frame
_FOLLOWED = 600  # best candidates whose sequences are followed to the next frame
_SPREAD = 512  # at most so many places that are scored for comparison
_WAYS = {"forward": 1, "backward": -1}


class SequenceSearch:
    """Candidates of a new frame and their sequence scores, whatever the size of the map.

    While the index compares with all places, so does this. Beyond that the candidates are the places that the index
    finds for the new frame and those that come after the best candidates of the last one. The scores of these are what
    `SequenceScores` would say: similarities are kept along each diagonal, and those that a new candidate lacks are
    computed from the stored vectors.

    Parameters
    ----------
    places : PlaceIndex
        The map. In one stream the new frame is added after `push`.
    sums : SequenceScores
        What scores all places, and says how: `length`, `exclude_recent`, `both_directions`, `history`.

    Examples
    --------
    >>> street = np.eye(4, dtype=np.float32)
    >>> search = SequenceSearch(PlaceIndex().restore({"descriptors": street}), SequenceScores(2))
    >>> search.push(street[1]).row()
    array([nan, nan, nan, nan], dtype=float32)
    >>> search.push(street[2]).row()
    array([nan, 0.5, 1. , 0.5], dtype=float32)
    """

    def __init__(self, places: PlaceIndex, sums: SequenceScores) -> None:
        self.places = places
        self.length = sums.length
        self.exclude_recent = sums.exclude_recent
        self.history = sums.history
        self.frames = 0
        self._queries: deque[np.ndarray] = deque(maxlen=self.length)  # newest first
        ways = _WAYS if sums.both_directions else ("forward",)
        self._diagonals = {way: _Diagonals(_WAYS[way], self.length) for way in ways}
        self._spread = {way: _Diagonals(_WAYS[way], self.length) for way in ways}
        self._all: SequenceScores | None = sums

    def push(self, descriptor: np.ndarray) -> Scored:
        """Take the descriptor of a new frame, float32 (d,), and return the scores of its candidates."""
        self.frames += 1
        self._queries.appendleft(np.asarray(descriptor, np.float32))
        if self._all is not None and (self.places.exact or len(self._queries) < min(self.frames, self.length)):
            return Scored(self._all.push(self.places.similarities(descriptor)))
        self._all = None  # a map does not shrink
        if self.frames < self.history:
            return Scored.nothing(len(self.places))
        newest = len(self.places) - max(self.exclude_recent, 1)
        ways = self._diagonals.values()
        followed = [diagonals.follow(_FOLLOWED) for diagonals in ways]
        candidates = np.unique(np.concatenate([*self._found(newest), *followed]))
        queries = np.stack(self._queries)
        for way, diagonals in self._diagonals.items():
            diagonals.score(candidates, queries, self.places, self._range(way, newest))
        ids, scores = _best_way(ways)
        return Scored(scores, ids, usual=self._usual(queries, newest), places=len(self.places))

    def _found(self, newest: int) -> list[np.ndarray]:
        """Ask the index; the first time also for the frames before, whose places have moved on since."""
        asked = [self._queries[0]] if self._spread["forward"].ids.size else self._queries
        found = [self.places.search(query, _FOUND, newest=newest)[0] for query in asked]
        steps = [_WAYS[way] for way in self._diagonals]
        return [ids + step * age for age, ids in enumerate(found) for step in steps]

    def _usual(self, queries: np.ndarray, newest: int) -> Scored:
        """Score every so many-th diagonal on the way forward, which stay the same from frame to frame."""
        first, last = self._range("forward", newest)
        apart = 1 << max((last - first) // _SPREAD, 0).bit_length()
        ids = np.arange(first + (self.frames - first) % apart, last + 1, apart)
        for way, diagonals in self._spread.items():
            diagonals.follow(ids.size)
            diagonals.score(ids, queries, self.places, self._range(way, newest))
        ids, scores = _best_way(self._spread.values())
        return Scored(scores, ids)

    def _range(self, way: str, newest: int) -> tuple[int, int]:
        """First and last place that may be a candidate, as in `SequenceScores`."""
        if way == "forward":
            return self.history - 1, newest
        reach = self.length - 1
        if self.exclude_recent:
            newest = min(newest, len(self.places) - 1 - reach)
        return 0, newest - reach

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state without the map, for `loopclosure.store`: that of `sums`, as long as all are compared."""
        queries = {f"query{i}": query for i, query in enumerate(self._queries)}
        if self._all is not None:
            return self._all.to_arrays() | queries
        parts = {way: diagonals.to_arrays() for way, diagonals in self._diagonals.items()}
        parts |= {f"spread-{way}": diagonals.to_arrays() for way, diagonals in self._spread.items()}
        arrays = {f"{name}.{key}": array for name, arrays in parts.items() for key, array in arrays.items()}
        return arrays | queries | {"frames": np.array(self.frames)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> SequenceSearch:
        """Take over the state that `to_arrays` gave, or that of `sums` alone; the map is restored already."""
        self.frames = int(arrays["frames"])
        names = (f"query{i}" for i in range(self.length))
        self._queries.extend(arrays[name] for name in names if name in arrays)
        if self._all is not None and "forward" in arrays:
            self._all.restore(arrays)
            return self
        self._all = None
        for way, diagonals in self._diagonals.items():
            diagonals.restore(part(arrays, way))
            self._spread[way].restore(part(arrays, f"spread-{way}"))
        return self


class _Diagonals:
    """Candidates, and the similarities on the way to each of them.

    Parameters
    ----------
    step : int
        Places by which a candidate moves from one frame to the next: 1, or -1 for a street driven back.
    length : int
        Frames in a sequence.
    """

    def __init__(self, step: int, length: int) -> None:
        self.ids = np.zeros(0, np.int64)
        self.scores = np.zeros(0, np.float32)
        self._step = step
        self._terms = np.zeros((0, length), np.float32)  # newest first

    def follow(self, count: int) -> np.ndarray:
        """Move the best `count` candidates on by a frame and return them."""
        best = np.argsort(-self.scores, kind="stable")[:count]
        self.ids, self._terms = self.ids[best] + self._step, self._terms[best]
        return self.ids

    def score(self, candidates: np.ndarray, queries: np.ndarray, places: PlaceIndex, allowed: tuple[int, int]) -> None:
        """Score those of `candidates` that are allowed; what these lack is computed."""
        first, last = allowed
        candidates = candidates[(first <= candidates) & (candidates <= last)]
        at = np.searchsorted(candidates, self.ids)
        inside = at < candidates.size
        inside[inside] = candidates[at[inside]] == self.ids[inside]
        followed, terms = self.ids[inside], self._terms[inside]
        new = np.delete(candidates, at[inside])
        newest = _similarities(places.rows(followed[:, None]), queries[:1])
        windows = new[:, None] - self._step * np.arange(len(queries))
        self._terms = np.concatenate([np.hstack([newest, terms[:, :-1]]), _similarities(places.rows(windows), queries)])
        self.ids = np.concatenate([followed, new])
        self.scores = self._terms.mean(1, dtype=np.float64).astype(np.float32)

    def to_arrays(self) -> dict[str, np.ndarray]:
        return {"ids": self.ids, "scores": self.scores, "terms": self._terms}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.ids, self.scores, self._terms = arrays["ids"], arrays["scores"], arrays["terms"]


def _similarities(rows: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Compare rows, float32 (c, l, d), with the l queries one by one, on the scale of `VectorMap`."""
    return np.clip((1 + np.einsum("cld,ld->cl", rows, queries)) / 2, 0, 1)


def _best_way(ways: Iterable[_Diagonals]) -> tuple[np.ndarray, np.ndarray]:
    """Join the candidates of all ways; where two of them meet, the better score counts."""
    ids, place = np.unique(np.concatenate([way.ids for way in ways]), return_inverse=True)
    scores = np.zeros(ids.size, np.float32)
    np.maximum.at(scores, place, np.concatenate([way.scores for way in ways]))
    return ids, scores
