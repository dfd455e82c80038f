"""The paper's own method: backbone maps -> Karhunen-Loeve compression -> NetVLAD (Jiang et al. 2024, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from loopclosure.aggregation.netvlad import NetVLAD, unit
from loopclosure.compression import READINGS, ChannelKL, FlatKL, SequenceKL
from loopclosure.config import Config
from loopclosure.errors import FitError
from loopclosure.features.networks import open_network
from loopclosure.matching.similarity import SetMap, VectorMap
from loopclosure.methods.base import Method
from loopclosure.store import part


class KLNetVLAD(Method):
    """Describe images by compressed ConvNet features.

    The reading of the KL transform (``compression.reading``) decides what a frame's descriptor is:

    ========  ============================================  =====================================
    reading   stands for                                    descriptor
    ========  ============================================  =====================================
    channel   the frame                                     NetVLAD of the compressed map, (K * D,)
    none      the frame                                     NetVLAD of the map as it is, (K * c,)
    flat      the frame, layout kept                        the compressed map itself, (k,)
    sequence  the last l frames, as k eigen-images          NetVLAD of each of them, (k, K * c)
    ========  ============================================  =====================================

    Parameters
    ----------
    config : Config
        Its sections `features`, `compression`, `aggregation`, `learning` and `sequence` are used.
    progress : callable, optional
        ``progress(done, total)`` in bytes, where weights have to be downloaded.
    """

    fitted = False
    centred = True
    threshold = 0.56

    def __init__(self, config: Config, *, progress: Callable[[int, int], None] | None = None) -> None:
        super().__init__(config)
        self.backbone = open_network(config, progress=progress)
        self._reading = config.compression.reading
        self._rule = config.compression.model_dump(exclude={"reading"})
        self._kl: ChannelKL | FlatKL | SequenceKL | None = None
        if self._reading != "none":
            self._kl = READINGS[self._reading](**self._rule)
        self._netvlad = NetVLAD(config.aggregation.clusters, seed=config.learning.seed)
        self._blank: np.ndarray | None = None
        if self._reading == "sequence":
            self.window = config.sequence.length

    @property
    def provenance(self) -> dict[str, Any]:
        """Which weights made the features, for `run.json` and for the check of a loaded model."""
        return {"weights": self.backbone.weights_name, "weights_sha256": self.backbone.weights_sha256}

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the feature map of each image, float32 (h, w, c) (Eq. 2-4)."""
        return list(self.backbone.maps(images)[self.config.features.layer])

    def fit(self, features: Sequence[np.ndarray]) -> None:
        """Learn the KL basis and the NetVLAD clusters from feature maps of consecutive frames."""
        stacked = np.stack(features)
        if self._reading == "sequence":
            starts = range(0, len(stacked), self.window)
            self._netvlad.fit(
                np.concatenate([self._compress(self._padded(stacked[i : i + self.window])) for i in starts])
            )
        else:
            if self._kl is not None:
                self._kl.fit(stacked)
            if self._reading != "flat":
                self._netvlad.fit(self._compress(stacked))
        self.fitted, self._blank = True, None

    def describe(self, features: Sequence[np.ndarray]) -> np.ndarray:
        """Describe the newest of the last `window` frames.

        Parameters
        ----------
        features : sequence of ndarray of float32, each of shape (h, w, c)
            At most `window` of them, oldest first.

        Returns
        -------
        ndarray of float32, shape (d,), or (k, d) in the reading ``sequence``
        """
        if not self.fitted:
            raise FitError("the method has learned no basis and no clusters yet; call fit first")
        stacked = np.stack(features)
        if self._reading == "sequence":
            return self._netvlad.transform(self._compress(self._padded(stacked)))
        code = self._compress(stacked)
        return unit(code)[0] if self._reading == "flat" else self._netvlad.transform(code)[0]

    def _compress(self, maps: np.ndarray) -> np.ndarray:
        """Return what the reading makes of maps (n, h, w, c)."""
        if isinstance(self._kl, SequenceKL):
            self._kl.fit(maps)  # nothing is learned across sequences
        return maps if self._kl is None else self._kl.transform(maps)

    def _padded(self, maps: np.ndarray) -> np.ndarray:
        """Fill a window that is not full yet with its first frame."""
        return np.concatenate([np.repeat(maps[:1], self.window - len(maps), axis=0), maps])

    def blank(self) -> np.ndarray:
        """Return the descriptor of a frame that says nothing: zeros."""
        if self._blank is None:
            black = np.zeros((self.config.features.height, self.config.features.width, 3), np.uint8)
            self._blank = np.zeros_like(self.describe(self.features([black])))
        return self._blank

    def new_map(self, *, exclude_recent: int) -> VectorMap:  # noqa: ARG002  (all pairs cost the same here)
        """Return an empty map for the descriptors."""
        return SetMap() if self._reading == "sequence" else VectorMap()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""
        arrays = {f"kl.{name}": array for name, array in self._kl.to_arrays().items()} if self._kl is not None else {}
        if self._reading != "flat":
            arrays |= {f"netvlad.{name}": array for name, array in self._netvlad.to_arrays().items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave."""
        if self._kl is not None:
            self._kl = type(self._kl).from_arrays(part(arrays, "kl"), **self._rule)
        if self._reading != "flat":
            self._netvlad = NetVLAD.from_arrays(part(arrays, "netvlad"), seed=self.config.learning.seed)
        self.fitted = True
