"""Which images show one place: by class, by pose, by a list of pairs. Balanced pairs are drawn from it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from scipy.sparse import csr_array

from loopclosure.errors import FitError

SAME, DIFFERENT, UNKNOWN = 1, 0, -1


class Places(ABC):
    """Images by number, and what is known of each pair of them.

    Parameters
    ----------
    members : ndarray of int64, shape (n,)
        Numbers of the images that belong here.
    """

    def __init__(self, members: np.ndarray) -> None:
        self.members = members

    def __len__(self) -> int:
        return len(self.members)

    @abstractmethod
    def relation(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return `SAME`, `DIFFERENT` or `UNKNOWN` for each pair of image numbers, int8 (rows, columns)."""

    @abstractmethod
    def split(self, share: float, rng: np.random.Generator) -> tuple[Places, Places]:
        """Return two parts: what is learned from, and about `share` of it that is held out."""

    @abstractmethod
    def _pairs(self, kind: int, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw `count` pairs of one kind, int64 (count, 2)."""

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw pairs, half of them of one place and half of two, in random order.

        Returns
        -------
        pairs : ndarray of int64, shape (count, 2)
            Numbers of images.
        same : ndarray of bool, shape (count,)
        """
        same = np.arange(count) < count // 2
        pairs = np.concatenate([self._pairs(SAME, count // 2, rng), self._pairs(DIFFERENT, count - count // 2, rng)])
        order = rng.permutation(count)
        return pairs[order], same[order]


class LabelledPlaces(Places):
    """Images of classes: one class, one place. Every class is drawn as often as every other.

    Parameters
    ----------
    labels : ndarray of int64, shape (all images,)
        Class of each image.
    members
        See `Places`.

    Examples
    --------
    >>> places = LabelledPlaces(np.array([0, 0, 1, 1]), np.arange(4))
    >>> places.relation(np.array([0]), places.members).tolist()
    [[-1, 1, 0, 0]]
    """

    def __init__(self, labels: np.ndarray, members: np.ndarray) -> None:
        super().__init__(members)
        self.labels = labels
        self._classes = [members[labels[members] == label] for label in np.unique(labels[members])]

    def relation(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """See `Places.relation`; an image and itself are no pair."""
        known = np.equal.outer(self.labels[rows], self.labels[columns]).astype(np.int8)
        return np.where(np.equal.outer(rows, columns), np.int8(UNKNOWN), known)

    def split(self, share: float, rng: np.random.Generator) -> tuple[LabelledPlaces, LabelledPlaces]:
        """Hold out images of every class."""
        kept, held = [], []
        for images in map(rng.permutation, self._classes):
            out = min(max(2, round(share * len(images))), len(images) - 2)
            if out < 2:
                raise FitError(
                    f"a class holds {len(images)} image{'s' * (len(images) != 1)}, wanted at least 4: "
                    "two to learn from and two to measure on"
                )
            held.append(images[:out])
            kept.append(images[out:])
        return tuple(LabelledPlaces(self.labels, np.sort(np.concatenate(part))) for part in (kept, held))  # type: ignore[return-value]

    def _pairs(self, kind: int, count: int, rng: np.random.Generator) -> np.ndarray:
        first = rng.integers(len(self._classes), size=count)
        other = (first + rng.integers(1, len(self._classes), size=count)) % len(self._classes)
        drawn = np.empty((count, 2), np.int64)
        for row, classes in enumerate(zip(first, other, strict=True)):
            if kind == SAME:
                drawn[row] = rng.choice(self._classes[classes[0]], 2, replace=False)
            else:
                drawn[row] = [rng.choice(self._classes[k]) for k in classes]
        return drawn


class PosedPlaces(Places):
    """Frames with poses: near ones are one place, far ones two, those between are not used.

    Neighbours in time are not used as pairs of one place either: they tell what the camera saw a moment ago, not what
    the place looks like on another visit.

    Parameters
    ----------
    positions : ndarray of float64, shape (all images, 2 or 3)
        Metres.
    positive_m, negative_m : float
        One place up to the first distance, two places beyond the second.
    exclude_recent : int
        Frames nearer in time than this are no pair of one place.
    members
        See `Places`.
    """

    def __init__(
        self,
        positions: np.ndarray,
        members: np.ndarray,
        *,
        positive_m: float,
        negative_m: float,
        exclude_recent: int,
    ) -> None:
        super().__init__(members)
        self.positions = positions
        self._rule = {"positive_m": positive_m, "negative_m": negative_m, "exclude_recent": exclude_recent}
        self._anchors: dict[int, np.ndarray] = {}

    def relation(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """See `Places.relation`."""
        away = np.linalg.norm(self.positions[rows, None] - self.positions[None, columns], axis=-1)
        another_visit = np.abs(np.subtract.outer(rows, columns)) >= self._rule["exclude_recent"]
        known = np.full(away.shape, UNKNOWN, np.int8)
        known[(away <= self._rule["positive_m"]) & another_visit] = SAME
        known[away > self._rule["negative_m"]] = DIFFERENT
        return known

    def anchors(self, kind: int) -> np.ndarray:
        """Return the members that have a partner of this kind."""
        if kind not in self._anchors:
            has = [bool((self.relation(np.array([i]), self.members) == kind).any()) for i in self.members]
            self._anchors[kind] = self.members[has]
        return self._anchors[kind]

    def split(self, share: float, rng: np.random.Generator) -> tuple[PosedPlaces, PosedPlaces]:
        """Hold out one stretch of the world: the frames nearest to a point, on whatever visit they were taken."""
        centre = self.positions[rng.choice(self.anchors(SAME))]
        order = np.argsort(np.linalg.norm(self.positions[self.members] - centre, axis=-1), kind="stable")
        out = max(1, round(share * len(order)))
        parts = np.sort(self.members[order[out:]]), np.sort(self.members[order[:out]])
        return tuple(PosedPlaces(self.positions, part, **self._rule) for part in parts)  # type: ignore[return-value, arg-type]

    def _pairs(self, kind: int, count: int, rng: np.random.Generator) -> np.ndarray:
        first = rng.choice(self.anchors(kind), size=count)
        known = (self.relation(np.array([i]), self.members)[0] for i in first)
        second = [rng.choice(self.members[row == kind]) for row in known]
        return np.stack([first, np.array(second, np.int64)], axis=1)


class ListedPlaces(Places):
    """Pairs from a list. What is not in the list is unknown.

    Parameters
    ----------
    pairs : ndarray of int64, shape (n, 2)
        Numbers of images.
    same : ndarray of bool, shape (n,)
        Whether they show one place.
    """

    def __init__(self, pairs: np.ndarray, same: np.ndarray) -> None:
        super().__init__(np.unique(pairs))
        self.pairs, self.same = pairs, same
        side = int(pairs.max(initial=-1)) + 1
        both_ways = np.concatenate([pairs, pairs[:, ::-1]]).T
        self._known = csr_array((np.tile(np.where(same, 2, 1), 2).astype(np.int8), both_ways), shape=(side, side))

    def relation(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """See `Places.relation`."""
        return self._known[rows][:, columns].toarray().astype(np.int8) - 1

    def split(self, share: float, rng: np.random.Generator) -> tuple[ListedPlaces, ListedPlaces]:
        """Hold out pairs of both kinds; an image may occur in a pair of either part."""
        held = np.zeros(len(self.pairs), bool)
        for kind in (True, False):
            rows = rng.permutation(np.flatnonzero(self.same == kind))
            held[rows[: max(1, round(share * len(rows)))]] = True
        return tuple(ListedPlaces(self.pairs[part], self.same[part]) for part in (~held, held))  # type: ignore[return-value]

    def _pairs(self, kind: int, count: int, rng: np.random.Generator) -> np.ndarray:
        rows = np.flatnonzero(self.same == bool(kind))
        return self.pairs[rng.choice(rows, size=count, replace=count > len(rows))]
