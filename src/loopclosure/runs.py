"""A run: the loops of a whole sequence, and the folder that holds them."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure import __version__
from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ImageError
from loopclosure.evaluation.log import LOOPS_FILE, LOOPS_HEADER
from loopclosure.images.sequence import ImageSequence
from loopclosure.records import Decision, Reason
from loopclosure.store import HEADER

RUN, SCORES, MODEL = "run.json", "scores.npy", "model"
_DERIVED = (SCORES, "metrics.json", "precision_recall.png", "report.html")  # of results that are about to be replaced
_PACKAGES = ("numpy", "opencv-python-headless", "scikit-learn", "torch", "torchvision")
_THUMBNAIL = 800  # largest side of the score matrix that a run keeps in memory

RunProgress = Callable[[str, int, int], None]
"""``progress(stage, done, total)``."""


@dataclass(frozen=True)
class Run:
    """Loops found in one sequence.

    Attributes
    ----------
    folder : Path
        Where the files are.
    decisions : tuple of Decision
        One a frame, in order.
    info : dict
        Content of ``run.json``.
    matrix : ndarray of float32, shape (at most 800, at most 800)
        Sequence scores, the largest of each cell; NaN where no pair is a candidate.
    query_images, reference_images : ImageSequence
        What the rows and the columns of the matrix show; the same object in one stream, None for a saved detector.
    """

    folder: Path
    decisions: tuple[Decision, ...]
    info: Mapping[str, Any]
    matrix: np.ndarray
    query_images: ImageSequence
    reference_images: ImageSequence | None


def detect_loops(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    config: Config | None = None,
    model: str | os.PathLike[str] | None = None,
    save_scores: bool = False,
    save_detector: str | os.PathLike[str] | None = None,
    progress: RunProgress | None = None,
) -> Run:
    """Find the loops of a sequence, alone or against a reference traverse, and write the run folder.

    Parameters
    ----------
    source : path
        Folder of images, text file of paths, or video.
    out : path
        Run folder; made if it is absent, its files are replaced.
    reference : path, optional
        The other traverse, or a folder that `LoopDetector.save` wrote.
    config, model
        As for `LoopDetector`.
    save_scores : bool
        Also write ``scores.npy``.
    save_detector : path, optional
        Folder for the detector as it stands after the last frame.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    Run

    Raises
    ------
    LoopClosureError
        If an image, a setting, the weights or the model cannot be used.
    """
    started = time.perf_counter()
    report = progress or (lambda *_: None)
    images = _open(source, config or Config())
    if len(images) < 2:
        raise ImageError(f"{source} holds one image; a loop needs at least two frames")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    _forget_earlier_results(folder)
    detector, reference_images = _make_detector(reference, config, model, report)
    columns = len(images) if detector.one_stream else detector.map_size
    matrix = _Thumbnail(len(images), columns)
    decisions = []
    with _ScoreFile(folder / SCORES, wanted=save_scores) as score_file:
        for decision in detector.detect(images):
            decisions.append(decision)
            matrix.add(decision.query, detector.scores)
            score_file.add(detector.scores)
            report("finding loops", len(decisions), len(images))
        score_file.finish(len(decisions) if detector.one_stream else columns)
    write_loops(folder / LOOPS_FILE, decisions)
    seconds = detector.seconds | {"total": time.perf_counter() - started}
    info = describe_run(detector, seconds) | {
        "source": str(source),
        "reference": None if reference is None else str(reference),
        "frames": len(decisions),
        "references": None if detector.one_stream else columns,
    }
    write_whole(folder / RUN, json.dumps(info, indent=2) + "\n")
    if detector.learned_on:
        detector.save_model(folder / MODEL)
    if save_detector is not None:
        detector.save(save_detector)
    return Run(folder, tuple(decisions), info, matrix.cells, images, images if reference is None else reference_images)


def fit_model(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    config: Config | None = None,
    progress: RunProgress | None = None,
) -> LoopDetector:
    """Fit the method on a sequence and save the model, for ``LoopDetector(model=out)``.

    Parameters
    ----------
    source : path
        Folder of images, text file of paths, or video.
    out : path
        Model folder; made if it is absent.
    config, progress
        As for `detect_loops`.
    """
    report = progress or (lambda *_: None)
    detector = LoopDetector(config, progress=partial(report, "downloading weights"))
    detector.fit(_open(source, detector.config), source=Path(source).name, progress=partial(report, "fitting"))
    detector.save_model(out)
    return detector


def summarise(run: Run) -> dict[str, Any]:
    """Return what a run came to, in a few numbers and words."""
    reasons = Counter(str(decision.reason) for decision in run.decisions)
    return {
        "run": str(run.folder),
        "frames": len(run.decisions),
        "accepted": reasons[Reason.ACCEPTED.value],
        "reasons": dict(reasons),
        "seconds": run.info["seconds"],
        "weights": run.info["weights"],
        "learned_on": run.info["learned_on"],
    }


def write_loops(path: Path, decisions: Iterable[Decision]) -> None:
    """Write ``loops.csv``: one row a frame, in order; match and score are empty where there is no candidate."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(LOOPS_HEADER)
    for item in decisions:
        score = "" if item.score is None else f"{item.score:.6f}"
        writer.writerow([item.query, item.match, score, str(item.accepted).lower(), item.inliers, item.reason])
    write_whole(path, text.getvalue())


