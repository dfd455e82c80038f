"""THE table: method name -> how it is built. Adding a method is one file and one line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import ConfigError, did_you_mean

ProgressCallback = Callable[[int, int], None]


class PlaceMap(Protocol):
    """Descriptors of all frames seen so far."""

    def __len__(self) -> int: ...
    def add(self, descriptor: np.ndarray) -> None:
        """Store one frame."""

    def extend(self, descriptors: np.ndarray) -> None:
        """Store several frames."""

    def similarities(self, descriptor: np.ndarray) -> np.ndarray:
        """Compare one frame with all stored ones: float32 (n,), larger = more alike."""

    def to_array(self) -> np.ndarray:
        """Return all stored descriptors, the first axis over frames."""


class Method(Protocol):
    """One way to tell whether two frames show the same place; `detect.LoopDetector` does the rest."""

    centred: bool
    fitted: bool

    @property
    def window(self) -> int:
        """Frames whose features one descriptor is made of."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the learned parts came from."""

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Turn uint8 RGB images into one array of features each: the costly part."""

    def fit(self, maps: Sequence[np.ndarray]) -> None:
        """Learn from the features of consecutive frames."""

    def describe(self, maps: Sequence[np.ndarray]) -> np.ndarray:
        """Describe the newest of the last `window` frames from their features."""

    def blank(self) -> np.ndarray:
        """Return the descriptor of a frame that says nothing."""

    def new_map(self) -> PlaceMap:
        """Return an empty map for the descriptors."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave."""


@dataclass(frozen=True)
class MethodEntry:
    """One row of the table.

    Attributes
    ----------
    summary : str
        The method in a line.
    source : str
        The paper.
    learns : str
        What is fitted on images before it can run.
    build : callable
        ``build(config, progress=None)`` returns the `Method`.
    """

    summary: str
    source: str
    learns: str
    build: Callable[..., Method]


def _kl_netvlad(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.kl_netvlad import KLNetVLAD

    return KLNetVLAD(config, progress=progress)


METHODS: dict[str, MethodEntry] = {
    "kl-netvlad": MethodEntry(
        "feature maps of any backbone, compressed by the Karhunen-Loeve transform, as NetVLAD descriptors",
        "Jiang, Zhou, Sun, Appl. Sci. 2024, 14(1), 8",
        "KL basis and clusters, on the drive itself or by `fit`",
        _kl_netvlad,
    ),
}


def build_method(config: Config, *, progress: ProgressCallback | None = None) -> Method:
    """Build the method that `config.method` names.

    Raises
    ------
    ConfigError
        For an unknown name, with the nearest known one.
    """
    if config.method not in METHODS:
        raise ConfigError(
            f"unknown method '{config.method}'{did_you_mean(config.method, METHODS)}; known: {', '.join(METHODS)}"
        )
    return METHODS[config.method].build(config, progress)
