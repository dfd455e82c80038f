"""Scores of all places to the few that are worth a look, and how far each stands out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_APART = 5  # frames of the map, at least, between two candidates
_USUAL_DEVIATION = 0.125  # of the similarity of two single frames of different places, whitened descriptors
_USUAL_WEIGHT = 20  # places that the usual mean and deviation count for


@dataclass(frozen=True)
class Candidate:
    """A place that the current frame may show.

    Attributes
    ----------
    match : int
        Its frame in the map.
    score : float
        Of the two sequences, larger = more alike.
    standing : float
        How far the score lies above the best that chance would give among as many other places, in standard
        deviations of the scores of these.
    """

    match: int
    score: float
    standing: float


def best_candidates(scores: np.ndarray, *, count: int, length: int) -> list[Candidate]:
    """Return the best candidates, none within a sequence of a better one.

    Parameters
    ----------
    scores : ndarray of float32, shape (n,)
        Sequence scores of one frame, larger = more alike; NaN where a place is no candidate.
    count : int
        At most so many.
    length : int
        Frames in a sequence: the deviation of a mean over so many falls with its root, and so many neighbours share
        one sequence.

    Returns
    -------
    list of Candidate
        Best first.

    Examples
    --------
    >>> scores = np.full(100, 0.5, np.float32)
    >>> scores[[20, 21, 70]] = 0.9, 0.95, 0.8
    >>> [candidate.match for candidate in best_candidates(scores, count=2, length=10)]
    [21, 70]
    """
    left = np.where(np.isnan(scores), -np.inf, scores)
    apart = max(length, _APART)
    found: list[Candidate] = []
    while len(found) < count and left.size and np.isfinite(best := left.max()):
        match = int(left.argmax())
        around = slice(max(match - apart, 0), match + apart + 1)
        found.append(Candidate(match, float(best), _standing(scores, match, around, length)))
        left[around] = -np.inf
    return found


def _standing(scores: np.ndarray, match: int, around: slice, length: int) -> float:
    """Return the distance to the scores of other places, which are wrong ones but for a few.

    Where there are few others, the usual mean and deviation of whitened descriptors step in.
    """
    others = np.concatenate([scores[: around.start], scores[around.stop :]]).astype(np.float64)
    others = others[~np.isnan(others)]
    weight = len(others) + _USUAL_WEIGHT
    mean = (others.sum() + _USUAL_WEIGHT * 0.5) / weight
    usual = _USUAL_DEVIATION**2 / length
    variance = (((others - others.mean()) ** 2).sum() if len(others) else 0.0) + _USUAL_WEIGHT * usual
    expected_best = np.sqrt(2 * np.log1p((len(others) + 1) / length))
    return float((scores[match] - mean) / np.sqrt(variance / weight) - expected_best)
