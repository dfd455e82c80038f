"""A run folder, or a CSV file of loops, against a truth file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from loopclosure.errors import ResultsError
from loopclosure.evaluation.log import LOOPS_FILE, read_loops
from loopclosure.evaluation.protocol import Evaluation, Level, evaluate
from loopclosure.evaluation.tables import NanPoses
from loopclosure.evaluation.truth import View, load_truth

RUN_FILE = "run.json"
MAX_RUN_BYTES = 1 << 26


def evaluate_run(
    run: str | os.PathLike[str],
    truth_path: str | os.PathLike[str],
    *,
    tolerance: int,
    view: View = "all",
    key: str | None = None,
    radius_m: float | None = None,
    exclude_recent: int | None = None,
    nan_poses: NanPoses = "error",
    references: int | None = None,
    level: Level = "row",
    bootstrap: int = 1000,
    seed: int = 0,
) -> Evaluation:
    """Measure a run folder, or a CSV file of loops, against a truth file.

    Parameters
    ----------
    run : path
        What `read_loops` reads. ``run.json`` beside its ``loops.csv`` says whether the run is one stream or has
        references, and how wide its exclusion band was.
    truth_path : path
        What `load_truth` reads.
    references : int, optional
        Number of reference frames of a run of two traverses, where ``run.json`` does not say it.
    exclude_recent : int, optional
        Exclusion band of one stream, frames; default that of the run, or 0 for a CSV file.
    tolerance, level, bootstrap, seed
        See `evaluate`.
    view, key, radius_m, nan_poses
        See `load_truth`.

    Returns
    -------
    Evaluation

    Raises
    ------
    ResultsError
        If the run or the truth cannot be read, or they do not belong together.
    """
    log = read_loops(run)
    known_references, band = _run_facts(Path(run), len(log))
    if references is None:
        references = known_references
    elif known_references not in (None, references):
        raise ResultsError(f"{run} has {known_references} reference frames, but {references} were asked for")
    if exclude_recent is None:
        exclude_recent = band if references is None else 0
    truth = load_truth(
        truth_path,
        frames=(len(log), references),
        view=view,
        key=key,
        radius_m=radius_m,
        exclude_recent=exclude_recent,
        nan_poses=nan_poses,
    )
    return evaluate(log, truth, tolerance=tolerance, level=level, bootstrap=bootstrap, seed=seed)


def _run_facts(run: Path, rows: int) -> tuple[int | None, int]:
    """Return the number of references (None in one stream) and the exclusion band that ``run.json`` tells."""
    folder = run.parent if run.name == LOOPS_FILE else run
    file = folder / RUN_FILE
    if not file.is_file():
        return None, 0
    try:
        if file.stat().st_size > MAX_RUN_BYTES:
            raise ResultsError(f"{file} is larger than {MAX_RUN_BYTES} bytes: it is not ours")
        facts = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ResultsError(f"{file} is not readable JSON: {error}") from None
    if not isinstance(facts, dict):
        raise ResultsError(f"{file} holds {type(facts).__name__}, wanted an object")
    frames, references = (_count(file, facts, name) for name in ("frames", "references"))
    if frames not in (None, rows):
        raise ResultsError(f"{file} tells of {frames} frames, the log has {rows} rows: did the run end early?")
    config = facts.get("config")
    sequence = config.get("sequence") if isinstance(config, dict) else None
    band = _count(file, sequence, "exclude_recent") if isinstance(sequence, dict) else None
    return references, band or 0


def _count(file: Path, facts: dict[str, Any], name: str) -> int | None:
    value = facts.get(name)
    if value is None or (type(value) is int and value >= 0):
        return value
    raise ResultsError(f"{file}: {name} is {value!r}, wanted a number of frames")
