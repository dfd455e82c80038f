"""The paper's own method: backbone maps -> Karhunen-Loeve compression -> NetVLAD (Jiang et al. 2024, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from loopclosure.aggregation.centring import centre_traverse
from loopclosure.aggregation.change import change
from loopclosure.aggregation.layout import layout
from loopclosure.aggregation.netvlad import NetVLAD, unit
from loopclosure.aggregation.reduction import Reduction
from loopclosure.aggregation.selection import GAMMAS, margin
from loopclosure.compression import READINGS, ChannelKL, FlatKL, SequenceKL
from loopclosure.config import Config
from loopclosure.errors import FitError
from loopclosure.features.networks import open_network
from loopclosure.matching.index import LONGEST, PlaceIndex
from loopclosure.matching.similarity import SetMap, VectorMap
from loopclosure.methods.base import Method
from loopclosure.store import part


class KLNetVLAD(Method):
    """Describe images by compressed ConvNet features.

    Where the mean of the traverse is taken out, the layout of the map stands beside NetVLAD
    (`loopclosure.aggregation.layout`), and ``aggregation.components`` whitened numbers are kept of each of the two.
    What has not changed in the view over the last frames counts less (`loopclosure.aggregation.change`). Similarities
    then mean the same on every drive, and `loopclosure.decision` knows the odds of a loop.

    The reading of the KL transform (``compression.reading``) decides what a frame's descriptor is:

    ========  ============================================  =====================================
    reading   stands for                                    descriptor
    ========  ============================================  =====================================
    channel   the frame                                     NetVLAD of the compressed map, (K * D,)
    none      the frame                                     NetVLAD of the map as it is, (K * c,)
    flat      the frame, layout kept                        the compressed map itself, (k,)
    sequence  the last l frames, as k eigen-images          NetVLAD of each of them, (k, K * c)
    ========  ============================================  =====================================

    Attributes
    ----------
    gamma : float or None
        The compression ratio in force; with ``compression.gamma = "auto"`` the one under which neighbouring frames
        stand out most from far ones (`loopclosure.aggregation.selection`).

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
        self.input_size = self.backbone.preprocessing.size
        self._reading = config.compression.reading
        self._rule = config.compression.model_dump(exclude={"reading"})
        self.gamma: float | None = GAMMAS[0] if self._rule["gamma"] == "auto" else self._rule["gamma"]
        self._kl: ChannelKL | FlatKL | SequenceKL | None = None
        if self._reading != "none":
            self._kl = READINGS[self._reading](**self._rule | {"gamma": self.gamma})
        self._netvlad = NetVLAD(config.aggregation.clusters, seed=config.learning.seed)
        self._reduction: Reduction | None = None
        self._components = config.aggregation.components if self._reading in ("channel", "none") else 0
        if not config.aggregation.whitened:
            self._components = 0
        self.calibrated = bool(self._components)
        self._weights = config.aggregation.part_weights if self._components else (1.0,)
        self._blank: np.ndarray | None = None
        if self._reading == "sequence":
            self.window, self.whole_sequences = config.sequence.length, True
        elif self._components:
            self.window = config.aggregation.change_over + 1

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
                np.concatenate([self.compress(self._padded(stacked[i : i + self.window])) for i in starts])
            )
        elif self.config.compression.gamma == "auto":
            self.gamma = max(GAMMAS, key=lambda gamma: self._margin(stacked, gamma))
            self._learn(stacked)
        else:
            self._learn(stacked)
        self.fitted, self._blank = True, None

    def _learn(self, maps: np.ndarray) -> None:
        """Learn basis, clusters and reduction from maps (n, h, w, c)."""
        if self._kl is not None:
            self._kl = READINGS[self._reading](**self._rule | {"gamma": self.gamma})
            self._kl.fit(maps)
        code = self.compress(maps)
        if self._reading != "flat":
            self._netvlad.fit(code)
        if self._components:
            descriptors, _ = centre_traverse(self.aggregate(code), window=len(maps))
            described = self._netvlad.centres_.size
            sizes = (described, descriptors.shape[1] - described)[: len(self._weights)]
            self._reduction = Reduction(self._components, weights=self._weights).fit(descriptors, sizes=sizes)

    def _margin(self, maps: np.ndarray, gamma: float) -> float:
        """Return how well places are told apart with this compression ratio."""
        self.gamma = gamma
        self._learn(maps)
        descriptors, _ = centre_traverse(self.aggregate(self.compress(maps)), window=len(maps))
        return margin(np.stack([self.reduce(descriptor) for descriptor in descriptors]))

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
        if self._reading == "sequence":
            return self.aggregate(self.compress(self._padded(np.stack(features))))
        weights = change(features[-1], features[0])[None] if self.window > 1 else None
        return self.aggregate(self.compress(features[-1][None]), weights)[0]

    def reduce(self, centred: np.ndarray) -> np.ndarray:
        """Return the whitened descriptor, float32 (parts * aggregation.components,), or the same where that is 0."""
        return centred if self._reduction is None else self._reduction.transform(centred)

    def compress(self, maps: np.ndarray) -> np.ndarray:
        """Return what the reading makes of maps, float32 (n, h, w, c)."""
        if isinstance(self._kl, SequenceKL):
            self._kl.fit(maps)  # nothing is learned across sequences
        return maps if self._kl is None else self._kl.transform(maps)

    def aggregate(self, code: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Return one descriptor, float32 (n, d), for each code that `compress` gave.

        ``weights``, float32 (n, h, w), say what each position counts.
        """
        if self._reading == "flat":
            return unit(code)
        descriptors = self._netvlad.transform(code, weights)
        if len(self._weights) == 1:
            return descriptors
        return np.hstack([descriptors, layout(code if weights is None else code * weights[..., None])])

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
        """Return an empty map for the descriptors; whitened ones have an index where they are many."""
        if 0 < len(self._weights) * self._components <= LONGEST:
            return PlaceIndex(flat_up_to=self.config.matching.flat_up_to)
        return SetMap() if self._reading == "sequence" else VectorMap()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""
        arrays = {f"kl.{name}": array for name, array in self._kl.to_arrays().items()} if self._kl is not None else {}
        if self._reading != "flat":
            arrays |= {f"netvlad.{name}": array for name, array in self._netvlad.to_arrays().items()}
        if self._reduction is not None:
            arrays |= {f"reduction.{name}": array for name, array in self._reduction.to_arrays().items()}
        return arrays if self.gamma is None else arrays | {"gamma": np.array(self.gamma)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave."""
        if "gamma" in arrays:
            self.gamma = float(arrays["gamma"])
        if self._kl is not None:
            self._kl = type(self._kl).from_arrays(part(arrays, "kl"), **self._rule | {"gamma": self.gamma})
        if self._reading != "flat":
            self._netvlad = NetVLAD.from_arrays(part(arrays, "netvlad"), seed=self.config.learning.seed)
        if self._components:
            self._reduction = Reduction.from_arrays(part(arrays, "reduction"), weights=self._weights)
        self.fitted = True
