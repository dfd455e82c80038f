"""The two losses, by pytorch-metric-learning, and the choice of what is hard."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from loopclosure.errors import ConfigError
from loopclosure.training.places import DIFFERENT, SAME

try:
    from pytorch_metric_learning import distances, losses, reducers
except ImportError:
    raise ConfigError("training needs pytorch-metric-learning; pip install 'loopclosure[train]'") from None

Pairs = tuple[np.ndarray, np.ndarray]
"""Rows of the first and of the second image of each pair."""


class ContrastiveLoss:
    """Pull pairs of one place together, push pairs of two apart up to a margin (paper 2.1; Hadsell et al. 2006).

    ``mean over same of d + mean over different of max(0, margin - d)``, on vectors of length 1, with d their distance
    or, for ``cosine``, one minus their cosine. The means are over what is not zero, so that two places that are far
    enough apart do not thin out the others.

    Parameters
    ----------
    margin : float
        Distance from which on two places are far enough apart.
    distance : {'euclidean', 'cosine'}
        What d is.
    """

    def __init__(self, margin: float, distance: Literal["euclidean", "cosine"] = "euclidean") -> None:
        if distance == "cosine":
            self._loss = losses.ContrastiveLoss(1, 1 - margin, distance=distances.CosineSimilarity())
        else:
            self._loss = losses.ContrastiveLoss(0, margin, distance=distances.LpDistance())

    def __call__(self, vectors: torch.Tensor, same: Pairs, different: Pairs) -> torch.Tensor:
        """Return the loss of pairs of rows of `vectors`, float (n, d)."""
        # The library takes a single pair for none; twice the same pair has the same mean.
        listed = (np.repeat(rows, 2) if len(rows) == 1 else rows for rows in (*same, *different))
        chosen = tuple(torch.from_numpy(rows).to(vectors.device) for rows in listed)
        return self._loss(vectors, indices_tuple=chosen)


class TripletRankingLoss:
    """Weakly supervised triplet ranking loss (Arandjelovic et al. 2016, Eq. 7).

    ``sum over negatives n of max(0, |q - p|^2 + margin - |q - n|^2)``, mean over queries, where p is the best of the
    potential positives.

    Parameters
    ----------
    margin : float
        Of squared distances.
    """

    def __init__(self, margin: float) -> None:
        # Of vectors of length 1, |a - b|^2 = 2 - 2 a.b: exact for near ones, where a difference of norms is not.
        self._loss = losses.TripletMarginLoss(
            margin=margin / 2,
            distance=distances.DotProductSimilarity(normalize_embeddings=False),
            reducer=reducers.SumReducer(),
        )

    def __call__(self, vectors: torch.Tensor, triplets: np.ndarray) -> torch.Tensor:
        """Return the loss of triplets (m, 3) of rows of `vectors`, float (n, d), unit: query, positive, negative."""
        chosen = tuple(torch.from_numpy(rows.copy()).to(vectors.device) for rows in triplets.T)
        return 2 * self._loss(vectors, indices_tuple=chosen) / len(np.unique(triplets[:, 0]))


def hardest_pairs(vectors: np.ndarray, relation: np.ndarray, *, most: int | None) -> tuple[Pairs, Pairs]:
    """Choose the `most` least alike pairs of one place and the `most` most alike pairs of two; None for all.

    Parameters
    ----------
    vectors : ndarray of float32, shape (n, d)
        Unit rows.
    relation : ndarray of int8, shape (n, n)
        See `Places.relation`.

    Returns
    -------
    same, different : Pairs
        Each pair once, the hardest first.
    """
    similarity = vectors @ vectors.T
    upper = np.triu(np.ones(relation.shape, bool), 1)
    chosen = []
    for kind, sign in ((SAME, 1), (DIFFERENT, -1)):
        first, second = np.nonzero(upper & (relation == kind))
        order = np.argsort(sign * similarity[first, second], kind="stable")[:most]
        chosen.append((first[order], second[order]))
    return chosen[0], chosen[1]


def hardest_triplets(
    query: int, similarity: np.ndarray, relation: np.ndarray, *, negatives: int, margin: float
) -> np.ndarray:
    """Choose the best potential positive of a query and its hardest negatives that violate the margin.

    Parameters
    ----------
    query : int
        Row of the query.
    similarity : ndarray of float32, shape (n,)
        Dot product of the query's unit descriptor with each other.
    relation : ndarray of int8, shape (n,)
        See `Places.relation`.
    negatives : int
        At most so many.
    margin : float
        Of squared distances.

    Returns
    -------
    ndarray of int64, shape (m, 3)
        Rows of query, positive, negative; the hardest first; none where nothing violates the margin.
    """
    positives, others = np.flatnonzero(relation == SAME), np.flatnonzero(relation == DIFFERENT)
    if not len(positives):
        return np.empty((0, 3), np.int64)
    best = positives[np.argmax(similarity[positives])]
    hard = others[np.argsort(-similarity[others], kind="stable")[:negatives]]
    hard = hard[similarity[hard] > similarity[best] - margin / 2]
    return np.stack([np.full_like(hard, query), np.full_like(hard, best), hard], axis=1)
