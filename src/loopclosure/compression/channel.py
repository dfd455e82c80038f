"""The default reading: every map position is one sample, and the basis spans the channels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopclosure.compression import persist
from loopclosure.compression.linear import LinearKL
from loopclosure.compression.spectrum import check_maps, choose_components, eigenvectors, fix_signs
from loopclosure.errors import FitError, ModelError

if TYPE_CHECKING:
    from typing_extensions import Self

CHUNK_BYTES = 32 << 20


class ChannelKL(LinearKL):
    """Karhunen-Loeve transform over channels: maps of c channels become maps of k.

    The reading of paper 2.2 that gives the "W x H x D" maps of 2.3: each of the n * h * w map positions is one sample
    of length c, the covariance (Eq. 10) is c x c, and the basis is learned once and applied to any image.

    Parameters
    ----------
    gamma : float, optional
        Share of the eigenvectors that is cut away, in [0, 1): ``k = max(1, round((1 - gamma) * c))`` (Eq. 16).
    energy : float, optional
        Share of the energy that is kept, in (0, 1]: the smallest k that reaches it (Eq. 15).
    components : int, optional
        k itself. Exactly one of the three is given.
    whiten : bool
        Scale every component to unit variance; a direction without variance gives zeros.

    Attributes
    ----------
    mean_ : ndarray of shape (c,), float64
        Mean of the samples (Eq. 8).
    basis_ : ndarray of shape (k, c), float32
        Orthonormal eigenvectors, each with a positive entry of largest magnitude.
    energies_ : ndarray of shape (c,), float64
        All eigenvalues, largest first.
    energy_kept_ : float
        Share of the energy that the basis holds (Eq. 15).
    n_samples_ : int
        Map positions seen.

    Notes
    -----
    Count, mean and scatter of batches are merged in float64 (Chan, Golub and LeVeque 1979), so that a stream gives
    what one batch gives, in memory of c x c. The eigenproblem of a stream waits until its result is wanted.

    Examples
    --------
    >>> maps = np.random.default_rng(0).normal(size=(4, 7, 7, 20))
    >>> ChannelKL(gamma=0.8).fit(maps).transform(maps).shape
    (4, 7, 7, 4)
    """

    reading = "channel"

    def fit(self, maps: ArrayLike) -> Self:
        """Learn the basis from these maps alone.

        Parameters
        ----------
        maps : array_like of shape (n, h, w, c) or (samples, c)
            Feature maps; at least two samples.

        Raises
        ------
        ConfigError
            If not exactly one rule for k is given, or it is out of range.
        FitError
            If the maps are not finite numbers of that shape, or too few for k.
        """
        self.__dict__.pop("mean_", None)
        self.partial_fit(maps)
        self._solved()
        return self

    def partial_fit(self, maps: ArrayLike) -> Self:
        """Learn from one more batch, in one pass; as `fit`, but without forgetting what was seen.

        Parameters
        ----------
        maps : array_like of shape (n, h, w, c) or (samples, c)
            Feature maps, zero or more.

        Raises
        ------
        ConfigError, FitError
            As `fit`; too few samples for k are an error when the basis is first used.
        """
        self._rule()
        maps = check_maps(maps, axes=(2, 4))
        channels = maps.shape[-1]
        if not hasattr(self, "mean_"):
            self.mean_, self._scatter, self.n_samples_ = np.zeros(channels), np.zeros((channels, channels)), 0
        self._check_channels(maps)
        step = max(1, CHUNK_BYTES // (8 * maps[:1].size)) if maps.size else 1
        for start in range(0, len(maps), step):
            self._merge(maps[start : start + step].reshape(-1, channels).astype(np.float64))
        self._projection = None
        return self

    def transform(self, maps: ArrayLike) -> NDArray[np.float32]:
        """Compress maps, each position by itself.

        Parameters
        ----------
        maps : array_like of shape (n, h, w, c) or (samples, c)
            Feature maps, zero or more.

        Returns
        -------
        ndarray of shape (n, h, w, k) or (samples, k), float32

        Raises
        ------
        FitError
            If the transform is not fitted, or the maps are not finite or have other channels.
        """
        self._solved()
        maps = check_maps(maps, axes=(2, 4))
        self._check_channels(maps)
        return self._encode(maps.reshape(-1, maps.shape[-1])).reshape(*maps.shape[:-1], self.n_components_)

    def inverse_transform(self, codes: ArrayLike) -> NDArray[np.float32]:
        """Return the maps nearest to the originals that k components can tell.

        Parameters
        ----------
        codes : array_like of shape (n, h, w, k) or (samples, k)
            What `transform` returned.

        Returns
        -------
        ndarray of shape (n, h, w, c) or (samples, c), float32
        """
        codes = check_maps(codes, axes=(2, 4), name="codes")
        return self._decode(codes.reshape(-1, codes.shape[-1])).reshape(*codes.shape[:-1], len(self.mean_))

    def to_arrays(self) -> dict[str, NDArray]:
        """Return what was learned, for `from_arrays`; the scatter is there so that a stream can go on."""
        solved = self._solved()
        return {
            "mean": self.mean_,
            "scatter": self._scatter,
            "n_samples": np.array([self.n_samples_]),
            "basis": solved.basis,
            "energies": solved.energies,
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
        kl.mean_, kl._scatter, kl.n_samples_ = found["mean"], found["scatter"], int(found["n_samples"][0])
        wanted = kl._choose(found["energies"])
        if len(found["basis"]) != wanted:
            raise ModelError(f"the model has {len(found['basis'])} components, these settings want {wanted}: fit again")
        kl._projection = kl._project(found["basis"], found["energies"])
        return kl

    def _merge(self, rows: NDArray[np.float64]) -> None:
        total = self.n_samples_ + len(rows)
        mean = rows.mean(axis=0)
        rows -= mean
        jump = mean - self.mean_
        self._scatter += rows.T @ rows
        self._scatter += np.outer(jump, jump * (self.n_samples_ * len(rows) / total))
        self.mean_ = self.mean_ + jump * (len(rows) / total)
        self.n_samples_ = total

    def _solve(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        energies, vectors = eigenvectors(self._scatter / self.n_samples_)
        basis = vectors[: self._choose(energies)].astype(np.float32, order="C")
        fix_signs(basis)
        return basis, energies

    def _choose(self, energies: NDArray[np.float64]) -> int:
        limit = min(len(self.mean_), self.n_samples_ - 1)
        source = f"{self.n_samples_} samples of {len(self.mean_)} channels"
        return choose_components(energies, **self._rule(), limit=limit, source=source)

    def _check_channels(self, maps: NDArray) -> None:
        if maps.shape[-1] != len(self.mean_):
            raise FitError(
                f"maps have {maps.shape[-1]} channels, the basis {len(self.mean_)}: were they made by the same layer?"
            )


_ARRAYS = {
    "mean": ("c", np.float64),
    "scatter": ("cc", np.float64),
    "n_samples": ("1", np.int64),
    "basis": ("kc", np.float32),
    "energies": ("c", np.float64),
}
