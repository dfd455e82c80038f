"""THE table: method name -> how it is built. Adding a method is one file and one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from loopclosure.config import Config
from loopclosure.errors import ConfigError, did_you_mean
from loopclosure.methods.base import Method, PlaceMap, Scores

ProgressCallback = Callable[[int, int], None]


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


__all__ = ["METHODS", "Method", "MethodEntry", "PlaceMap", "Scores", "build_method"]