def describe_run(detector: LoopDetector, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return what made a result: settings, weights, what was learned on what, versions, machine, time."""
    return {
        "format": 1,
        "loopclosure": __version__,
        "config": detector.config.model_dump(),
        "weights": detector.method.provenance,
        "threshold": detector.threshold,
        "learned_on": detector.learned_on,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "machine": {"system": platform.platform(), "processor": platform.processor(), "cores": os.cpu_count()},
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def write_whole(path: Path, text: str) -> None:
    """Write a text file that appears only when it is whole."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def _make_detector(
    reference: str | os.PathLike[str] | None,
    config: Config | None,
    model: str | os.PathLike[str] | None,
    report: RunProgress,
) -> tuple[LoopDetector, ImageSequence | None]:
    if reference is not None and (Path(reference) / HEADER).is_file():
        if model is not None:
            raise ConfigError(f"{reference} is a saved detector and brings its own model; leave --model out")
        detector = LoopDetector.load(reference)
        detector.use_map_as_reference(config)
        return detector, None
    detector = LoopDetector(config, model=model, progress=partial(report, "downloading weights"))
    if reference is None:
        return detector, None
    images = _open(reference, detector.config)
    detector.set_reference(images, progress=partial(report, "reading the reference"))
    return detector, images


def _open(source: str | os.PathLike[str], config: Config) -> ImageSequence:
    return ImageSequence(source, on_error=config.images.on_error, max_megapixels=config.images.max_megapixels)


def _forget_earlier_results(folder: Path) -> None:
    """Remove what an earlier run into the same folder left, so that nothing beside the new results is stale."""
    for name in _DERIVED:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / MODEL, ignore_errors=True)


class _Thumbnail:
    """The score matrix at a bounded size: the largest score of each cell.

    The length of a video is an estimate, so rows and columns beyond it are dropped here; ``scores.npy`` has them all.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self._step = -(-max(rows, columns) // _THUMBNAIL)
        self.cells = np.full((-(-rows // self._step), -(-columns // self._step)), np.nan, np.float32)

    def add(self, row: int, scores: np.ndarray) -> None:
        if scores.size and row // self._step < len(self.cells):
            largest = np.fmax.reduceat(scores, np.arange(0, scores.size, self._step))[: self.cells.shape[1]]
            cells = self.cells[row // self._step, : largest.size]
            np.fmax(cells, largest, out=cells)


class _ScoreFile:
    """Writes ``scores.npy`` row by row; the file appears when all rows are there."""

    def __init__(self, path: Path, *, wanted: bool) -> None:
        self._path, self._wanted = path, wanted
        self._rows_path, self._part = path.with_name(f"{path.name}.rows"), path.with_name(f"{path.name}.part")
        self._lengths: list[int] = []

    def __enter__(self) -> _ScoreFile:
        self._rows = open(self._rows_path, "wb") if self._wanted else None
        return self

    def add(self, scores: np.ndarray) -> None:
        """Take the next row; in one stream rows grow."""
        if self._rows is not None:
            self._lengths.append(scores.size)
            self._rows.write(scores.astype(np.float32).tobytes())

    def finish(self, columns: int) -> None:
        """Put the rows into one matrix, NaN where a row is shorter."""
        if self._rows is None:
            return
        self._rows.flush()
        shape = (len(self._lengths), columns)
        matrix = np.lib.format.open_memmap(self._part, mode="w+", dtype=np.float32, shape=shape)
        with open(self._rows_path, "rb") as rows:
            for row, length in enumerate(self._lengths):
                matrix[row, :length] = np.frombuffer(rows.read(4 * length), np.float32)
                matrix[row, length:] = np.nan
        matrix.flush()
        os.replace(self._part, self._path)

    def __exit__(self, *_: object) -> None:
        if self._rows is not None:
            self._rows.close()
        for path in (self._rows_path, self._part):
            path.unlink(missing_ok=True)
