"""The log of a run: what a detector said of every frame."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.errors import ResultsError
from loopclosure.records import Decision

LOOPS_FILE = "loops.csv"
LOOPS_HEADER = ("query", "match", "score", "accepted", "inliers", "reason")
"""Columns of ``loops.csv``, in order; the first three are enough to be read."""
MAX_LOG_BYTES = 1 << 26
NONE = -1
"""Stands in `LoopLog.match` and `LoopLog.inliers` where there is none."""
_MAX_WHOLE = 1 << 31
_TRUTH_WORDS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(frozen=True, eq=False)
class LoopLog:
    """One row a frame, in the order of the sequence: row i speaks of frame i.

    Attributes
    ----------
    match : ndarray of int64, shape (n,)
        Best candidate of each frame, accepted or not; -1 where there is none.
    score : ndarray of float64, shape (n,)
        Its similarity, larger = more alike; NaN where there is no candidate.
    accepted : ndarray of bool, shape (n,)
        Whether it was reported as a loop.
    inliers : ndarray of int64, shape (n,)
        Matches that agree with one camera motion; -1 where geometry was not asked.
    reason : tuple of str
        Why; empty text where the log does not say.

    Raises
    ------
    ResultsError
        If a row contradicts itself: a match without a score, an accepted row without a match.
    """

    match: np.ndarray
    score: np.ndarray
    accepted: np.ndarray
    inliers: np.ndarray
    reason: tuple[str, ...]

    def __post_init__(self) -> None:
        has = self.match >= 0
        self._refuse((self.match < NONE), "a negative match, wanted a 0-based position")
        self._refuse(has & ~np.isfinite(self.score), "a match without a finite score")
        self._refuse(~has & ~np.isnan(self.score), "a score without a match")
        self._refuse(self.accepted & ~has, "is accepted, but has no match")

    def __len__(self) -> int:
        return len(self.match)

    def _refuse(self, bad: np.ndarray, what: str) -> None:
        if bad.any():
            raise ResultsError(f"frame {int(np.argmax(bad))} of the log: {what}")

    @classmethod
    def from_decisions(cls, decisions: Iterable[Decision]) -> LoopLog:
        """Collect the decisions of a detector, one a frame, in order.

        Examples
        --------
        >>> from loopclosure.records import Reason
        >>> log = LoopLog.from_decisions([Decision(0, None, None, False, None, Reason.TOO_RECENT)])
        >>> len(log), log.match.tolist()
        (1, [-1])
        """
        rows = list(decisions)
        _check_order([decision.query for decision in rows], "the decisions")
        return cls(
            match=np.array([NONE if d.match is None else d.match for d in rows], dtype=np.int64),
            score=np.array([math.nan if d.score is None else d.score for d in rows], dtype=np.float64),
            accepted=np.array([d.accepted for d in rows], dtype=bool),
            inliers=np.array([NONE if d.inliers is None else d.inliers for d in rows], dtype=np.int64),
            reason=tuple(str(d.reason) for d in rows),
        )


def read_loops(path: str | os.PathLike[str]) -> LoopLog:
    """Read ``loops.csv``, or the run folder that holds it.

    Parameters
    ----------
    path : path
        A run folder, or a CSV file with the columns ``query,match,score`` and, where they are known,
        ``accepted,inliers,reason``. One row a frame, queries 0, 1, 2 ...; match and score are empty where there is
        no candidate. Without the column ``accepted`` every row with a match counts as accepted.

    Returns
    -------
    LoopLog

    Raises
    ------
    ResultsError
        If the file is missing or malformed; the message names the line.
    """
    file = Path(path) / LOOPS_FILE if Path(path).is_dir() else Path(path)
    header, lines = _read_csv(file)
    missing = [name for name in LOOPS_HEADER[:3] if name not in header]
    if missing:
        raise ResultsError(
            f"{file} has the columns {','.join(header)!r}, wanted at least query,match,score: is it a run log?"
        )
    columns = {name: [_cell(file, header, number, line, name) for number, line in lines] for name in LOOPS_HEADER}
    numbers = [number for number, _ in lines]
    _check_order(_parse(file, numbers, columns["query"], "query", _whole, NONE), str(file))
    match = np.array(_parse(file, numbers, columns["match"], "match", _whole, NONE), dtype=np.int64)
    if "accepted" in header:
        accepted = np.array(_parse(file, numbers, columns["accepted"], "accepted", _truth_word, False), dtype=bool)
    else:
        accepted = match >= 0
    try:
        return LoopLog(
            match=match,
            score=np.array(_parse(file, numbers, columns["score"], "score", float, math.nan), dtype=np.float64),
            accepted=accepted,
            inliers=np.array(_parse(file, numbers, columns["inliers"], "inliers", _whole, NONE), dtype=np.int64),
            reason=tuple(columns["reason"]),
        )
    except ResultsError as error:
        raise ResultsError(f"{file}: {error}") from None


def _read_csv(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header and the numbered lines below it."""
    try:
        if file.stat().st_size > MAX_LOG_BYTES:
            raise ResultsError(f"{file} is larger than {MAX_LOG_BYTES} bytes: it is no run log")
        reader = csv.reader(io.StringIO(file.read_text(encoding="utf-8-sig"), newline=""))
        lines = [(reader.line_num, [cell.strip() for cell in line]) for line in reader if line]
    except OSError as error:
        raise ResultsError(f"cannot read the run log {file}: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ResultsError(f"{file} is not a CSV file: {error}") from None
    if not lines:
        raise ResultsError(f"{file} is empty, wanted the header {','.join(LOOPS_HEADER)}")
    return lines[0][1], lines[1:]


def _cell(file: Path, header: list[str], number: int, line: list[str], name: str) -> str:
    if len(line) != len(header):
        raise ResultsError(f"{file}, line {number}: {len(line)} cells under {len(header)} columns")
    return line[header.index(name)] if name in header else ""


def _parse(
    file: Path, numbers: list[int], cells: list[str], name: str, convert: Callable[[str], Any], empty: Any
) -> list:
    """Convert one column; an empty cell becomes `empty`."""
    values = []
    for number, cell in zip(numbers, cells, strict=True):
        try:
            values.append(convert(cell) if cell else empty)
        except (ValueError, KeyError):
            raise ResultsError(f"{file}, line {number}: {name} is {cell!r}") from None
    return values


def _whole(cell: str) -> int:
    value = int(cell)
    if not 0 <= value < _MAX_WHOLE:
        raise ValueError(cell)
    return value


def _truth_word(cell: str) -> bool:
    return _TRUTH_WORDS[cell.lower()]


def _check_order(queries: list[int], where: str) -> None:
    for position, query in enumerate(queries):
        if query != position:
            raise ResultsError(
                f"{where}: row {position} speaks of frame {query}, wanted {position}: "
                "one row a frame in order, match and score empty where there is no candidate"
            )
