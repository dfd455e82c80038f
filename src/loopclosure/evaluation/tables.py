"""Truth as text: lists of pairs, and poses as CSV, TUM, KITTI or named positions."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from loopclosure.errors import ConfigError, TruthError
from loopclosure.evaluation.limits import MAX_FRAMES, MAX_TEXT_BYTES, cells_as_pairs, check_count
from loopclosure.evaluation.matrices import Cells

NanPoses = Literal["error", "ignore"]
_KITTI_TRANSLATION = (3, 7, 11)
_SHOWN = 3


class Poses(NamedTuple):
    """Where each frame was taken.

    Attributes
    ----------
    form : str
        Which kind of file it came from.
    positions : ndarray of float64, shape (n, 2) or (n, 3)
        Metres.
    """

    form: str
    positions: np.ndarray


def read_text(file: Path) -> Cells | Poses:
    """Read pairs or poses; the header, or the number of columns, says which."""
    lines = [line for line in _text(file).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise TruthError(f"{file} is empty, wanted pairs under the header query,match, or poses")
    if "," not in lines[0]:
        return _plain_poses(file, lines)
    header = [name.strip().lower() for name in lines[0].split(",")]
    if header == ["query", "match"]:
        return _pairs(file, lines[1:])
    if header[:3] == ["frame", "x", "y"]:
        return _csv_poses(file, lines[1:], dimensions=3 if header[3:4] == ["z"] else 2, columns=len(header))
    raise TruthError(f"{file} has the header {','.join(header)[:80]!r}, wanted query,match or frame,x,y[,z]")


def poses_to_cells(
    file: Path, poses: Poses, *, view: slice, radius_m: float, exclude_recent: int, nan_poses: NanPoses
) -> Cells:
    """Return the pairs of frames within `radius_m` of each other that are at least `exclude_recent` frames apart."""
    positions = poses.positions[view]
    n = len(positions)
    lost = ~np.isfinite(positions).all(axis=1)
    if lost.any() and nan_poses == "error":
        some = ", ".join(str(row) for row in np.flatnonzero(lost)[:_SHOWN]) + " ..." * int(lost.sum() > _SHOWN)
        raise TruthError(
            f"{file}: the poses of {lost.sum()} of {n} frames are not finite (frames {some}); "
            "wanted a number in each, or nan_poses='ignore' to leave these frames out"
        )
    known = np.flatnonzero(~lost)
    tree = cKDTree(positions[known])
    check_count(file, (int(tree.count_neighbors(tree, radius_m)) - len(known)) // 2)
    near = known[tree.query_pairs(radius_m, output_type="ndarray")].reshape(-1, 2)
    late, early = near.max(axis=1), near.min(axis=1)
    far_in_time = late - early >= exclude_recent
    check_count(file, int(lost.sum()) * n)
    lost_rows, others = np.repeat(np.flatnonzero(lost), n), np.tile(np.arange(n), lost.sum())
    return Cells(
        poses.form,
        (n, n),
        true=cells_as_pairs(late[far_in_time], early[far_in_time]),
        ignored=cells_as_pairs(np.maximum(lost_rows, others), np.minimum(lost_rows, others)),
    )


def _text(file: Path) -> str:
    try:
        if file.stat().st_size > MAX_TEXT_BYTES:
            raise TruthError(f"{file} is larger than {MAX_TEXT_BYTES >> 20} MiB: it is no list of pairs or poses")
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise TruthError(f"{file} is not text, wanted pairs or poses") from None


def _numbers(file: Path, lines: list[str], delimiter: str | None, columns: range | None = None) -> np.ndarray:
    try:
        return np.loadtxt(io.StringIO("\n".join(lines)), delimiter=delimiter, usecols=columns, ndmin=2)
    except ValueError as error:
        raise TruthError(f"{file} (comments, empty lines and header not counted): {error}") from None


def _pairs(file: Path, lines: list[str]) -> Cells:
    if not lines:
        raise TruthError(f"{file} holds no pair under its header: a truth without loops says nothing of recall")
    check_count(file, len(lines))
    table = _numbers(file, lines, ",")
    if table.shape[1] != 2:
        raise TruthError(f"{file} has {table.shape[1]} numbers a row, wanted 2: query,match")
    bad = ~((table >= 0) & (table < MAX_FRAMES) & (table == np.floor(table))).all(axis=1)
    if bad.any():
        query, match = table[np.argmax(bad)]
        raise TruthError(f"{file} holds the pair {query:g},{match:g}, wanted whole positions, 0 to {MAX_FRAMES - 1}")
    pairs = table.astype(np.int64)
    seen, counts = np.unique(pairs[:, 0] * MAX_FRAMES + pairs[:, 1], return_counts=True)
    if (counts > 1).any():
        query, match = divmod(int(seen[np.argmax(counts > 1)]), MAX_FRAMES)
        raise TruthError(f"{file} holds {(counts > 1).sum()} pairs more than once, such as {query},{match}")
    return Cells("pairs", None, true=cells_as_pairs(*pairs.T), ignored=np.empty((2, 0), np.int32))


def _csv_poses(file: Path, lines: list[str], *, dimensions: int, columns: int) -> Poses:
    if not lines:
        raise TruthError(f"{file} holds no pose under its header")
    if any(line.count(",") != columns - 1 for line in lines):
        row = next(row for row, line in enumerate(lines) if line.count(",") != columns - 1)
        raise TruthError(f"{file}, pose {row}: {lines[row].count(',') + 1} cells under {columns} columns")
    table = _numbers(file, lines, ",", range(dimensions + 1))
    wrong = table[:, 0] != np.arange(len(table))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise TruthError(
            f"{file}: row {row} is frame {table[row, 0]:g}, wanted {row}: one row a frame, in order, from 0"
        )
    return _bounded(file, Poses("poses csv", table[:, 1:]))


def _plain_poses(file: Path, lines: list[str]) -> Poses:
    columns = len(lines[0].split())
    if columns in (3, 4):
        return _named_poses(file, lines, columns)
    if columns not in (8, 12):
        raise TruthError(
            f"{file} has {columns} columns, wanted the header query,match or frame,x,y[,z], "
            "or 8 columns (TUM), 12 (KITTI), 3 or 4 (name x y [z])"
        )
    table = _numbers(file, lines, None)
    if columns == 12:
        return _bounded(file, Poses("poses kitti", table[:, _KITTI_TRANSLATION]))
    _check_rising(file, table[:, 0], "timestamp")
    return _bounded(file, Poses("poses tum", table[:, 1:4]))


def _named_poses(file: Path, lines: list[str], columns: int) -> Poses:
    """Read rows such as ``0001.jpg 1.5 2.5``; the number in the name orders them."""
    cells = [line.split() for line in lines]
    for row, line in enumerate(cells):
        if len(line) != columns or not re.search(r"\d", line[0]):
            raise TruthError(f"{file}: row {row} is {' '.join(line)[:60]!r}, wanted {columns} columns: frame x y [z]")
    numbers = [float(re.findall(r"\d{1,15}", line[0])[-1]) for line in cells]
    _check_rising(file, np.array(numbers), "frame", step=1)
    return _bounded(file, Poses("poses named", _numbers(file, [" ".join(line[1:]) for line in cells], None)))


def _check_rising(file: Path, values: np.ndarray, name: str, step: float | None = None) -> None:
    rise = np.diff(values)
    wrong = ~(rise > 0) if step is None else rise != step
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        wanted = "rows in order" if step is None else "every frame, in order"
        raise TruthError(
            f"{file}: row {row} has {name} {values[row]:.15g} after {values[row - 1]:.15g}, wanted {wanted}"
        )


def _bounded(file: Path, poses: Poses) -> Poses:
    if len(poses.positions) > MAX_FRAMES:
        raise TruthError(f"{file} holds {len(poses.positions)} poses, wanted at most {MAX_FRAMES}")
    return poses


def check_radius(radius_m: float | None) -> float:
    """Return the radius within which two poses are one place; it has no default because every data set has its own."""
    if radius_m is None or not 0 < radius_m < float("inf"):
        raise ConfigError(
            f"radius is {radius_m}, wanted metres above 0: poses become truth by --radius and --exclude-recent"
        )
    return float(radius_m)
