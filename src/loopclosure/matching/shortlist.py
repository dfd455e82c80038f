"""Distance between image sequences (paper 2.3, Eq. 20) for the few candidates that an index finds."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.sequences import SequenceScores
from loopclosure.store import part

_FOUND = 300  # places that the index is asked for, a frame
_FOLLOWED = 600  # best candidates whose sequences are followed to the next frame
_SPREAD = 512  # at most so many places that are scored for comparison
_WAYS = {"forward": 1, "backward": -1}


class SequenceSearch:
    """Candidates of a new frame and their sequence scores, whatever the size of the map.

    While the index compares with all places, so does this, by `SequenceScores`. Beyond that the candidates are the
    places that the index finds for the new frame and those that come after the best candidates of the last one. The
    scores of these are what `SequenceScores` would say: similarities are kept along each diagonal, and those that a new
    candidate lacks are computed from the stored vectors.

    Parameters
    ----------
    places : PlaceIndex
        The map. In one stream the new frame is added after `push`.
    length, exclude_recent, both_directions, history
        See `SequenceScores`.

    Attributes
    ----------
    usual : ndarray of float32, shape (m,)
        Scores, on the way forward, of up to 512 places that lie evenly spread over all that may be candidates, whether
        they are like the frame or not: what chance gives. While all places are compared, the scores of all of these.

    Examples
    --------
    >>> street = np.eye(4, dtype=np.float32)
    >>> search = SequenceSearch(PlaceIndex().restore({"descriptors": street}), 2)
    >>> search.push(street[1])
    (array([], dtype=int64), array([], dtype=float32))
    >>> search.push(street[2])
    (array([1, 2, 3]), array([0.5, 1. , 0.5], dtype=float32))
    """

    def __init__(
        self,
        places: PlaceIndex,
        length: int,
        *,
        exclude_recent: int = 0,
        both_directions: bool = False,
        history: int | None = None,
    ) -> None:
        self.places = places
        self.length = length
        self.exclude_recent = exclude_recent
        self.history = history or length
        self.frames = 0
        self.usual = np.zeros(0, np.float32)
        self._queries: deque[np.ndarray] = deque(maxlen=length)  # newest first
        ways = _WAYS if both_directions else ("forward",)
        self._diagonals = {way: _Diagonals(_WAYS[way], length) for way in ways}
        self._spread = _Diagonals(_WAYS["forward"], length)
        self._all: SequenceScores | None = SequenceScores(
            length, exclude_recent=exclude_recent, both_directions=both_directions, history=history
        )

    def push(self, descriptor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take the descriptor of a new frame and return its candidates.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,)

        Returns
        -------
        ids : ndarray of int64, shape (c,)
            In ascending order.
        scores : ndarray of float32, shape (c,)
            Larger = more alike.
        """
        self.frames += 1
        self._queries.appendleft(np.asarray(descriptor, np.float32))
        if self._all is not None and self.places.exact:
            scores = self._all.push(self.places.similarities(descriptor))
            ids = np.flatnonzero(~np.isnan(scores))
            self.usual = scores[ids]
            return ids, scores[ids]
        if self.frames < self.history:
            return np.zeros(0, np.int64), np.zeros(0, np.float32)
        newest = len(self.places) - max(self.exclude_recent, 1)
        ways = self._diagonals.values()
        followed = [diagonals.follow(_FOLLOWED) for diagonals in ways]
        candidates = np.unique(np.concatenate([*self._found(newest), *followed]))
        queries = np.stack(self._queries)
        self._score_spread(queries, *self._range("forward", newest))
        for way, diagonals in self._diagonals.items():
            diagonals.score(candidates, queries, self.places, self._range(way, newest))
        return _best_way(ways)

    def _found(self, newest: int) -> list[np.ndarray]:
        """Ask the index; the first time also for the frames before, whose places have moved on since."""
        asked = list(self._queries) if self._all is not None else [self._queries[0]]
        self._all = None  # a map does not shrink
        found = [self.places.search(query, _FOUND, newest=newest)[0] for query in asked]
        steps = [_WAYS[way] for way in self._diagonals]
        return [ids + step * age for age, ids in enumerate(found) for step in steps]

    def _score_spread(self, queries: np.ndarray, first: int, last: int) -> None:
        """Score every so many-th diagonal: they stay the same from frame to frame."""
        apart = 1 << max((last - first) // _SPREAD, 0).bit_length()
        ids = np.arange(first + (self.frames - first) % apart, last + 1, apart)
        self._spread.follow(ids.size)
        self._spread.score(ids, queries, self.places, (first, last))
        self.usual = self._spread.scores

    def _range(self, way: str, newest: int) -> tuple[int, int]:
        """First and last place that may be a candidate, as in `SequenceScores`."""
        if way == "forward":
            return self.history - 1, newest
        reach = self.length - 1
        if self.exclude_recent:
            newest = min(newest, len(self.places) - 1 - reach)
        return 0, newest - reach

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state without the map, for `loopclosure.store`."""
        parts = {way: diagonals.to_arrays() for way, diagonals in self._diagonals.items()}
        parts["spread"] = self._spread.to_arrays()
        if self._all is not None:
            parts["all"] = self._all.to_arrays()
        arrays = {f"{name}.{key}": array for name, arrays in parts.items() for key, array in arrays.items()}
        arrays |= {f"query{i}": query for i, query in enumerate(self._queries)}
        return arrays | {"frames": np.array(self.frames)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> SequenceSearch:
        """Take over the state that `to_arrays` gave; the map is restored already."""
        self.frames = int(arrays["frames"])
        self._queries.extend(arrays[f"query{i}"] for i in range(min(self.frames, self.length)))
        for way, diagonals in self._diagonals.items():
            diagonals.restore(part(arrays, way))
        self._spread.restore(part(arrays, "spread"))
        everything = part(arrays, "all")
        self._all = self._all.restore(everything) if self._all is not None and everything else None
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
