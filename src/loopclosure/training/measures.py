"""What is measured on places that were held out."""

from __future__ import annotations

import numpy as np

from loopclosure.evaluation.metrics import Reports, precision_recall, recall_at_precision
from loopclosure.training.places import SAME, UNKNOWN


def place_measures(vectors: np.ndarray, relation: np.ndarray) -> dict[str, float | None]:
    """Return ``recall_at_1`` and ``recall_at_100_precision`` of each image's most similar other one.

    Parameters
    ----------
    vectors : ndarray of float32, shape (n, d)
        Unit rows.
    relation : ndarray of int8, shape (n, n)
        See `Places.relation`; unknown pairs are no candidates.

    Returns
    -------
    dict
        Of the images that have a partner; None where none has, or precision 1 is not reached.
    """
    similarity = np.where(relation == UNKNOWN, -np.inf, vectors @ vectors.T)
    row = np.arange(len(vectors))
    best = similarity.argmax(axis=1)
    candidate = np.isfinite(similarity[row, best])
    right = (relation[row, best] == SAME) & candidate
    to_find = (relation == SAME).any(axis=1)
    row, best = row[candidate], best[candidate]
    reports = Reports(similarity[row, best], right[row], row, to_find.astype(int))
    return {
        "recall_at_1": float(right[to_find].mean()) if to_find.any() else None,
        "recall_at_100_precision": recall_at_precision(precision_recall(reports), 1.0),
    }


def best_threshold(similarity: np.ndarray, same: np.ndarray) -> float:
    """Return the similarity from which on calling a pair one place is right most often.

    Parameters
    ----------
    similarity : ndarray of float, shape (n,)
    same : ndarray of bool, shape (n,)
    """
    order = np.argsort(-similarity, kind="stable")
    right = np.cumsum(np.where(same[order], 1, -1))
    last_of_tie = np.append(np.flatnonzero(np.diff(similarity[order])), len(order) - 1)
    at = last_of_tie[np.argmax(right[last_of_tie])]
    ranked = similarity[order]
    return float((ranked[at] + ranked[min(at + 1, len(order) - 1)]) / 2)


def pair_accuracy(similarity: np.ndarray, same: np.ndarray, threshold: float) -> float:
    """Return the share of pairs on the right side of `threshold`."""
    return float(((similarity >= threshold) == same).mean())
