"""Thumbnails compared by correlation after sideways shifts: all shifts against all places in one matrix product."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from loopclosure.aggregation.netvlad import unit
from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.thumbnails import low_frequencies
from loopclosure.matching.standard import standard_deviations

_BLOCK = 1024  # frames; memory grows block by block, and nothing that is stored is ever copied


class CorrelationMap:
    """Patch-normalised thumbnails of all frames so far.

    A thumbnail is stored by its low frequencies as a unit vector in half precision (bfloat16), because to compare a
    frame with thousands of places is to read them all from memory. The frame is moved sideways by each shift, and what
    is left of it multiplied with every place. From the products of a shift their mean over the candidates is taken
    out: what all of them have in common with one view, the rim of a fisheye image say, must not choose the shift. The
    largest of a place counts, in standard deviations over the candidates.

    Parameters
    ----------
    shifts : sequence of int
        Pixels by which a new frame is moved to the left; less than the width.
    exclude_recent : int
        In one stream, frames nearer than this are no candidates; 0 for another traverse.

    Examples
    --------
    >>> thumbnails = np.random.default_rng(0).normal(size=(3, 8, 16)).astype(np.float32)
    >>> places = CorrelationMap()
    >>> for thumbnail in thumbnails:
    ...     places.add(thumbnail)
    >>> int(places.similarities(thumbnails[1]).argmax())
    1
    """

    def __init__(self, *, shifts: Sequence[int] = (0,), exclude_recent: int = 0) -> None:
        self._shifts = shifts
        self._excluded = max(exclude_recent - 1, 0)  # the new frame itself is not in the map yet
        self._blocks: list[torch.Tensor] = []
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @property
    def nbytes(self) -> int:
        """Bytes that the stored thumbnails take."""
        return sum(block.nbytes for block in self._filled())

    def add(self, descriptor: np.ndarray) -> None:
        """Store one thumbnail, ndarray of float32, shape (height, width)."""
        self._store(_codes(descriptor[None])[0])

    def similarities(self, descriptor: np.ndarray) -> np.ndarray:
        """Compare one thumbnail with all stored ones.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (height, width)

        Returns
        -------
        ndarray of float32, shape (n,)
            Larger = more alike, 0 = as all candidates are on average; minus infinity for frames that are none.
        """
        row = np.full(len(self), -np.inf, np.float32)
        candidates = max(len(self) - self._excluded, 0)
        if candidates:
            views = torch.from_numpy(_moved(descriptor, self._shifts)).bfloat16()
            products = torch.cat([(block @ views.T).float() for block in self._filled()]).numpy()[:candidates]
            row[:candidates] = standard_deviations((products - products.mean(axis=0)).max(axis=1), candidates)
        return row

    def _store(self, code: np.ndarray) -> None:
        block, row = divmod(self._length, _BLOCK)
        if row == 0:
            self._blocks.append(torch.empty(_BLOCK, len(code), dtype=torch.bfloat16))
        if self._blocks[block].shape[1:] != code.shape:
            raise ModelError(
                f"the map holds codes of {self._blocks[block].shape[1]} numbers, this frame's has {len(code)}; were "
                "the thumbnails made alike?"
            )
        self._blocks[block][row] = torch.from_numpy(code)
        self._length += 1

    def _filled(self) -> list[torch.Tensor]:
        return [block[: self._length - i * _BLOCK] for i, block in enumerate(self._blocks)]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the stored codes, float32 (n, d), for `loopclosure.store`."""
        return {"codes": torch.cat(self._filled()).float().numpy()} if self._blocks else {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> CorrelationMap:
        """Store what `to_arrays` gave."""
        for code in arrays.get("codes", ()):
            self._store(code)
        return self


def _codes(thumbnails: np.ndarray) -> np.ndarray:
    return unit(low_frequencies(thumbnails))


def _moved(thumbnail: np.ndarray, shifts: Sequence[int]) -> np.ndarray:
    """Return the codes of a thumbnail after each shift, the longer the less of it is left to compare."""
    width = thumbnail.shape[1]
    if len(shifts) == 0 or max(map(abs, shifts)) >= width:
        raise ConfigError(f"found shifts {list(shifts)}, wanted at least one, less than the thumbnail's {width} pixels")
    views = np.zeros((len(shifts), *thumbnail.shape), np.float32)
    for view, shift in zip(views, shifts, strict=True):
        view[:, max(-shift, 0) : width - max(shift, 0)] = thumbnail[:, max(shift, 0) : width - max(-shift, 0)]
    overlap = 1 - np.abs(shifts) / width
    return (_codes(views) / np.sqrt(overlap)[:, None]).astype(np.float32)
