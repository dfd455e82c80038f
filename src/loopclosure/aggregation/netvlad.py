"""NetVLAD (paper 2.3, Eq. 19) as matrix products in numpy, for running; `netvlad_torch` holds the trainable twin."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import numpy as np

from loopclosure.errors import FitError

_SAMPLES = 20_000  # local vectors that k-means sees
_SMALLEST_GAP = 1e-6


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale the last axis to length 1; a zero vector stays zero.

    Parameters
    ----------
    vectors : ndarray of float, shape (..., d)

    Returns
    -------
    ndarray of float, shape (..., d)
    """
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, norms, out=np.zeros_like(vectors), where=norms > 0)


class NetVLAD:
    """Residuals of local vectors to softly assigned clusters, one descriptor an image.

    ``V(k, j) = sum_i a_k(y_i) (y_i(j) - c_k(j))`` with ``a`` a softmax over clusters; each cluster's residual is
    scaled to length 1 (intra-normalisation), the K x D matrix is flattened cluster by cluster and scaled to length 1.
    Local vectors are scaled to length 1 first.

    Parameters
    ----------
    clusters : int
        Number of clusters K.
    seed : int
        Of the k-means start and of the sample that it sees.

    Attributes
    ----------
    centres_ : ndarray of float32, shape (K, D)
        Cluster centres c.
    weights_, bias_ : ndarray of float32, shapes (K, D) and (K,)
        The softmax takes ``weights_ @ y + bias_``; after `fit` they are ``2 alpha c`` and ``-alpha |c|^2``, after
        training they are free.

    References
    ----------
    Arandjelovic et al., "NetVLAD: CNN architecture for weakly supervised place recognition", CVPR 2016, Eq. 3 and 4;
    Jiang et al. 2024, Eq. 19.

    Examples
    --------
    >>> maps = np.random.default_rng(0).normal(size=(4, 7, 7, 16)).astype(np.float32)
    >>> NetVLAD(clusters=8).fit(maps).transform(maps).shape
    (4, 128)
    """

    def __init__(self, clusters: int = 64, *, seed: int = 0) -> None:
        self.clusters = clusters
        self.seed = seed

    def fit(self, maps: np.ndarray) -> NetVLAD:
        """Learn the clusters by k-means and the sharpness alpha of the assignment.

        alpha = -ln(0.01) / mean(best - second-best similarity): on average the second cluster gets a hundredth of the
        first one's weight.

        Parameters
        ----------
        maps : ndarray of float, shape (n, h, w, D) or (n, D)
            Local vectors along the last axis.

        Raises
        ------
        FitError
            If there are fewer local vectors than clusters.
        """
        from sklearn.cluster import KMeans
        from sklearn.exceptions import ConvergenceWarning

        vectors = unit(np.asarray(maps, np.float32).reshape(-1, maps.shape[-1]))
        if len(vectors) < self.clusters:
            raise FitError(
                f"{len(vectors)} local vectors cannot make {self.clusters} clusters; fit on more images "
                "or set aggregation.clusters lower"
            )
        if len(vectors) > _SAMPLES:
            rows = np.random.default_rng(self.seed).choice(len(vectors), _SAMPLES, replace=False)
            vectors = vectors[np.sort(rows)]
        with warnings.catch_warnings():  # blank images have fewer distinct vectors than clusters: legal
            warnings.simplefilter("ignore", ConvergenceWarning)
            kmeans = KMeans(self.clusters, n_init=1, max_iter=50, random_state=self.seed).fit(vectors)
        self.centres_ = kmeans.cluster_centers_.astype(np.float32)
        similarity = 2 * vectors @ self.centres_.T - np.square(self.centres_).sum(1)
        alpha = -math.log(0.01) / max(_mean_gap(similarity), _SMALLEST_GAP)
        self.weights_ = 2 * alpha * self.centres_
        self.bias_ = -alpha * np.square(self.centres_).sum(1)
        return self

    def transform(self, maps: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Describe each image.

        Parameters
        ----------
        maps : ndarray of float, shape (n, h, w, D)
        weights : ndarray of float32, shape (n, h, w), optional
            What each position counts; all the same by default.

        Returns
        -------
        ndarray of float32, shape (n, K * D)
            Unit rows; zeros for an image whose local vectors are all zero.

        Raises
        ------
        FitError
            If nothing was fitted, or for another D.
        """
        if not hasattr(self, "centres_"):
            raise FitError("NetVLAD has no clusters yet; call fit first")
        clusters, depth = self.centres_.shape
        if maps.shape[-1] != depth:
            raise FitError(
                f"local vectors have {maps.shape[-1]} dimensions, the clusters {depth}; "
                "were they made by the same model?"
            )
        local = unit(np.asarray(maps, np.float32).reshape(len(maps), maps.shape[1] * maps.shape[2], depth))
        assignment = _softmax(local @ self.weights_.T + self.bias_)
        if weights is not None:
            assignment *= weights.reshape(len(maps), -1, 1)
        residuals = assignment.transpose(0, 2, 1) @ local
        residuals -= assignment.sum(1)[:, :, None] * self.centres_
        blank = ~local.any(axis=(1, 2))
        residuals[blank] = 0
        return unit(unit(residuals).reshape(len(maps), clusters * depth))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        return {"centres": self.centres_, "weights": self.weights_, "bias": self.bias_}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], *, seed: int = 0) -> NetVLAD:
        """Rebuild a fitted layer from `to_arrays`."""
        layer = cls(len(arrays["centres"]), seed=seed)
        layer.centres_, layer.weights_, layer.bias_ = arrays["centres"], arrays["weights"], arrays["bias"]
        return layer


def _mean_gap(similarity: np.ndarray) -> float:
    if similarity.shape[1] < 2:
        return 1.0
    best_two = np.partition(similarity, -2, axis=1)[:, -2:]
    return float(np.abs(best_two[:, 1] - best_two[:, 0]).mean())


def _softmax(logits: np.ndarray) -> np.ndarray:
    logits -= logits.max(-1, keepdims=True)
    np.exp(logits, out=logits)
    logits /= logits.sum(-1, keepdims=True)
    return logits
