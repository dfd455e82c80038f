"""The literal reading: the images of one sequence are mixed into a few eigen-images."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopclosure.compression import persist
from loopclosure.compression.spectrum import (
    check_maps,
    check_rule,
    choose_components,
    degenerate_below,
    eigenvectors,
    fix_signs,
    whitening,
)
from loopclosure.errors import FitError

if TYPE_CHECKING:
    from typing_extensions import Self


class SequenceKL:
    """Karhunen-Loeve transform of one sequence: m images become k "eigen-images" of the same shape.

    Paper 2.2 to the letter: X is m x n with n = c * h * w (Eq. 6), E the mean over the m images (Eq. 8),
    ``C = (X - E)(X - E)^T / m`` is m x m (Eq. 10), U_k holds its k leading eigenvectors as rows (Eq. 11-13) and
    ``Y = U_k X`` (Eq. 14). Every sequence is solved by itself; nothing is learned from one for another.

    Parameters
    ----------
    gamma : float, optional
        Share of the eigenvectors that is cut away, in [0, 1): ``k = max(1, round((1 - gamma) * m))`` (Eq. 16).
    energy : float, optional
        Share of the energy that is kept, in (0, 1]: the smallest k that reaches it (Eq. 15).
    components : int, optional
        k itself, at most m. Exactly one of the three is given.
    whiten : bool
        Divide every eigen-image by the root of its eigenvalue; one without energy becomes zero.

    Attributes
    ----------
    shape_ : tuple of int
        (h, w, c), all that `fit` learns: it checks, and fixes the shape that `transform` accepts.

    Notes
    -----
    Eq. 14 multiplies X, not X - E. That makes less difference than it seems: the rows of X - E add up to zero, so
    every eigenvector with energy is orthogonal to (1, ..., 1) and ``U_k X = U_k (X - E)``. Eigen-images hold what
    *changes* along a sequence; what its images have in common is in the last one alone, of energy zero, which
    only ``k = m`` keeps (and whitening removes).

    The sign of an eigenvector is arbitrary, but two runs past one place must agree on it. An eigen-image is turned
    so that its inner product with the mean image E is not negative, which does not depend on the order or the
    number of frames (the sum of the eigenvector's entries, being zero, could not decide). Where the product is zero
    too, the entry of largest magnitude in the eigenvector is positive.

    Examples
    --------
    >>> maps = np.random.default_rng(0).normal(size=(10, 7, 7, 20))
    >>> SequenceKL(gamma=0.8).fit(maps).transform(maps).shape
    (2, 7, 7, 20)
    """

    reading: ClassVar[str] = "sequence"

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

    def fit(self, maps: ArrayLike) -> Self:
        """Check the settings and these maps, and remember their shape.

        Parameters
        ----------
        maps : array_like of shape (m, h, w, c)
            Feature maps of any sequence.

        Raises
        ------
        ConfigError
            If not exactly one rule for k is given, or it is out of range.
        FitError
            If the maps are not finite numbers of that shape.
        """
        check_rule(gamma=self.gamma, energy=self.energy, components=self.components)
        self.shape_ = check_maps(maps).shape[1:]
        return self

    def transform(self, maps: ArrayLike) -> NDArray[np.float32]:
        """Return the eigen-images of one sequence (Eq. 14).

        Parameters
        ----------
        maps : array_like of shape (m, h, w, c)
            Feature maps of the m images, in any order.

        Returns
        -------
        ndarray of shape (k, h, w, c), float32
            The one of largest energy first; none for a sequence of no images.

        Raises
        ------
        FitError
            If the transform is not fitted, the maps are not finite or have another shape, or m is less than
            `components`.
        """
        X = self._rows(maps)
        return (self._mixing(X) @ X).astype(np.float32).reshape(-1, *self.shape_)

    def mixing(self, maps: ArrayLike) -> NDArray[np.float64]:
        """Return the matrix U_k with which `transform` mixes the images of this sequence.

        Parameters
        ----------
        maps : array_like of shape (m, h, w, c)
            Feature maps of the m images.

        Returns
        -------
        ndarray of shape (k, m), float64
            Orthonormal rows; with `whiten` orthogonal ones, scaled.
        """
        return self._mixing(self._rows(maps))

    def inverse_transform(self, eigen_images: ArrayLike, mixing: ArrayLike) -> NDArray[np.float32]:
        """Return the images nearest to the originals that k eigen-images can tell; with k = m the originals.

        Parameters
        ----------
        eigen_images : array_like of shape (k, h, w, c)
            What `transform` returned.
        mixing : array_like of shape (k, m)
            What `mixing` returned for the same sequence.

        Returns
        -------
        ndarray of shape (m, h, w, c), float32
        """
        Y, U = self._rows(eigen_images), check_maps(mixing, axes=(2,), name="mixing matrix").astype(np.float64)
        if len(Y) != len(U):
            raise FitError(f"{len(Y)} eigen-images, but {len(U)} rows of the mixing matrix: of another sequence?")
        # Rows of U are orthogonal, so that its pseudo-inverse is its transpose over their squared lengths.
        squared = np.sum(U**2, axis=1, keepdims=True)
        inverse = np.divide(U, squared, out=np.zeros_like(U), where=squared > 0).T
        return (inverse @ Y).astype(np.float32).reshape(-1, *self.shape_)

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the constructor."""
        return {"gamma": self.gamma, "energy": self.energy, "components": self.components, "whiten": self.whiten}

    def to_arrays(self) -> dict[str, NDArray]:
        """Return the shape of the maps, all that there is, for `from_arrays`."""
        self._check_fitted()
        return {"shape": np.array(self.shape_)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], **settings: Any) -> Self:
        """Return a fitted transform from what `to_arrays` and `settings` gave.

        Raises
        ------
        ModelError
            If the arrays are of another reading.
        """
        kl = cls(**settings)
        check_rule(gamma=kl.gamma, energy=kl.energy, components=kl.components)
        kl.shape_ = tuple(persist.checked(arrays, {"shape": ("3", np.int64)})["shape"].tolist())
        return kl

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write settings and shape into `folder`."""
        persist.save(self, folder)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Self:
        """Return the transform that `save` wrote into `folder`."""
        return persist.load(cls, folder)

    def _mixing(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        m = len(X)
        if m == 0:
            return np.zeros((0, 0))
        E = X.mean(axis=0)
        energies, U = eigenvectors((X - E) @ (X - E).T / m)
        k = choose_components(
            energies, gamma=self.gamma, energy=self.energy, components=self.components, source=f"{m} images"
        )
        U = U[:k].copy()
        _turn(U, X @ E)
        if self.whiten:
            U *= whitening(energies[:k], degenerate_below(energies, E))[:, None]
        return U

    def _rows(self, maps: ArrayLike) -> NDArray[np.float64]:
        self._check_fitted()
        maps = check_maps(maps)
        if maps.shape[1:] != self.shape_:
            raise FitError(f"maps of one image are {maps.shape[1:]}, fitted for {self.shape_}: by the same layer?")
        return maps.reshape(len(maps), int(np.prod(self.shape_))).astype(np.float64)

    def _check_fitted(self) -> None:
        if not hasattr(self, "shape_"):
            raise FitError("SequenceKL is used before it was fitted: call fit first, or load a fitted one")


def _turn(U: NDArray[np.float64], similarity: NDArray[np.float64]) -> None:
    """Fix the signs in place; `similarity` is the inner product of each image with the mean image."""
    fix_signs(U)
    against = U @ similarity < -1e-9 * np.linalg.norm(similarity)
    U[against] *= -1
