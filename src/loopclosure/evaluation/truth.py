"""Which pairs of frames show one place, from any of the forms in which people publish it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.sparse import csr_array

from loopclosure.errors import ConfigError, TruthError
from loopclosure.evaluation.limits import digest
from loopclosure.evaluation.matrices import Cells, read_image, read_mat, read_npy
from loopclosure.evaluation.tables import NanPoses, Poses, check_radius, poses_to_cells, read_text

View = Literal["all", "left", "right"]
NEVER = np.iinfo(np.int64).max
"""Distance to the nearest true match where a query has none."""
# Odd file numbers, counted from 1, are the left camera: even positions.
_VIEWS = {"all": slice(None), "left": slice(0, None, 2), "right": slice(1, None, 2)}
_TEXT = dict.fromkeys((".csv", ".txt", ".tum", ".kitti"), read_text)
_IMAGES = dict.fromkeys((".png", ".bmp", ".gif", ".pgm", ".tif", ".tiff"), read_image)
_READERS: dict[str, Callable[[Path], Cells | Poses]] = {**_TEXT, **_IMAGES, ".npy": read_npy}


@dataclass(frozen=True, eq=False)
class Truth:
    """True and ignored pairs, after view, folding and exclusion.

    Attributes
    ----------
    pairs : scipy.sparse.csr_array of bool, shape (n_queries, n_references)
        True matches of each query.
    ignored : scipy.sparse.csr_array of bool, shape (n_queries, n_references)
        Pairs that count neither way; none of them is in `pairs`.
    one_stream : bool
        Whether queries and references are one sequence; then only earlier frames are matches.
    exclude_recent : int
        In one stream, pairs nearer than this many frames are no pairs; 0 between two traverses.
    form : str
        Kind of file it was read from.
    view : str
        Camera of an interleaved stereo set: ``all``, ``left`` or ``right``.
    radius_m : float or None
        Largest distance of two poses at one place, metres; None for other forms.
    sha256 : str
        Of the file.
    """

    pairs: csr_array
    ignored: csr_array
    one_stream: bool
    exclude_recent: int
    form: str
    view: View
    radius_m: float | None
    sha256: str

    @property
    def n_queries(self) -> int:
        """Number of query frames."""
        return int(self.pairs.shape[0])

    @property
    def n_references(self) -> int:
        """Number of reference frames; in one stream the number of queries."""
        return int(self.pairs.shape[1])

    def matches_per_query(self) -> np.ndarray:
        """Return the number of true matches of each query, int64 (n_queries,)."""
        return np.diff(self.pairs.indptr).astype(np.int64)

    def allows(self, query: np.ndarray, match: np.ndarray) -> np.ndarray:
        """Return whether each pair is a pair at all, that is outside the exclusion band; broadcasts."""
        query, match = np.broadcast_arrays(query, match)
        if not self.one_stream:
            return np.ones(query.shape, dtype=bool)
        return query - match >= max(1, self.exclude_recent)

    def frames_off(self, query: np.ndarray, match: np.ndarray) -> np.ndarray:
        """Return how many frames each match is away from the nearest true match of its query.

        Parameters
        ----------
        query, match : ndarray of int, shape (n,)
            Pairs to judge, inside the matrix.

        Returns
        -------
        ndarray of int64, shape (n,)
            0 where the match is true; `NEVER` where the query has no true match. It serves every tolerance at once.
        """
        keys = _keys(self.pairs)
        if not len(keys):
            return np.full(len(query), NEVER)
        wanted = np.asarray(query, np.int64) * self.n_references + match
        after = np.searchsorted(keys, wanted)
        off = np.full(len(wanted), NEVER)
        for neighbour in (np.maximum(after - 1, 0), np.minimum(after, len(keys) - 1)):
            same_query = keys[neighbour] // self.n_references == query
            off = np.where(same_query, np.minimum(off, np.abs(keys[neighbour] - wanted)), off)
        return off

    def is_ignored(self, query: np.ndarray, match: np.ndarray) -> np.ndarray:
        """Return whether each pair is marked to be ignored, bool (n,)."""
        return np.isin(np.asarray(query, np.int64) * self.n_references + match, _keys(self.ignored))


def load_truth(
    path: str | os.PathLike[str],
    *,
    frames: tuple[int, int | None] | None = None,
    view: View = "all",
    key: str | None = None,
    radius_m: float | None = None,
    exclude_recent: int = 0,
    nan_poses: NanPoses = "error",
) -> Truth:
    """Read a truth file of any form.

    Parameters
    ----------
    path : path
        ``.csv`` with header ``query,match`` (0-based positions) or ``frame,x,y[,z]``; poses as TUM, KITTI or
        ``name x y [z]``; ``.mat``; ``.npy``; an image where 255 = loop, 0 = none and one grey value = ignore.
    frames : tuple of n_queries and n_references, optional
        Size of the results that are judged, checked against the file. ``(n, None)`` is one stream: a match is an
        earlier frame of the same sequence, and a lower, upper or symmetric matrix is folded to the lower triangle.
        ``(n, m)`` are two traverses: queries x references as they are. None is one stream of the size of the file.
    view : {'all', 'left', 'right'}
        One camera of an interleaved stereo set: ``truth[::2, ::2]`` or ``truth[1::2, 1::2]``.
    key : str, optional
        Name of the matrix in a ``.mat`` file that holds several.
    radius_m : float, optional
        Needed for poses and for them alone: frames within this distance are one place, metres.
    exclude_recent : int
        In one stream, pairs with ``query - match < exclude_recent`` are no pairs.
    nan_poses : {'error', 'ignore'}
        What to do with frames whose pose is not finite.

    Returns
    -------
    Truth

    Raises
    ------
    TruthError
        If the file is damaged, ambiguous, or of another size than the results.
    ConfigError
        If a setting is out of range or has no meaning for this file.
    """
    _check_settings(view, exclude_recent, nan_poses, frames)
    file = Path(path)
    sha256 = digest(file)
    reading = _read(file, key)
    one_stream = frames is None or frames[1] is None
    if isinstance(reading, Poses):
        if not one_stream:
            raise TruthError(f"{file} holds the poses of one stream; two traverses want pairs or a matrix")
        radius_m = check_radius(radius_m)
        cells = poses_to_cells(
            file, reading, view=_VIEWS[view], radius_m=radius_m, exclude_recent=exclude_recent, nan_poses=nan_poses
        )
    elif radius_m is not None:
        raise ConfigError(f"a radius was given, but {file} holds no poses")
    else:
        cells = _one_camera(reading, _VIEWS[view])
    size = _check_size(file, cells, frames)
    true, ignored = (_sorted_keys(pairs, size[1]) for pairs in (cells.true, cells.ignored))
    if one_stream:
        true, ignored = _fold(file, true, size[0]), _lower(ignored, size[0])
        true, ignored = (_outside_band(keys, size[0], exclude_recent) for keys in (true, ignored))
    return Truth(
        pairs=_matrix(true, size),
        ignored=_matrix(np.setdiff1d(ignored, true, assume_unique=True), size),
        one_stream=one_stream,
        exclude_recent=exclude_recent,
        form=cells.form,
        view=view,
        radius_m=radius_m,
        sha256=sha256,
    )


def _check_settings(view: str, exclude_recent: int, nan_poses: str, frames: tuple[int, int | None] | None) -> None:
    if view not in _VIEWS:
        raise ConfigError(f"view is '{view}', wanted one of {', '.join(_VIEWS)}")
    if nan_poses not in get_args(NanPoses):
        raise ConfigError(f"nan_poses is '{nan_poses}', wanted error or ignore")
    if exclude_recent < 0:
        raise ConfigError(f"exclude_recent is {exclude_recent}, wanted 0 or more frames")
    if exclude_recent and frames is not None and frames[1] is not None:
        raise ConfigError(f"exclude_recent is {exclude_recent}, but there is no exclusion band between two traverses")


def _read(file: Path, key: str | None) -> Cells | Poses:
    suffix = file.suffix.lower()
    if suffix == ".mat":
        return read_mat(file, key)
    if key is not None:
        raise ConfigError(f"a key was given, but {file} is no .mat file")
    if suffix not in _READERS:
        known = ", ".join(sorted([*_READERS, ".mat"]))
        hint = ": a JPEG blurs the three values, save a PNG" if suffix in (".jpg", ".jpeg") else ""
        raise TruthError(f"{file} is of type '{suffix}', wanted one of {known}{hint}")
    return _READERS[suffix](file)


def _one_camera(cells: Cells, view: slice) -> Cells:
    if view.step is None:
        return cells
    first = view.start

    def taken(pairs: np.ndarray) -> np.ndarray:
        return pairs[:, (pairs % 2 == first).all(axis=0)] // 2

    shape = cells.shape and tuple(len(range(*view.indices(side))) for side in cells.shape)
    return Cells(cells.form, shape, taken(cells.true), taken(cells.ignored))  # type: ignore[arg-type]


def _check_size(file: Path, cells: Cells, frames: tuple[int, int | None] | None) -> tuple[int, int]:
    """Return queries and references, after checking that the file and the results agree on them."""
    reach = tuple(int(side) + 1 for side in cells.true.max(axis=1, initial=-1))
    if frames is None:
        size = cells.shape or (max(reach), max(reach))
        if size[0] != size[1]:
            raise TruthError(f"{file} is {size[0]} x {size[1]}, wanted a square: is it the truth of two traverses?")
        return size
    size = (frames[0], frames[0] if frames[1] is None else frames[1])
    if cells.shape is None:
        for found, wanted, axis in zip(reach, size, ("query", "match"), strict=True):
            if found > wanted:
                cause = "does it count from 1?" if found == wanted + 1 else _cause((found, found), (wanted, wanted))
                raise TruthError(f"{file} holds {axis} {found - 1}, wanted at most {wanted - 1}: {cause}")
        return size
    if cells.shape != size:
        raise TruthError(
            f"{file} is {cells.shape[0]} x {cells.shape[1]} (queries x references), "
            f"the results are {size[0]} x {size[1]}: {_cause(cells.shape, size)}"
        )
    return size


def _cause(found: tuple[int, int], wanted: tuple[int, int]) -> str:
    if found == wanted[::-1]:
        return "is it transposed?"
    if all(abs(f - 2 * w) <= 1 for f, w in zip(found, wanted, strict=True)):
        return "does it hold both cameras of a stereo set? choose one with --view left or right"
    if all(abs(2 * f - w) <= 1 for f, w in zip(found, wanted, strict=True)):
        return "is it for one camera, and the results for both?"
    if found[0] != found[1] and wanted[0] == wanted[1]:
        return "is it the truth of two traverses?"
    return "was it made for other images, or were images left out?"


def _sorted_keys(pairs: np.ndarray, references: int) -> np.ndarray:
    return _distinct(pairs[0].astype(np.int64) * references + pairs[1])


def _fold(file: Path, keys: np.ndarray, n: int) -> np.ndarray:
    """Return lower-triangular keys of a lower, upper or symmetric truth; the diagonal falls away."""
    query, match = np.divmod(keys, n)
    lower, upper = keys[query > match], np.sort((match * n + query)[query < match])
    if len(lower) and len(upper) and not np.array_equal(lower, upper):
        raise TruthError(
            f"{file} is neither triangular nor symmetric ({len(lower)} pairs below the diagonal, {len(upper)} above): "
            "is it the truth of two traverses?"
        )
    return lower if len(lower) else upper


def _lower(keys: np.ndarray, n: int) -> np.ndarray:
    query, match = np.divmod(keys, n)
    return _distinct(np.maximum(query, match) * n + np.minimum(query, match))


def _outside_band(keys: np.ndarray, n: int, exclude_recent: int) -> np.ndarray:
    query, match = np.divmod(keys, n)
    return keys[query - match >= max(1, exclude_recent)]


def _distinct(keys: np.ndarray) -> np.ndarray:
    keys = np.sort(keys, kind="stable")  # keys come nearly sorted; `np.unique` would hash them, at ten times the cost
    return keys[np.diff(keys, prepend=-1) > 0]


def _matrix(keys: np.ndarray, size: tuple[int, int]) -> csr_array:
    starts = np.searchsorted(keys, np.arange(size[0] + 1, dtype=np.int64) * size[1])
    return csr_array((np.ones(len(keys), dtype=bool), keys % size[1], starts), shape=size)


def _keys(matrix: csr_array) -> np.ndarray:
    rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int64), np.diff(matrix.indptr))
    return rows * matrix.shape[1] + matrix.indices
