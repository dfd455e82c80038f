"""ConvNet features with cosine: as they are, through an autoencoder, or through PCA.

Maps are averaged over 3 x 3 cells. One mean over the whole map forgets where things are, the flattened map allows no
displacement; coarse cells beat both on all photographs they were compared on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from loopclosure.aggregation.pooling import pool_cells
from loopclosure.compression import choose_components
from loopclosure.compression.spectrum import degenerate_below, whitening
from loopclosure.config import Config
from loopclosure.errors import ConfigError, FitError, ModelError
from loopclosure.features.networks import open_network
from loopclosure.methods.vectors import Code, VectorMethod

CELLS = 3


def cnn(
    config: Config,
    *,
    code: Code | None = None,
    threshold: float = 2.2,
    progress: Callable[[int, int], None] | None = None,
) -> VectorMethod:
    """Build the method `cnn`, or one of its two relatives with a `code`."""
    network, layer = open_network(config, progress=progress), config.features.layer

    def pooled(images: Sequence[np.ndarray]) -> np.ndarray:
        return pool_cells(network.maps(images)[layer], CELLS)

    provenance = {"weights": network.weights_name, "weights_sha256": network.weights_sha256}
    method = VectorMethod(config, pooled, code=code, provenance=provenance, threshold=threshold)
    method.input_size = network.preprocessing.size
    return method


def cnn_ae(config: Config, *, progress: Callable[[int, int], None] | None = None) -> VectorMethod:
    """Build the method `cnn-ae`: each cell through the bottleneck of an autoencoder, as long as KL's code."""
    from loopclosure.compression.autoencoder import Autoencoder  # loads torch, which its relatives can do without

    rule = config.compression
    if rule.energy is not None or rule.whiten or rule.gamma == "auto":
        raise ConfigError("cnn-ae knows a number for compression.gamma, and compression.components, only")
    code = Autoencoder(gamma=rule.gamma, components=rule.components, seed=config.learning.seed)
    return cnn(config, code=code, threshold=2.45, progress=progress)


def cnn_pca(config: Config, *, progress: Callable[[int, int], None] | None = None) -> VectorMethod:
    """Build the method `cnn-pca`: scikit-learn's PCA of all cells together."""
    code = PooledPCA(**config.compression.model_dump(exclude={"reading"}))
    return cnn(config, code=code, threshold=2.4, progress=progress)


class PooledPCA:
    """scikit-learn's principal components of whole pooled maps.

    Parameters
    ----------
    gamma, energy, components : float or int, optional
        How many components are kept, one rule of the three; never more than frames less one.
    whiten : bool
        Scale every component to unit variance.

    Attributes
    ----------
    mean_ : ndarray of float32, shape (d,)
    basis_ : ndarray of float32, shape (k, d)
    """

    def __init__(
        self,
        *,
        gamma: float | None = None,
        energy: float | None = None,
        components: int | None = None,
        whiten: bool = False,
    ) -> None:
        self.rule: dict[str, Any] = {"gamma": gamma, "energy": energy, "components": components}
        self.whiten = whiten

    def fit(self, features: np.ndarray) -> PooledPCA:
        """Learn the components of features (n, ...), at least two."""
        from sklearn.decomposition import PCA

        rows = features.reshape(len(features), -1).astype(np.float64)
        if len(rows) < 2:
            raise FitError(f"found {len(rows)} frame to fit on, principal components want at least 2")
        most = min(len(rows) - 1, rows.shape[1])
        with np.errstate(invalid="ignore"):  # shares of no variance at all, for equal frames
            pca = PCA(most, svd_solver="full").fit(rows)
        energies = pca.explained_variance_
        k = choose_components(energies, **self.rule, size=rows.shape[1], source=f"{len(rows)} frames")
        scale = whitening(energies[:k], degenerate_below(energies, pca.mean_)) if self.whiten else np.ones(k)
        self.mean_ = pca.mean_.astype(np.float32)
        self.basis_ = (pca.components_[:k] * scale[:, None]).astype(np.float32)
        return self

    def transform(self, features: np.ndarray) -> np.ndarray:
        """Turn features (n, ...) into codes, float32 (n, k)."""
        return (features.reshape(len(features), -1) - self.mean_) @ self.basis_.T

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""
        return {"mean": self.mean_, "basis": self.basis_}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> PooledPCA:
        """Take over what `to_arrays` gave."""
        if not {"mean", "basis"} <= arrays.keys() or arrays["basis"].shape[1:] != arrays["mean"].shape:
            raise ModelError("the saved principal components are damaged: mean and basis do not fit together")
        self.mean_, self.basis_ = arrays["mean"], arrays["basis"]
        return self
