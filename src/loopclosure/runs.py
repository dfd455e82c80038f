"""A run: the loops of a whole sequence, and the folder that holds them."""

from __future__ import annotations

import json
import logging
import os
import platform
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
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
from loopclosure.images.sequence import ImageSequence
from loopclosure.records import Decision, Reason
from loopclosure.runfiles import (
    SCORES,
    Checkpoint,
    LoopFile,
    RunState,
    ScoreFile,
    Stopped,
    run_identity,
    stop_between_frames,
)
from loopclosure.store import HEADER

RUN, MODEL = "run.json", "model"
_DERIVED = (SCORES, "metrics.json", "precision_recall.png", "report.html")  # of results that are about to be replaced
_PACKAGES = ("numpy", "opencv-python-headless", "openvino", "scikit-learn", "torch", "torchvision")
_log = logging.getLogger(__name__)

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
    resume: bool = False,
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
    resume : bool
        Go on with the run in `out` that was interrupted: with the same arguments it ends as if nothing had happened.
        Ctrl-C and errors save the state after the last whole frame; a run that was killed goes on from a state that is
        about a minute old, and one that has none yet begins again.
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
    report = progress or (lambda *_: None)
    images = _open(source, config or Config())
    if len(images) < 2:
        raise ImageError(f"{source} holds one image; a loop needs at least two frames")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = Checkpoint(folder, run_identity(source, reference, config, save_scores=save_scores))
    if resume:
        state = checkpoint.load(images)
    else:
        _forget_earlier_results(folder)
        checkpoint.remove()
        state = None
    if state is None:
        state = RunState(_make_detector(reference, config, model, report), len(images))
    detector = state.detector
    with (
        LoopFile(folder, keep=detector.frames) as loops,
        ScoreFile(folder, state.lengths, wanted=save_scores) as scores,
    ):
        _go_through(images, state, loops, scores, checkpoint, report)
        scores.finish(len(loops.decisions) if detector.one_stream else detector.map_size)
        loops.finish()
    info = describe_run(detector, state.seconds) | {
        "source": str(source),
        "reference": None if reference is None else str(reference),
        "frames": len(loops.decisions),
        "references": None if detector.one_stream else detector.map_size,
    }
    write_whole(folder / RUN, json.dumps(info, indent=2) + "\n")
    if detector.learned_on:
        detector.save_model(folder / MODEL)
    if save_detector is not None:
        detector.save(save_detector)
    checkpoint.remove()
    others = images if reference is None else None if _is_detector(reference) else _open(reference, detector.config)
    return Run(folder, tuple(loops.decisions), info, state.matrix.cells, images, others)


def _go_through(
    images: ImageSequence,
    state: RunState,
    loops: LoopFile,
    scores: ScoreFile,
    checkpoint: Checkpoint,
    report: RunProgress,
) -> None:
    """Decide the frames that are left; save the state now and then, and where something comes between two frames."""
    detector = state.detector
    try:
        with stop_between_frames() as stop_if_asked:
            for decision in detector.detect(images.after(detector.frames)):
                state.matrix.add(decision.query, detector.scores)
                scores.add(detector.scores)
                loops.add(decision)
                report("finding loops", len(loops.decisions), len(images))
                stop_if_asked()
                if checkpoint.due():
                    scores.flush()
                    checkpoint.save(state, images)
    except (Exception, Stopped) as error:
        if 0 < detector.frames == len(loops.decisions):  # else a frame is half done, and the last state counts
            scores.flush()
            checkpoint.save(state, images)
            level = logging.WARNING if isinstance(error, Stopped) else logging.INFO  # an error speaks for itself
            _log.log(level, "stopped after %d frames; `detect --resume` goes on from there", detector.frames)
        raise


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


def describe_run(detector: LoopDetector, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return what made a result: settings, weights, what was learned on what, versions, machine, time."""
    return {
        "format": 1,
        "loopclosure": __version__,
        "config": detector.config.model_dump(),
        "weights": detector.method.provenance,
        "threshold": detector.threshold,
        "calibrated": detector.method.calibrated,
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
) -> LoopDetector:
    if reference is not None and _is_detector(reference):
        if model is not None:
            raise ConfigError(f"{reference} is a saved detector and brings its own model; leave --model out")
        detector = LoopDetector.load(reference)
        detector.use_map_as_reference(config)
        return detector
    detector = LoopDetector(config, model=model, progress=partial(report, "downloading weights"))
    if reference is not None:
        detector.set_reference(_open(reference, detector.config), progress=partial(report, "reading the reference"))
    return detector


def _is_detector(reference: str | os.PathLike[str]) -> bool:
    return (Path(reference) / HEADER).is_file()


def _open(source: str | os.PathLike[str], config: Config) -> ImageSequence:
    return ImageSequence(source, on_error=config.images.on_error, max_megapixels=config.images.max_megapixels)


def _forget_earlier_results(folder: Path) -> None:
    """Remove what an earlier run into the same folder left, so that nothing beside the new results is stale."""
    for name in _DERIVED:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / MODEL, ignore_errors=True)
