"""The map: descriptors of all frames seen so far, and how alike each of them is to a new one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.errors import ModelError

_BLOCK = 1024  # frames; memory grows block by block, and nothing that is stored is ever copied


class VectorMap:
    """Unit descriptors, compared by ``1 - |a - b|^2 / 4``: 1 for equal ones, 0.5 for orthogonal, 0 for opposite ones.

    This is one term of Eq. 20 on the scale on which a distance lies in [0, 1].

    Examples
    --------
    >>> places = VectorMap()
    >>> places.add(np.array([1.0, 0.0], np.float32))
    >>> places.similarities(np.array([0.0, 1.0], np.float32))
    array([0.5], dtype=float32)
    """

    def __init__(self) -> None:
        self._blocks: list[np.ndarray] = []
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @property
    def nbytes(self) -> int:
        """Bytes that the stored descriptors take."""
        return sum(block.nbytes for block in self._filled())

    def add(self, descriptor: np.ndarray) -> None:
        """Store one frame.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,) or (s, d)
            Unit vector, or a set of s of them; zeros for a blank or unreadable frame.
        """
        block, row = divmod(self._length, _BLOCK)
        if row == 0:
            self._blocks.append(np.empty((_BLOCK, *descriptor.shape), np.float32))
        if self._blocks[block].shape[1:] != descriptor.shape:
            raise ModelError(
                f"the map holds descriptors of shape {self._blocks[block].shape[1:]}, this frame's is "
                f"{descriptor.shape}; were they made by the same method?"
            )
        self._blocks[block][row] = descriptor
        self._length += 1

    def similarities(self, descriptor: np.ndarray) -> np.ndarray:
        """Compare one frame with all stored ones.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,) or (s, d)

        Returns
        -------
        ndarray of float32, shape (n,)
            In [0, 1], larger = more alike.
        """
        cosines = [self._cosines(block, descriptor) for block in self._filled()]
        if not cosines:
            return np.zeros(0, np.float32)
        return np.clip((1 + np.concatenate(cosines)) / 2, 0, 1)

    def _cosines(self, block: np.ndarray, descriptor: np.ndarray) -> np.ndarray:
        return block @ descriptor

    def _filled(self) -> list[np.ndarray]:
        return [block[: self._length - i * _BLOCK] for i, block in enumerate(self._blocks)]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the stored descriptors, shape (n, d) or (n, s, d), for `loopclosure.store`."""
        return {"descriptors": np.concatenate(self._filled())} if self._blocks else {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> VectorMap:
        """Store what `to_arrays` gave."""
        for descriptor in arrays.get("descriptors", ()):
            self.add(descriptor)
        return self


class SetMap(VectorMap):
    """Every frame is a set of s unit vectors (the eigen-images of its sequence), compared as sets.

    The similarity of two sets is the mean over both of each vector's best counterpart in the other one: the order of
    eigen-images with nearly equal eigenvalues carries no meaning.
    """

    def _cosines(self, block: np.ndarray, descriptor: np.ndarray) -> np.ndarray:
        pairs = block @ descriptor.T
        return (pairs.max(1).mean(1) + pairs.max(2).mean(1)) / 2
