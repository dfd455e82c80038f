"""What a run took out of its descriptors, computed again from the images."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from loopclosure.aggregation.centring import RunningMean
from loopclosure.detect import LoopDetector
from loopclosure.images.sequence import ImageSequence
from loopclosure.methods import Method
from loopclosure.perception import Frames
from loopclosure.report.pairs import Pair
from loopclosure.traverse import describe


def means_taken_out(
    detector: LoopDetector,
    pairs: Sequence[Pair],
    queries: ImageSequence,
    references: ImageSequence | None,
    progress: Callable[[int, int], None],
) -> tuple[Mapping[int, np.ndarray | None], Mapping[int, np.ndarray | None]]:
    """Return the mean that was taken out of each query and of each match of a run.

    Parameters
    ----------
    detector : LoopDetector
        With the model of the run.
    pairs : sequence of Pair
        Queries and matches that are asked for.
    queries, references : ImageSequence
        References are None in one stream.
    progress : callable
        ``progress(done, total)`` in frames.

    Returns
    -------
    of_queries, of_matches : mapping of int to (ndarray of float32, shape (d,), or None)
        By frame; None where nothing was taken out.
    """
    wanted, matched = {pair.query for pair in pairs}, {pair.match for pair in pairs}
    window = detector.config.aggregation.centre_window
    if window == 0:
        return dict.fromkeys(wanted), dict.fromkeys(matched)
    if references is None:
        prior = _mean_of(detector.method, queries, range(min(window, len(queries))), lambda *_: None)
        means = _running_means(detector.method, queries, wanted | matched, window, prior, progress)
        return means, means
    prior = _mean_of(detector.method, references, range(len(references)), progress)
    window = max(window, len(references))
    return _running_means(detector.method, queries, wanted, window, prior, progress), dict.fromkeys(matched, prior)


def window_start(images: Frames, frame: int, window: int) -> int:
    """Return the first of the last `window` readable frames up to this one: its descriptor is made of these."""
    start, before = frame, frame
    while before > 0 and window > 1:
        before -= 1
        if images[before] is not None:
            start, window = before, window - 1
    return start


def _running_means(
    method: Method,
    images: Frames,
    wanted: Iterable[int],
    window: int,
    prior: np.ndarray | None,
    progress: Callable[[int, int], None],
) -> dict[int, np.ndarray | None]:
    """Return the running mean at each wanted frame; frames that are in no window are left out."""
    mean, done = RunningMean(window, prior=prior), 0
    found: dict[int, np.ndarray | None] = {}
    last = max(wanted) + 1
    for frame in sorted(wanted):
        for i, descriptor in _described(method, images, range(max(done, frame + 1 - window), frame + 1)):
            mean.centre(descriptor)
            progress(i + 1, last)
        done = frame + 1
        found[frame] = mean.current
    return found


def _mean_of(method: Method, images: Frames, frames: range, progress: Callable[[int, int], None]) -> np.ndarray | None:
    total, count = np.zeros_like(method.blank(), np.float64), 0
    for i, descriptor in _described(method, images, frames):
        total += descriptor
        count += bool(descriptor.any())  # a blank frame is not counted
        progress(i + 1, len(frames))
    return (total / count).astype(np.float32) if count else None


def _described(method: Method, images: Frames, frames: range) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the descriptors of some frames, each described with those before it as in the drive."""
    recent: deque[np.ndarray] = deque(maxlen=method.window)
    for i in range(window_start(images, frames.start, method.window), frames.stop):
        image = images[i]
        descriptor = describe(method, None if image is None else method.features([image])[0], recent)
        if i in frames:
            yield i, descriptor
