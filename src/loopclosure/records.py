"""The frozen records that travel between stages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Reason(str, Enum):
    """Why a decision came out as it did; the column ``reason`` of ``loops.csv``.

    A robot acts on `ACCEPTED` alone; the others say what stood in the way.
    """

    ACCEPTED = "accepted"
    """The best candidate passed the threshold (and verification, where it is switched on)."""
    WARMING_UP = "warming_up"
    """No model was given and the first frames of the drive are still being collected to fit one."""
    TOO_RECENT = "too_recent"
    """Every earlier frame is nearer than ``exclude_recent``: nothing can be a loop yet."""
    BELOW_THRESHOLD = "below_threshold"
    """There is a best candidate, but too little speaks for it."""
    INCONSISTENT = "inconsistent"
    """It would be a loop, had the candidate moved on with the robot for longer."""
    SEQUENCE_TOO_SHORT = "sequence_too_short"
    """Fewer frames than one sequence stand behind this frame, or behind every candidate."""
    NOT_VERIFIED = "not_verified"
    """It would be a loop, did one camera motion explain the views along the way."""
    UNREADABLE = "unreadable"
    """The image could not be decoded and ``on_error`` is ``skip``."""

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Decision:
    """What the detector says of one frame.

    Attributes
    ----------
    query : int
        0-based position of the frame in its sequence.
    match : int or None
        0-based position of the best candidate, accepted or not; None where there is no candidate.
    score : float or None
        What decides, larger = more likely a loop: the probability of a loop, or, of methods that are not calibrated,
        the similarity of the two sequences. None where there is no candidate.
    accepted : bool
        Whether the pair is reported as a loop.
    inliers : int or None
        Matches that agree with one camera motion, in the best pair of frames along the way to the match; None where
        geometry was not asked.
    reason : Reason
        Why.
    """

    query: int
    match: int | None
    score: float | None
    accepted: bool
    inliers: int | None
    reason: Reason
