"""Eigenvalues and what to keep of them (paper 2.2, Eq. 11-13, 15 and 16)."""

from __future__ import annotations

from numbers import Integral, Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopclosure.errors import ConfigError, FitError

DEGENERATE = 1e-12
"""A share of the largest energy below which a direction is rounding, not signal."""

MAX_VALUE = 1e30
"""Larger values in maps are refused: their sums would leave float32."""


def check_rule(*, gamma: float | None, energy: float | None, components: int | None) -> None:
    """Refuse anything but exactly one rule that is in range.

    Raises
    ------
    ConfigError
        If none or several of the three are given, or the one that is given is out of range.
    """
    rules = {"gamma": gamma, "energy": energy, "components": components}
    given = [name for name, value in rules.items() if value is not None]
    if len(given) != 1:
        raise ConfigError(f"wants exactly one of gamma, energy and components, found {' and '.join(given) or 'none'}")
    if gamma is not None and not (isinstance(gamma, Real) and 0 <= gamma < 1):
        raise ConfigError(f"gamma = {gamma!r}, wanted at least 0 and below 1: it is the share that is cut away")
    if energy is not None and not (isinstance(energy, Real) and 0 < energy <= 1):
        raise ConfigError(f"energy = {energy!r}, wanted above 0 and at most 1: it is the share that is kept")
    if components is not None and not (isinstance(components, Integral) and components >= 1):
        raise ConfigError(f"components = {components!r}, wanted a whole number of at least 1")


def energy_share(energies: ArrayLike, *, lost: float = 0.0) -> NDArray[np.float64]:
    """Return the share of the energy that the first 1, 2, ... eigenvectors hold (Eq. 15).

    Parameters
    ----------
    energies : array_like of shape (size,)
        Eigenvalues, largest first, none negative.
    lost : float
        Energy of eigenvectors that are no longer known.

    Returns
    -------
    ndarray of shape (size,), float64
        Never falls; all ones where there is no energy at all, because then nothing is lost.

    Examples
    --------
    >>> energy_share([6, 3, 1]).tolist()
    [0.6, 0.9, 1.0]
    """
    cumulative = np.cumsum(np.asarray(energies, np.float64))
    if not cumulative.size or cumulative[-1] + lost == 0:
        return np.ones_like(cumulative)
    return cumulative / (cumulative[-1] + lost)


def choose_components(
    energies: ArrayLike,
    *,
    gamma: float | None = None,
    energy: float | None = None,
    components: int | None = None,
    size: int | None = None,
    limit: int | None = None,
    lost: float = 0.0,
    source: str = "these samples",
) -> int:
    """Return how many eigenvectors one of the three rules keeps.

    Parameters
    ----------
    energies : array_like of shape (known,)
        Eigenvalues, largest first, none negative.
    gamma : float, optional
        Share of the eigenvectors that is cut away (Eq. 16): ``k = max(1, round((1 - gamma) * size))``,
        at most all `known` ones.
    energy : float, optional
        Share of the energy that is kept: the smallest k that reaches it (Eq. 15).
    components : int, optional
        k itself.
    size : int, optional
        Size of the basis in the rule of `gamma`; `known` if absent.
    limit : int, optional
        Eigenvectors that the samples determine; `known` if absent.
    lost : float
        Energy of eigenvectors that are no longer known.
    source : str
        What sets `limit`, for the error.

    Returns
    -------
    int
        k, from 1 to `limit`.

    Raises
    ------
    ConfigError
        If not exactly one rule is given, or it is out of range.
    FitError
        If the rule wants more than the samples allow.

    Examples
    --------
    >>> choose_components([1.0] * 10, gamma=0.8)
    2
    >>> choose_components([6, 3, 1], energy=0.9)
    2
    """
    check_rule(gamma=gamma, energy=energy, components=components)
    known = np.size(energies)
    limit = known if limit is None else limit
    if energy is not None:
        share = energy_share(energies, lost=lost)
        k = int(np.searchsorted(share, energy - DEGENERATE)) + 1
        if k > known:
            raise FitError(
                f"energy = {energy} wanted, the {known} eigenvectors that were kept hold {share[-1]:.4f}: keep more"
            )
        # Eigenvectors beyond the limit hold rounding alone, so that leaving them out loses nothing.
        return min(k, limit)
    if gamma is not None:
        k = min(max(1, round((1 - gamma) * (known if size is None else size))), known)
    else:
        k = int(components or 0)
    if k > limit:
        raise FitError(
            f"k = {k} components wanted, {source} allow at most {limit}: give more images or ask for fewer components"
        )
    return k


def eigenvectors(symmetric: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Solve the eigenproblem of a covariance (Eq. 11-13).

    Parameters
    ----------
    symmetric : ndarray of shape (size, size), float64
        Positive semi-definite up to rounding.

    Returns
    -------
    energies : ndarray of shape (size,), float64
        Largest first, none negative.
    vectors : ndarray of shape (size, size), float64
        One orthonormal **row** for each energy.
    """
    energies, vectors = np.linalg.eigh(symmetric)
    return np.maximum(energies[::-1], 0), vectors.T[::-1]


def fix_signs(rows: NDArray[np.floating]) -> None:
    """Turn every row, in place, so that its entry of largest magnitude is positive.

    An eigenvector and its negative are equally good; without a rule, which one comes out depends on the
    linear-algebra library, and codes of two machines could not be compared.
    """
    for row in rows:
        if row[np.argmax(np.abs(row))] < 0:
            row *= -1


def degenerate_below(energies: NDArray[np.float64], mean: NDArray[np.float64]) -> float:
    """Return the energy below which a direction is rounding.

    The largest energy and the mean set it, since float32 maps do not resolve less than 1e-7 of their mean, and below
    both the range of float32.
    """
    largest = float(energies[0]) if energies.size else 0.0
    return max(DEGENERATE * largest, 1e-14 * float(mean @ mean), MAX_VALUE**-2)


def whitening(energies: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Return ``1 / sqrt(energy)``, and 0 for energies up to `floor`: what does not vary says nothing."""
    alive = energies > floor
    return np.where(alive, 1 / np.sqrt(np.where(alive, energies, 1)), 0)


def check_maps(maps: ArrayLike, *, axes: tuple[int, ...] = (4,), name: str = "maps") -> NDArray:
    """Return `maps` as an array without a copy, if they are finite real numbers of a shape we know.

    Parameters
    ----------
    maps : array_like
        Real numbers.
    axes : tuple of int
        Numbers of axes that are welcome.
    name : str
        What they are, for the error.

    Raises
    ------
    FitError
        If they have another shape or type, or hold NaN, infinite or absurdly large values.
    """
    array = np.asarray(maps)
    if array.ndim not in axes or 0 in array.shape[1:]:
        raise FitError(f"{name} have shape {array.shape}, wanted {' or '.join(f'{n} axes' for n in axes)}, none empty")
    if array.dtype.kind not in "fiub":
        raise FitError(f"{name} are of type {array.dtype}, wanted real numbers")
    if array.size and not (float(array.min()) >= -MAX_VALUE and float(array.max()) <= MAX_VALUE):
        raise FitError(f"{name} hold NaN or values beyond {MAX_VALUE:g}: did the backbone overflow?")
    return array
