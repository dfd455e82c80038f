"""From scores to a decision: what speaks for each candidate, the odds of a loop, and why it was accepted or not.

Where a method's similarities mean the same on every drive (`Method.calibrated`) the score of a decision is the
probability of a loop, and `decision.false_loops_per_1000` is the only knob. Elsewhere it is the similarity of the two
sequences, which must reach a threshold on frames that move on together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.config import Config
from loopclosure.matching.candidates import Candidate, best_candidates
from loopclosure.matching.consistency import Consistency, Followed
from loopclosure.matching.scored import Scored
from loopclosure.methods import Method
from loopclosure.records import Decision, Reason
from loopclosure.store import part
from loopclosure.verification import Verifier, Views, Witness

_CANDIDATES = 8  # that are looked at; the true place is among so many far more often than it is the first


@dataclass(frozen=True)
class Evidence:
    """What speaks for one candidate.

    Attributes
    ----------
    match : int
        The candidate's frame in the map.
    similarity : float
        Of the two sequences, 1 - D (Eq. 20).
    standing : float
        Standard deviations by which it lies above the best that chance would give, see `Candidate`.
    run : int
        Frames over which the candidate has moved on with the robot, of those in which it stood out.
    lasting : float
        Mean standing while it moved on, see `Followed`.
    support : float
        Geometric support on the way to the candidate, see `Witness`; 0 without verification.
    inliers : int or None
        Matches that agree with one camera motion, in the best pair of frames; None where none was looked at.
    """

    match: int
    similarity: float
    standing: float
    run: int
    lasting: float = 0.0
    support: float = 0.0
    inliers: int | None = None

    @property
    def log_odds(self) -> float:
        """Natural logarithm of the odds that the candidate is a loop."""
        return _CONSTANT + sum(weight * value for weight, value in zip(_WEIGHTS, features_of(self), strict=True))

    @property
    def probability(self) -> float:
        """That the candidate is a loop, 0..1."""
        return 1 / (1 + math.exp(-self.log_odds))


_LONGEST_RUN = 60
_SURE_RUN = 10  # frames from which on geometry counts in full: the like of a lorry is soon out of sight
_SUPPORT_BY_CHANCE, _MOST_SUPPORT = 4.0, 20.0  # two lorries of one model come near to 4, as two zebra crossings do
_CONFIRMED = 8.0  # support; by day a place that is seen again reaches more than that
# Fitted by `python benchmarks/calibration.py`, which prints them and what they come to on places that were left out.
_WEIGHTS = 0.938, 0.085, 1.035, 2.543
_CONSTANT = -6.506
_FALSE_PER_1000 = 12.0  # false loops among 1000 frames that no loop is in, at even odds
_LOOKS = 3  # candidates of a frame, at most, that are verified
_WORTH_A_LOOK = -5.3  # log-odds; below, not one candidate in two hundred is a loop, and a look costs a millisecond


def features_of(evidence: Evidence) -> tuple[float, ...]:
    """Return the numbers that the log-odds are a weighted sum of: standing, run, lasting, support."""
    support = min(max(evidence.support, _SUPPORT_BY_CHANCE), _MOST_SUPPORT) - _SUPPORT_BY_CHANCE
    return (
        _bounded(evidence.standing),
        float(min(evidence.run, _LONGEST_RUN)),
        evidence.lasting,
        support * min(evidence.run / _SURE_RUN, 1.0),
    )


def _bounded(standing: float) -> float:
    return min(max(standing, -1.0), 10.0)


def least_probability(false_loops_per_1000: float) -> float:
    """Return the probability from which on a loop is accepted, so that no more false ones than that are to be expected.

    Examples
    --------
    >>> round(least_probability(1.2), 3)
    0.9
    """
    return 1 - min(false_loops_per_1000 / _FALSE_PER_1000, 0.5)


class Judge:
    """Decide frame by frame; what was seen before counts.

    Parameters
    ----------
    config : Config
        Its sections `sequence`, `decision` and `verification` are used.
    method : Method
        Whose scores are judged.
    one_stream : bool
        Whether candidates come from the drive itself.
    reference : Views, optional
        Views of the reference traverse; without them nothing is verified. One stream has its own.

    Attributes
    ----------
    evidence : tuple of Evidence
        What spoke for each candidate of the last frame, best first.
    views : Views or None
        Of the drive; None where nothing is verified.
    places : Views or None
        Those of the map: of the reference traverse, or the same ones.
    """

    def __init__(self, config: Config, method: Method, *, one_stream: bool, reference: Views | None = None) -> None:
        self.config = config
        self.method = method
        self.one_stream = one_stream
        self.evidence: tuple[Evidence, ...] = ()
        self.views = new_views(config, method)
        self.places = self.views if one_stream else reference
        self._consistency = Consistency(both_directions=config.sequence.direction == "both")
        self._witness: Witness | None = None
        if self.views is not None and self.places is not None:
            self._witness = Witness(self.views, self.places, both_directions=config.sequence.direction == "both")

    @property
    def threshold(self) -> float:
        """Least score of a loop."""
        if self.config.decision.threshold is not None:
            return self.config.decision.threshold
        if self.method.calibrated:
            return least_probability(self.config.decision.false_loops_per_1000)
        return self.method.threshold

    def see(self, query: int, picture: bytes | None) -> None:
        """Take the picture of a frame, where it is kept (`Views.wanted`)."""
        if self.views is not None and self.views.wanted(query):
            self.views.add(picture)

    def decide(
        self, query: int, scored: Scored, *, readable: bool, nearest: Callable[[int, int], int] | None = None
    ) -> Decision:
        """Decide on a frame by its sequence scores.

        ``nearest(match, run)`` tells a candidate that has moved on for `run` frames from its neighbours.
        """
        candidates = []
        if readable:
            count = _CANDIDATES if self.method.calibrated else 1
            candidates = best_candidates(scored, count=count, length=self.config.sequence.length)
        standings = [_bounded(candidate.standing) for candidate in candidates] if self.method.calibrated else None
        followed = self._consistency.push([candidate.match for candidate in candidates], standings)
        self.evidence = self._weighed(query, candidates, followed)
        if not self.evidence:
            return Decision(query, None, None, False, None, self._why_none(query) if readable else Reason.UNREADABLE)
        best, *others = self.evidence
        if nearest is not None:
            best = replace(best, match=nearest(best.match, best.run))
            self.evidence = (best, *others)
        reason = self._why(best)
        score = best.probability if self.method.calibrated else best.similarity
        return Decision(query, best.match, score, reason is Reason.ACCEPTED, best.inliers, reason)

    def _weighed(self, query: int, candidates: list[Candidate], followed: list[Followed]) -> tuple[Evidence, ...]:
        found = [
            Evidence(candidate.match, candidate.score, candidate.standing, behind.run, behind.lasting)
            for candidate, behind in zip(candidates, followed, strict=True)
        ]
        if self._witness is not None:
            likely = sorted((one for one in found if one.log_odds >= _WORTH_A_LOOK), key=lambda one: -one.log_odds)
            heard = self._witness.hear(
                query, [one.match for one in found], look_at=[one.match for one in likely[:_LOOKS]]
            )
            found = [replace(one, **two._asdict()) for one, two in zip(found, heard, strict=True)]
        return tuple(sorted(found, key=lambda one: -one.log_odds)) if self.method.calibrated else tuple(found)

    def _why(self, best: Evidence) -> Reason:
        """Say what the candidate lacks: the first thing that alone would have made it a loop."""
        if not self.method.calibrated:
            if best.similarity < self.threshold:
                return Reason.BELOW_THRESHOLD
            return Reason.ACCEPTED if best.run >= self.config.decision.consistency else Reason.INCONSISTENT
        if best.probability >= self.threshold:
            return Reason.ACCEPTED
        if replace(best, run=_LONGEST_RUN).probability >= self.threshold:
            return Reason.INCONSISTENT
        if self._witness is None:
            return Reason.BELOW_THRESHOLD
        confirmed = replace(best, support=max(best.support, _CONFIRMED))
        return Reason.NOT_VERIFIED if confirmed.probability >= self.threshold else Reason.BELOW_THRESHOLD

    def _why_none(self, query: int) -> Reason:
        old_enough = not self.one_stream or query >= self.config.sequence.exclude_recent
        return Reason.SEQUENCE_TOO_SHORT if old_enough else Reason.TOO_RECENT

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        parts = {"consistency": self._consistency.to_arrays()}
        if self.views is not None and self._witness is not None:
            parts |= {"views": self.views.to_arrays(), "witness": self._witness.to_arrays()}
            if self.places is not None and self.places is not self.views:
                parts["places"] = self.places.to_arrays()
        return {f"{name}.{key}": array for name, arrays in parts.items() for key, array in arrays.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Judge:
        """Take over the state that `to_arrays` gave."""
        self._consistency.restore(part(arrays, "consistency"))
        if self.views is not None and self._witness is not None:
            self.views.restore(part(arrays, "views"))
            self._witness.restore(part(arrays, "witness"))
        return self


def new_views(config: Config, method: Method) -> Views | None:
    """Return an empty store of views; None where nothing is to be verified."""
    mode = config.verification.mode
    if mode == "none" or not method.calibrated:
        return None
    return Views(Verifier(mode), every=min(config.verification.every, max(config.sequence.length // 2, 1)))
