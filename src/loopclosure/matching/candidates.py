"""Scores of all places to the few that are worth a look, and how far each stands out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.matching.scored import Scored

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


def best_candidates(scored: Scored, *, count: int, length: int) -> list[Candidate]:
    """Return the best candidates, none within a sequence of a better one.

    Parameters
    ----------
    scored : Scored
        Sequence scores of one frame.
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
    >>> [candidate.match for candidate in best_candidates(Scored(scores), count=2, length=10)]
    [21, 70]
    """
    left = np.where(np.isnan(scored.scores), -np.inf, scored.scores)
    apart = max(length, _APART)
    found: list[Candidate] = []
    while len(found) < count and left.size and np.isfinite(best := left.max()):
        match = scored.place(int(left.argmax()))
        found.append(Candidate(match, float(best), _standing(float(best), *scored.others(match, apart), length)))
        left[scored.around(match, apart)] = -np.inf
    return found


def _standing(score: float, others: np.ndarray, count: int, length: int) -> float:
    """Return the distance to the scores of `count` other places, or a sample, which are wrong ones but for a few.

    Where there are few others, the usual mean and deviation of whitened descriptors step in.
    """
    prior = _USUAL_WEIGHT * (len(others) + 1) / (count + 1)  # as light in a sample as among all
    weight = len(others) + prior
    mean = (others.sum() + prior * 0.5) / weight
    usual = _USUAL_DEVIATION**2 / length
    variance = (((others - others.mean()) ** 2).sum() if len(others) else 0.0) + prior * usual
    expected_best = np.sqrt(2 * np.log1p((count + 1) / length))
    return float((score - mean) / np.sqrt(variance / weight) - expected_best)
