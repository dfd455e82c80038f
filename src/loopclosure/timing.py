"""Where the time goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Seconds spent in named stages.

    Attributes
    ----------
    seconds : dict of str to float

    Examples
    --------
    >>> watch = Stopwatch("read", "match")
    >>> with watch("match"):
    ...     pass
    >>> watch.seconds["match"] > watch.seconds["read"]
    True
    """

    def __init__(self, *stages: str) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of the ``with`` block to `stage`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start
