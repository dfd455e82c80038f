"""The reading that keeps the layout: a whole flattened map is one sample, and the basis spans image space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopclosure.compression import persist
from loopclosure.compression.linear import LinearKL
from loopclosure.compression.snapshots import gram, orthonormal_rows
from loopclosure.compression.spectrum import (
    check_maps,
    choose_components,
    degenerate_below,
    eigenvectors,
)
from loopclosure.errors import ConfigError, FitError, ModelError

if TYPE_CHECKING:
    from typing_extensions import Self


class FlatKL(LinearKL):
    """Karhunen-Loeve transform over whole maps: an image becomes one code of length k.

    One sample is a flattened map of length h * w * c. The basis of that large space comes from the m x m problem of
    m images (Eq. 10-13, known as the method of snapshots): with eigenvectors U of the m x m matrix, the basis is
    ``U (X - E)`` with rows scaled to length 1.

    Parameters
    ----------
    gamma : float, optional
        Share of the eigenvectors that is cut away, in [0, 1): ``k = max(1, round((1 - gamma) * m))`` (Eq. 16).
        The m-th eigenvector of m centred images has no energy, so that ``gamma=0`` keeps m - 1; in a stream
        `max_components` is a bound too.
    energy : float, optional
        Share of the energy that is kept, in (0, 1]: the smallest k that reaches it (Eq. 15).
    components : int, optional
        k itself, at most m - 1. Exactly one of the three is given.
    whiten : bool
        Scale every component to unit variance; a direction without variance gives zeros.
    max_components : int
        Eigenvectors that a stream carries from batch to batch. While the images seen have no higher rank the
        stream gives what one batch gives; beyond it, the weakest directions are forgotten. `fit` does not need it.

    Attributes
    ----------
    mean_ : ndarray of shape (h * w * c,), float64
        Mean image (Eq. 8).
    basis_ : ndarray of shape (k, h * w * c), float32
        Orthonormal, each row with a positive entry of largest magnitude. Where the images vary in fewer than k
        directions, arbitrary directions of no energy fill it up.
    energies_ : ndarray of shape (m - 1,), float64
        Eigenvalues, largest first; after a stream at most `max_components`.
    energy_kept_ : float
        Share of the energy that the basis holds (Eq. 15).
    n_samples_ : int
        Images seen, m.
    shape_ : tuple of int
        (h, w, c).

    Examples
    --------
    >>> maps = np.random.default_rng(0).normal(size=(10, 7, 7, 20))
    >>> FlatKL(gamma=0.8).fit(maps).transform(maps).shape
    (10, 2)
    """

    reading = "flat"

    def __init__(
        self,
        *,
        gamma: float | None = None,
        energy: float | None = None,
        components: int | None = None,
        whiten: bool = False,
        max_components: int = 512,
    ) -> None:
        super().__init__(gamma=gamma, energy=energy, components=components, whiten=whiten)
        self.max_components = max_components

    def fit(self, maps: ArrayLike) -> Self:
        """Learn the basis from these maps alone.

        Parameters
        ----------
        maps : array_like of shape (m, h, w, c)
            Feature maps of at least two images. Contiguous ones are not copied.

        Raises
        ------
        ConfigError
            If not exactly one rule for k is given, or it is out of range.
        FitError
            If the maps are not finite numbers of that shape, or too few for k.
        """
        self.__dict__.pop("mean_", None)
        maps = self._prepare(maps)
        if len(maps) < 2:
            raise FitError(f"{len(maps)} image to fit on, wanted at least 2: one alone has no variance")
        self._merge(maps, lambda energies: self._choose(energies, len(maps)))
        return self

    def partial_fit(self, maps: ArrayLike) -> Self:
        """Learn from one more batch, in one pass; as `fit`, but without forgetting what was seen.

        The sequential Karhunen-Loeve transform (Levy and Lindenbaum 2000; Ross et al. 2008): the eigenvectors so far,
        as long as their strength, stand for all earlier images in the small problem of the next batch.
        After `fit` the k eigenvectors that it kept go on.

        Parameters
        ----------
        maps : array_like of shape (n, h, w, c)
            Feature maps, zero or more.

        Raises
        ------
        ConfigError, FitError
            As `fit`; too few images for k are an error when the basis is first used.
        """
        maps = self._prepare(maps)
        if len(maps):
            self._forget_tail()
            self._merge(maps, lambda energies: min(self.max_components, len(energies)))
            self._forget_tail()
        return self

    def transform(self, maps: ArrayLike) -> NDArray[np.float32]:
        """Return one code for each image.

        Parameters
        ----------
        maps : array_like of shape (n, h, w, c)
            Feature maps, zero or more.

        Returns
        -------
        ndarray of shape (n, k), float32

        Raises
        ------
        FitError
            If the transform is not fitted, or the maps are not finite or have another shape.
        """
        self._solved()
        maps = check_maps(maps)
        self._check_shape(maps)
        return self._encode(maps.reshape(len(maps), len(self.mean_)))

    def inverse_transform(self, codes: ArrayLike) -> NDArray[np.float32]:
        """Return the maps nearest to the originals that k components can tell.

        With all m - 1 components the images that were fitted on come back, because the mean is known.

        Parameters
        ----------
        codes : array_like of shape (n, k)
            What `transform` returned.

        Returns
        -------
        ndarray of shape (n, h, w, c), float32
        """
        return self._decode(check_maps(codes, axes=(2,), name="codes")).reshape(-1, *self.shape_)

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the constructor."""
        return {**super().settings(), "max_components": self.max_components}

    def to_arrays(self) -> dict[str, NDArray]:
        """Return what was learned, for `from_arrays`."""
        self._solved()
        return {
            "mean": self.mean_,
            "basis": self._rows,
            "energies": self._energies,
            "lost": np.array([self._lost]),
            "n_samples": np.array([self.n_samples_]),
            "shape": np.array(self.shape_),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], **settings: Any) -> Self:
        """Return a fitted transform from what `to_arrays` and `settings` gave.

        Raises
        ------
        ConfigError
            If the settings are out of range.
        ModelError
            If the arrays do not fit together, or not to the settings.
        """
        kl = cls(**settings)
        found = persist.checked(arrays, _ARRAYS)
        kl.mean_, kl._rows, kl._energies = found["mean"], found["basis"], found["energies"]
        kl._lost, kl.n_samples_ = float(found["lost"][0]), int(found["n_samples"][0])
        kl.shape_, kl._projection = tuple(found["shape"].tolist()), None
        if np.prod(kl.shape_) != len(kl.mean_) or len(kl._rows) > len(kl._energies):
            raise ModelError(f"the arrays of the model do not belong together, maps are {kl.shape_}: it is damaged")
        wanted = kl._choose(kl._energies, kl.n_samples_)
        if len(kl._rows) < wanted:
            raise ModelError(f"the model has {len(kl._rows)} components, these settings want {wanted}: fit again")
        return kl

    def _prepare(self, maps: ArrayLike) -> NDArray:
        """Return checked maps as rows, after an empty start where nothing was seen yet."""
        self._rule()
        if self.max_components < 1:
            raise ConfigError(f"max_components = {self.max_components}, wanted at least 1")
        maps = check_maps(maps)
        if not hasattr(self, "mean_"):
            self.shape_, width = maps.shape[1:], int(np.prod(maps.shape[1:]))
            self.mean_, self._rows, self._energies = np.zeros(width), np.zeros((0, width), np.float32), np.zeros(0)
            self._lost, self.n_samples_, self._projection = 0.0, 0, None
        self._check_shape(maps)
        return maps.reshape(len(maps), len(self.mean_))

    def _merge(self, images: NDArray, choose: Callable[[NDArray[np.float64]], int]) -> None:
        """Solve the small problem of the rows held and the new images, and keep what `choose` says."""
        old, total = self.n_samples_, self.n_samples_ + len(images)
        held = len(self._rows)
        strengths = np.sqrt(old * self._energies[:held])
        mean = images.mean(axis=0, dtype=np.float64)
        jump = mean - self.mean_

        def stacked(columns: slice) -> NDArray[np.float64]:
            return np.vstack(
                [
                    strengths[:, None] * self._rows[:, columns],
                    images[:, columns] - mean[columns],
                    np.sqrt(old * len(images) / total) * jump[None, columns],
                ]
            )

        width = len(mean)
        scatter, vectors = eigenvectors(gram(stacked, held + len(images) + 1, width))
        energies = scatter[: min(total - 1, width)] / total
        keep = choose(energies)
        new_mean = self.mean_ + jump * (len(images) / total)
        alive = int(np.sum(energies[:keep] > degenerate_below(energies, new_mean)))
        weights = vectors[:alive] / np.sqrt(scatter[:alive, None])
        self._rows = orthonormal_rows(stacked, weights, keep, width)
        self._energies, self.mean_, self.n_samples_, self._projection = energies, new_mean, total, None

    def _forget_tail(self) -> None:
        """Count the energy of eigenvectors that are not held as lost."""
        self._lost += self.n_samples_ * float(self._energies[len(self._rows) :].sum())
        self._energies = self._energies[: len(self._rows)]

    def _solve(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        return self._rows[: self._choose(self._energies, self.n_samples_)], self._energies

    def _lost_energy(self) -> float:
        return self._lost / self.n_samples_

    def _choose(self, energies: NDArray[np.float64], images: int) -> int:
        return choose_components(
            energies,
            **self._rule(),
            size=images,
            lost=self._lost / images,
            source=f"{images} images (in a stream: with max_components = {self.max_components})",
        )

    def _check_shape(self, maps: NDArray) -> None:
        if maps.shape[1:] != self.shape_:
            raise FitError(
                f"maps of one image are {maps.shape[1:]}, the basis is for {self.shape_}: "
                "were they made by the same layer from images of the same size?"
            )


_ARRAYS = {
    "mean": ("d", np.float64),
    "basis": ("rd", np.float32),
    "energies": ("e", np.float64),
    "lost": ("1", np.float64),
    "n_samples": ("1", np.int64),
    "shape": ("3", np.int64),
}
