"""Every error that the library raises on purpose has one root, so that a caller can catch it in one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class LoopClosureError(Exception):
    """Root of all errors raised on purpose; the command line prints it as one line and exits with 1."""


class ConfigError(LoopClosureError):
    """A setting is unknown, out of range or contradicts another one."""


class ImageError(LoopClosureError):
    """An image, a folder of images or a video cannot be read."""


class WeightsError(LoopClosureError):
    """The weights of a network are missing, damaged or made for another network."""


class ModelError(LoopClosureError):
    """A fitted model or a saved detector cannot be used here."""


class FitError(LoopClosureError):
    """A learned stage cannot be fitted to these data, or is used before it was fitted."""


class ResultsError(LoopClosureError):
    """A run folder or a log of loops cannot be read, or contradicts itself."""


class TruthError(LoopClosureError):
    """A truth file cannot be read, or does not belong to these results."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'x'?"`` for the known name nearest to `name`, or an empty string.

    Examples
    --------
    >>> did_you_mean("sequence.lenght", ["sequence.length", "decision.threshold"])
    ", did you mean 'sequence.length'?"
    """
    nearest = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f", did you mean '{nearest[0]}'?" if nearest else ""
