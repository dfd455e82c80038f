"""What the two learned readings share: a mean, an orthonormal basis, and the way there and back."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopclosure.compression import persist
from loopclosure.compression.spectrum import check_rule, degenerate_below, energy_share, whitening
from loopclosure.errors import FitError

if TYPE_CHECKING:
    from typing_extensions import Self


class Projection(NamedTuple):
    """A solved eigenproblem, ready for ``(rows @ basis.T - offset) * scale``."""

    basis: NDArray[np.float32]
    energies: NDArray[np.float64]
    offset: NDArray[np.float32]
    scale: NDArray[np.float32]
    unscale: NDArray[np.float32]


class LinearKL(ABC):
    """A Karhunen-Loeve transform whose basis is learned from many samples and applied to any other.

    Attributes
    ----------
    mean_ : ndarray of shape (width,), float64
        Mean of the samples (Eq. 8).
    n_samples_ : int
        Samples seen.
    """

    reading: ClassVar[str]
    mean_: NDArray[np.float64]
    n_samples_: int
    _projection: Projection | None

    def __init__(
        self,
        *,
        gamma: float | None = None,
        energy: float | None = None,
        components: int | None = None,
        whiten: bool = False,
    ) -> None:
        self.gamma = gamma
        self.energy = energy
        self.components = components
        self.whiten = whiten

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the constructor."""
        return {"gamma": self.gamma, "energy": self.energy, "components": self.components, "whiten": self.whiten}

    @abstractmethod
    def to_arrays(self) -> dict[str, NDArray]:
        """Return what was learned, for `from_arrays`."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], **settings: Any) -> Self:
        """Return a fitted transform from what `to_arrays` and `settings` gave.

        Raises
        ------
        ModelError
            If the arrays do not fit together, or not to the settings.
        """

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write everything into `folder`; `load` brings it back, and `partial_fit` can go on from there."""
        persist.save(self, folder)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Self:
        """Return the transform that `save` wrote into `folder`.

        Raises
        ------
        ModelError
            If the folder is damaged or holds another reading.
        """
        return persist.load(cls, folder)

    @property
    def basis_(self) -> NDArray[np.float32]:
        """Orthonormal rows, the one of largest energy first: (k, width), float32."""
        return self._solved().basis

    @property
    def energies_(self) -> NDArray[np.float64]:
        """Known eigenvalues, largest first, none negative: float64."""
        return self._solved().energies

    @property
    def n_components_(self) -> int:
        """k, the length of a code."""
        return len(self.basis_)

    @property
    def energy_kept_(self) -> float:
        """Share of the energy that the basis holds (Eq. 15)."""
        solved = self._solved()
        return float(energy_share(solved.energies, lost=self._lost_energy())[len(solved.basis) - 1])

    @abstractmethod
    def _solve(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the basis (k, width) and all known energies."""

    def _lost_energy(self) -> float:
        return 0.0

    def _rule(self) -> dict[str, Any]:
        rule: dict[str, Any] = {"gamma": self.gamma, "energy": self.energy, "components": self.components}
        check_rule(**rule)
        return rule

    def _solved(self) -> Projection:
        """Return the projection; solved on first use after new samples, because that is the costly part."""
        if not hasattr(self, "mean_"):
            raise FitError(f"{type(self).__name__} is used before it was fitted: call fit first, or load a fitted one")
        if self._projection is None:
            if self.n_samples_ < 2:
                raise FitError(f"{self.n_samples_} sample seen, wanted at least 2: one alone has no variance")
            self._projection = self._project(*self._solve())
        return self._projection

    def _project(self, basis: NDArray[np.float32], energies: NDArray[np.float64]) -> Projection:
        kept = energies[: len(basis)]
        scale = np.ones_like(kept)
        if self.whiten:
            scale = whitening(kept, degenerate_below(energies, self.mean_))
        unscale = np.divide(1, scale, out=np.zeros_like(scale), where=scale > 0)
        # Row by row, because a float64 copy of a wide basis would double the memory.
        offset = np.array([row @ self.mean_ for row in basis])
        return Projection(basis, energies, *(array.astype(np.float32) for array in (offset, scale, unscale)))

    def _encode(self, rows: NDArray) -> NDArray[np.float32]:
        solved = self._solved()
        codes: NDArray[np.float32] = rows.astype(np.float32, copy=False) @ solved.basis.T
        codes -= solved.offset
        codes *= solved.scale
        return codes

    def _decode(self, codes: NDArray) -> NDArray[np.float32]:
        solved = self._solved()
        if codes.shape[1] != len(solved.basis):
            raise FitError(f"codes have {codes.shape[1]} components, this basis {len(solved.basis)}")
        rows = (codes.astype(np.float32, copy=False) * solved.unscale) @ solved.basis
        rows += self.mean_
        return rows.astype(np.float32, copy=False)
