"""What a run writes while it goes on, and how it goes on after an interruption."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure import store
from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ModelError
from loopclosure.evaluation.log import LOOPS_FILE, LOOPS_HEADER, read_loops
from loopclosure.images.sequence import ImageSequence
from loopclosure.records import Decision, Reason

SCORES = "scores.npy"
_CHECKPOINT = "checkpoint"
_DETECTOR, _RUN, _NAMES = "detector", "run", "names_sha256"
_MAY_CHANGE = ("images.on_error", "features.backend")  # from an interrupted run to the rest of it
_THUMBNAIL = 800  # largest side of the score matrix that a run keeps in memory
_SECONDS_BETWEEN = 60.0
_MOST_OF_THE_TIME = 0.05  # that saving may take


class Stopped(KeyboardInterrupt):
    """Ctrl-C between two frames, where the detector can be saved."""


@contextmanager
def stop_between_frames() -> Iterator[Callable[[], None]]:
    """Keep the first Ctrl-C until the function that is given is called; the second one interrupts at once, as usual."""
    asked = threading.Event()

    def stop_if_asked() -> None:
        if asked.is_set():
            raise Stopped

    if threading.current_thread() is not threading.main_thread():
        yield stop_if_asked  # only the main thread hears of signals
        return
    before = signal.getsignal(signal.SIGINT)

    def ask(*_: Any) -> None:
        asked.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield stop_if_asked
    finally:
        signal.signal(signal.SIGINT, before)


class LoopFile:
    """Writes ``loops.csv`` row by row: one a frame, in order; match and score are empty where there is no candidate.

    Rows stand in ``loops.csv.part`` as soon as they are added; the file takes its name when it is whole.
    """

    def __init__(self, folder: Path, *, keep: int = 0) -> None:
        self._path, self._part = folder / LOOPS_FILE, folder / f"{LOOPS_FILE}.part"
        self.decisions = _kept_rows(self._part, keep) if keep else []

    def add(self, item: Decision) -> None:
        """Write the next row."""
        score = "" if item.score is None else f"{item.score:.12g}"  # a probability near 1 has many nines
        self._writer.writerow([item.query, item.match, score, str(item.accepted).lower(), item.inliers, item.reason])
        self._file.flush()
        self.decisions.append(item)

    def finish(self) -> None:
        """Give the file its name."""
        self._file.close()
        os.replace(self._part, self._path)

    def __enter__(self) -> LoopFile:
        self._file = open(self._part, "a" if self.decisions else "w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        if not self.decisions:
            self._writer.writerow(LOOPS_HEADER)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _kept_rows(part: Path, count: int) -> list[Decision]:
    """Cut the file behind its first `count` rows and return them."""
    with open(part, "rb+") as file:
        lines = [file.readline() for _ in range(count + 1)]
        file.truncate()
    if not lines[-1].endswith(b"\n"):
        raise ModelError(f"{part} has fewer than {count} rows, which the checkpoint counts; start without --resume")
    log = read_loops(part)
    return [
        Decision(
            query,
            int(log.match[query]) if log.match[query] >= 0 else None,
            float(log.score[query]) if log.match[query] >= 0 else None,
            bool(log.accepted[query]),
            int(log.inliers[query]) if log.inliers[query] >= 0 else None,
            Reason(log.reason[query]),
        )
        for query in range(count)
    ]


class Thumbnail:
    """The score matrix at a bounded size: the largest score of each cell.

    The length of a video is an estimate, so rows and columns beyond it are dropped here; ``scores.npy`` has them all.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self._step = -(-max(rows, columns) // _THUMBNAIL)
        self.cells = np.full((-(-rows // self._step), -(-columns // self._step)), np.nan, np.float32)

    def add(self, row: int, scores: np.ndarray) -> None:
        """Take the scores of a frame, float32 (n,)."""
        if scores.size and row // self._step < len(self.cells):
            largest = np.fmax.reduceat(scores, np.arange(0, scores.size, self._step))[: self.cells.shape[1]]
            cells = self.cells[row // self._step, : largest.size]
            np.fmax(cells, largest, out=cells)


class ScoreFile:
    """Writes ``scores.npy`` row by row; the file appears when all rows are there.

    Parameters
    ----------
    folder : Path
        The run folder.
    lengths : list of int
        Lengths of the rows that an interrupted run has written; it grows with the rows.
    wanted : bool
        Whether anything is written at all.
    """

    def __init__(self, folder: Path, lengths: list[int], *, wanted: bool) -> None:
        self._path, self._wanted = folder / SCORES, wanted
        self._rows_path, self._part = folder / f"{SCORES}.rows", folder / f"{SCORES}.part"
        self.lengths = lengths  # of the rows that are there

    def __enter__(self) -> ScoreFile:
        if self._wanted:
            self._rows = open(self._rows_path, "rb+" if self.lengths else "wb")
            self._rows.truncate(4 * sum(self.lengths))
            self._rows.seek(0, os.SEEK_END)
        return self

    def add(self, scores: np.ndarray) -> None:
        """Take the next row; in one stream rows grow."""
        if self._wanted:
            self.lengths.append(scores.size)
            self._rows.write(scores.astype(np.float32).tobytes())

    def flush(self) -> None:
        """Bring all rows to the file."""
        if self._wanted:
            self._rows.flush()

    def finish(self, columns: int) -> None:
        """Put the rows into one matrix, NaN where a row is shorter."""
        if not self._wanted:
            return
        self._rows.flush()
        shape = (len(self.lengths), columns)
        matrix = np.lib.format.open_memmap(self._part, mode="w+", dtype=np.float32, shape=shape)
        with open(self._rows_path, "rb") as rows:
            for row, length in enumerate(self.lengths):
                matrix[row, :length] = np.frombuffer(rows.read(4 * length), np.float32)
                matrix[row, length:] = np.nan
        matrix.flush()
        os.replace(self._part, self._path)
        self._rows_path.unlink()

    def __exit__(self, *_: object) -> None:
        if self._wanted:
            self._rows.close()
        self._part.unlink(missing_ok=True)


class RunState:
    """What a run must know to go on.

    Parameters
    ----------
    detector : LoopDetector
    frames : int
        Frames of the whole run, perhaps an estimate.

    Attributes
    ----------
    matrix : Thumbnail
    lengths : list of int
        Of the rows of the score file.
    """

    def __init__(self, detector: LoopDetector, frames: int) -> None:
        self.detector = detector
        self.matrix = Thumbnail(frames, frames if detector.one_stream else detector.map_size)
        self.lengths: list[int] = []
        self._before: dict[str, float] = {}
        self._started = time.perf_counter()

    @property
    def seconds(self) -> dict[str, float]:
        """Time spent in each stage and in all, before an interruption too."""
        now = self.detector.seconds | {"total": time.perf_counter() - self._started}
        return {stage: spent + self._before.get(stage, 0.0) for stage, spent in now.items()}

    def save(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """Write the state into a folder."""
        self.detector.save(folder / _DETECTOR)
        arrays: dict[str, np.ndarray] = {"cells": self.matrix.cells, "lengths": np.array(self.lengths, np.int64)}
        store.save_arrays(folder / _RUN, kind="run", header={**identity, "seconds": self.seconds}, arrays=arrays)

    @classmethod
    def load(cls, folder: Path, frames: int) -> RunState:
        """Bring back a state that `save` wrote."""
        header, arrays = store.load_arrays(folder / _RUN, kind="run")
        state = cls(LoopDetector.load(folder / _DETECTOR), frames)
        with store.damaged_is_an_error(folder):
            state.matrix.cells, state.lengths = arrays["cells"], arrays["lengths"].tolist()
            state._before = dict(header["seconds"])
        return state


class Checkpoint:
    """The state of a run that is under way, in its folder.

    Parameters
    ----------
    folder : Path
        The run folder.
    identity : dict
        What the run is made of, see `run_identity`; a run that goes on must be made of the same.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        self._folder, self._identity = folder, identity
        self._whole, self._part = folder / _CHECKPOINT, folder / f"{_CHECKPOINT}.part"
        self._saved, self._cost = time.monotonic(), 0.0

    def due(self) -> bool:
        """Whether to save again: after a minute, or later where saving takes long."""
        return time.monotonic() - self._saved > max(_SECONDS_BETWEEN, self._cost / _MOST_OF_THE_TIME)

    def save(self, state: RunState, images: ImageSequence) -> None:
        """Write the state after the last frame; it replaces the one before when it is whole."""
        started = time.monotonic()
        shutil.rmtree(self._part, ignore_errors=True)
        frames = state.detector.frames
        state.save(self._part, {**self._identity, "frames": frames, _NAMES: _names_sha256(images, frames)})
        shutil.rmtree(self._whole, ignore_errors=True)
        os.replace(self._part, self._whole)
        self._saved = time.monotonic()
        self._cost = self._saved - started

    def load(self, images: ImageSequence) -> RunState | None:
        """Return the state of the interrupted run; None if it was killed before it saved one.

        Raises
        ------
        ConfigError
            If there is no interrupted run, or it was another one.
        ModelError
            If a file is damaged.
        """
        found = [folder for folder in (self._whole, self._part) if (folder / _RUN / store.HEADER).is_file()]
        if not found:
            if (self._folder / f"{LOOPS_FILE}.part").is_file():
                return None
            raise ConfigError(f"{self._folder} holds no interrupted run; start without --resume")
        header = store.load_header(found[0] / _RUN, kind="run")
        for name, wanted in self._identity.items():
            if header.get(name) != wanted:
                raise ConfigError(
                    f"the interrupted run in {self._folder} had {name} = {header.get(name)}, wanted {wanted}; "
                    "give the same settings, or start without --resume"
                )
        if header.get(_NAMES) != _names_sha256(images, int(header.get("frames", 0))):
            raise ConfigError(f"{images.source} no longer begins with the frames that {self._folder} has gone through")
        return RunState.load(found[0], len(images))

    def remove(self) -> None:
        """Forget the state."""
        for folder in (self._whole, self._part):
            shutil.rmtree(folder, ignore_errors=True)


def run_identity(
    source: str | os.PathLike[str],
    reference: str | os.PathLike[str] | None,
    config: Config | None,
    *,
    save_scores: bool,
) -> dict[str, Any]:
    """Return what tells one run from another, as JSON holds it."""
    settings = {} if config is None else config.flat()
    settings = {name: value for name, value in settings.items() if name not in _MAY_CHANGE}
    paths = {"source": str(source), "reference": None if reference is None else str(reference)}
    return json.loads(json.dumps({**paths, "--save-scores": save_scores, **settings}))


def _names_sha256(images: ImageSequence, count: int) -> str:
    return hashlib.sha256("\n".join(images.names[:count]).encode()).hexdigest()
