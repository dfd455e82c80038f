"""Truth matrices: ``.mat``, ``.npy`` and images. Every reader returns the cells that say something, as pairs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from loopclosure.errors import TruthError, did_you_mean
from loopclosure.evaluation import matfile
from loopclosure.evaluation.limits import cells_as_pairs, check_count, check_shape

_LOOP = 255


class Cells(NamedTuple):
    """A truth matrix as the positions of its true and of its ignored cells.

    Attributes
    ----------
    form : str
        Which kind of file it came from.
    shape : tuple of two ints, or None
        Queries x references; None where the file does not say.
    true, ignored : ndarray of int32, shape (2, n)
        Rows are queries (first) and matches (second).
    """

    form: str
    shape: tuple[int, int] | None
    true: np.ndarray
    ignored: np.ndarray


def read_mat(file: Path, key: str | None) -> Cells:
    """Read the only matrix of a MATLAB file, or the one named `key`."""
    with file.open("rb") as stream:
        head = stream.read(10)
    if head == b"MATLAB 7.3" or head.startswith(b"\x89HDF"):
        raise TruthError(
            f"{file} is a MATLAB 7.3 (HDF5) file, wanted version 7 or older: save it again in MATLAB, save(..., '-v7')"
        )
    found = _parsed(file, "MATLAB file", lambda: matfile.entries(file))
    matrices = {entry.name: entry for entry in found if len(entry.shape) == 2 and 1 not in entry.shape}
    entry = matrices[_choose(file, sorted(matrices), key)]
    shape = check_shape(file, entry.shape, entry.cell_bytes)
    rows, columns, value = _parsed(file, "MATLAB file", lambda: matfile.nonzero_cells(file, entry))
    return _levels(file, ".mat", shape, (rows, columns), value)


def read_npy(file: Path) -> Cells:
    """Read a ``.npy`` matrix; its size is checked against the file before a cell is read, and pickles are refused."""
    matrix = _parsed(file, ".npy matrix", lambda: np.load(file, mmap_mode="r", allow_pickle=False))
    if not isinstance(matrix, np.ndarray) or matrix.dtype.kind not in "biuf":
        found = f"cells of type {matrix.dtype}" if isinstance(matrix, np.ndarray) else "several arrays (.npz)"
        raise TruthError(f"{file} holds {found}, wanted one matrix of numbers")
    check_shape(file, matrix.shape, matrix.dtype.itemsize)
    return _dense(file, ".npy", np.asarray(matrix))


def read_image(file: Path) -> Cells:
    """Read a grey image where 255 is a loop, 0 is none, and one grey value between means ignore."""
    colours = _parsed(file, "truth image", lambda: _pixels(file))
    grey = colours if colours.ndim == 2 else colours[..., 0]
    if colours.ndim == 3 and (colours != grey[..., None]).any():
        raise TruthError(f"{file} is coloured, wanted grey: 255 = loop, 0 = none, one grey value = ignore")
    return _dense(file, "image", grey)


def _choose(file: Path, names: list[str], key: str | None) -> str:
    if key is not None:
        if key not in names:
            raise TruthError(
                f"{file} holds no matrix '{key}'{did_you_mean(key, names)}; it holds {', '.join(names) or 'none'}"
            )
        return key
    if not names:
        raise TruthError(f"{file} holds no 2-D matrix of numbers")
    if len(names) > 1:
        raise TruthError(f"{file} holds {len(names)} matrices ({', '.join(names)}): choose one with --key")
    return names[0]


def _parsed(file: Path, kind: str, parse: Callable[[], Any]) -> Any:
    """Call a parser; a damaged file makes it raise nearly anything."""
    try:
        return parse()
    except TruthError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise TruthError(f"{file} is no readable {kind}: {reason}") from error


def _pixels(file: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(file, formats=("PNG", "BMP", "GIF", "PPM", "TIFF")) as image:
            check_shape(file, (image.height, image.width), 4)
            if image.mode not in ("1", "L", "P", "RGB", "RGBA"):
                raise TruthError(f"{file} has pixels of mode {image.mode}, wanted 8-bit grey")
            return np.asarray(image if image.mode == "L" else image.convert("RGB"))


def _dense(file: Path, form: str, matrix: np.ndarray) -> Cells:
    rows, columns = np.nonzero(matrix)
    return _levels(file, form, (matrix.shape[0], matrix.shape[1]), (rows, columns), matrix[rows, columns])


def _levels(
    file: Path, form: str, shape: tuple[int, int], where: tuple[np.ndarray, np.ndarray], value: np.ndarray
) -> Cells:
    """Sort the cells that are not 0: loops (1, or 255 beside one grey value) and cells to ignore."""
    check_count(file, len(value))
    levels = np.unique(value)
    loop = 1 if form != "image" and list(levels) == [1] else _LOOP
    grey = [level for level in levels if level != loop]
    if len(grey) > 1 or any(not 0 < level < _LOOP for level in grey):
        raise TruthError(
            f"{file} holds {len(levels)} values other than 0, such as {', '.join(f'{v:g}' for v in levels[:3])}; "
            "wanted 0 and 1, or 255 = loop and one grey value = ignore: is it a matrix of distances, or a JPEG?"
        )
    is_loop = value == loop
    if not is_loop.any():
        wanted = "255" if form == "image" else "1, or 255 where a grey value means ignore"
        raise TruthError(f"{file} holds no loop, wanted cells of {wanted}: is it the right matrix?")
    rows, columns = where
    return Cells(
        form,
        shape,
        true=cells_as_pairs(rows[is_loop], columns[is_loop]),
        ignored=cells_as_pairs(rows[~is_loop], columns[~is_loop]),
    )
