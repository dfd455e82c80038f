"""A fitted transform as plain arrays: written, read back and checked."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from loopclosure import store
from loopclosure.errors import ConfigError, FitError, ModelError

KIND = "kl"


class Transform(Protocol):
    """What can be saved."""

    reading: ClassVar[str]

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the constructor."""

    def to_arrays(self) -> dict[str, NDArray]:
        """Return what was learned."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], **settings: Any) -> Any:
        """Return a fitted transform."""


_T = TypeVar("_T", bound=Transform)


def save(transform: Transform, folder: str | os.PathLike[str]) -> None:
    """Write a fitted transform into `folder`."""
    header = {"reading": transform.reading, "settings": transform.settings()}
    store.save_arrays(folder, kind=KIND, header=header, arrays=transform.to_arrays())


def load(kind: type[_T], folder: str | os.PathLike[str]) -> _T:
    """Read a transform of class `kind` from `folder`.

    Raises
    ------
    ModelError
        If the folder is damaged or holds another reading.
    """
    header, arrays = store.load_arrays(folder, kind=KIND)
    if header.get("reading") != kind.reading:
        raise ModelError(f"{folder} holds the reading '{header.get('reading')}', wanted '{kind.reading}'")
    settings = header.get("settings")
    if not isinstance(settings, dict) or set(settings) != set(kind().settings()):
        raise ModelError(f"{folder} holds settings of another version: fit again")
    try:
        return kind.from_arrays(arrays, **settings)
    except (ConfigError, FitError) as error:
        raise ModelError(f"{folder} is damaged: {error}") from None


def checked(arrays: Mapping[str, NDArray], wanted: Mapping[str, tuple[str, DTypeLike]]) -> dict[str, NDArray]:
    """Return `arrays` if they are the `wanted` ones.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        From a file, not to be trusted.
    wanted : mapping of str to (str, dtype)
        Name to axes and type: in ``{"mean": ("c", float), "basis": ("kc", float)}`` both c must be equal. A digit is
        a length.

    Raises
    ------
    ModelError
        If an array is missing, too many, of another type or shape, or not finite.
    """
    if set(arrays) != set(wanted):
        raise ModelError(
            f"a model with the arrays {sorted(arrays)}, wanted {sorted(wanted)}: fitted for another reading?"
        )
    lengths: dict[str, int] = {}
    for name, (axes, dtype) in wanted.items():
        array = arrays[name]
        fits = array.ndim == len(axes) and all(
            length == (int(axis) if axis.isdigit() else lengths.setdefault(axis, length))
            for axis, length in zip(axes, array.shape, strict=True)
        )
        if not fits or array.dtype != dtype or not np.isfinite(array).all():
            raise ModelError(f"array '{name}' {array.dtype} {array.shape} does not fit the model: the file is damaged")
    energies = arrays.get("energies", np.zeros(1))
    if (energies < 0).any() or (np.diff(energies) > 0).any() or arrays.get("lost", 0) < 0:
        raise ModelError("the energies of the model are negative or not sorted: the file is damaged")
    if arrays.get("n_samples", 2) < 2:
        raise ModelError("the model was fitted on fewer than 2 samples: the file is damaged")
    return dict(arrays)
