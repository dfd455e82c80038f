"""What methods with one vector an image have in common: a network, perhaps something learned behind it, cosine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from loopclosure.aggregation.netvlad import unit
from loopclosure.config import Config
from loopclosure.errors import FitError
from loopclosure.matching.similarity import VectorMap
from loopclosure.matching.standard import StandardScores
from loopclosure.methods.base import Method

Describe = Callable[[Sequence[np.ndarray]], Iterable[np.ndarray]]


class Code(Protocol):
    """A transform of features that is learned from features."""

    def fit(self, features: np.ndarray) -> Any:
        """Learn from features (n, ...)."""

    def transform(self, features: np.ndarray) -> np.ndarray:
        """Turn features (n, ...) into codes (n, ...)."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Take over what `to_arrays` gave."""


class VectorMethod(Method):
    """Compare images by the cosine of one vector each, from which the running mean of the traverse is taken out.

    The score of a loop is in standard deviations of the cosines of a frame, see `StandardScores`. The detector fits
    such a method even where no code is learned: it needs the mean of the first frames.

    Parameters
    ----------
    config : Config
        The section `aggregation` says over how many frames the mean runs.
    describe : callable
        n images to n arrays of features, float32.
    code : Code, optional
        Learned compression of the features.
    provenance : dict
        Where the weights came from.
    threshold : float
        Least score of a loop where the configuration sets none.
    """

    fitted = False
    centred = True
    sums = StandardScores

    def __init__(
        self,
        config: Config,
        describe: Describe,
        *,
        provenance: dict[str, Any],
        threshold: float,
        code: Code | None = None,
    ) -> None:
        super().__init__(config)
        self.threshold = threshold
        self._describe = describe
        self._code = code
        self._provenance = provenance

    @property
    def provenance(self) -> dict[str, Any]:
        """Which weights made the features."""
        return self._provenance

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the features of each image before any code."""
        return list(self._describe(images))

    def fit(self, features: Sequence[np.ndarray]) -> None:
        """Learn the code, if there is one."""
        if self._code is not None:
            self._code.fit(np.stack(features))
        self.fitted = True

    def describe(self, features: Sequence[np.ndarray]) -> np.ndarray:
        """Return the unit vector of the newest frame, float32 (d,)."""
        if not self.fitted:
            raise FitError("the method has seen no frames to learn from yet; call fit first")
        newest = np.asarray(features[-1], np.float32)
        if self._code is not None:
            newest = self._code.transform(newest[None])
        return unit(newest.ravel())

    def blank(self) -> np.ndarray:
        """Return the descriptor of a frame that says nothing: zeros."""
        return np.zeros_like(self.describe(self.features([np.zeros((32, 32, 3), np.uint8)])))

    def new_map(self, *, exclude_recent: int) -> VectorMap:  # noqa: ARG002  (all pairs cost the same here)
        """Return an empty map for the descriptors."""
        return VectorMap()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""
        return {} if self._code is None else self._code.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave."""
        if self._code is not None:
            self._code.restore(arrays)
        self.fitted = True
