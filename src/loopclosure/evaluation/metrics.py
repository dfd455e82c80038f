"""From ranked reports to numbers: precision, recall, and how far they can be trusted.

Every distinct score is a threshold and equal scores fall together. What is undefined is None: a precision of 1 that was
reached by reporting nothing is not a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_BLOCK_CELLS = 1 << 22


@dataclass(frozen=True, eq=False)
class Reports:
    """What can be reported, and what there is to find.

    Attributes
    ----------
    score : ndarray of float, shape (n,)
        Larger = reported earlier.
    right : ndarray of bool, shape (n,)
        Whether the report is a true one.
    row : ndarray of int, shape (n,)
        Query row it belongs to.
    to_find : ndarray of int, shape (rows,)
        True things in each row; their sum is the denominator of recall.
    """

    score: np.ndarray
    right: np.ndarray
    row: np.ndarray
    to_find: np.ndarray

    @property
    def total(self) -> int:
        """Denominator of recall."""
        return int(self.to_find.sum())


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall at every distinct score, from the strictest threshold to the most generous.

    Attributes
    ----------
    thresholds : ndarray of float64, shape (t,)
        Distinct scores, falling; reports of at least this score count.
    precision : ndarray of float64, shape (t,)
        Share of the reports that are right, 0..1.
    recall : ndarray of float64, shape (t,)
        Share of what there is to find that is found, 0..1, never falling.

    Notes
    -----
    There are no points where nothing was reported or nothing is to be found.
    """

    thresholds: np.ndarray
    precision: np.ndarray
    recall: np.ndarray


def precision_recall(reports: Reports) -> PrecisionRecall:
    """Sweep every distinct score.

    Examples
    --------
    >>> import numpy as np
    >>> score, right = np.array([0.9, 0.8, 0.8, 0.1]), np.array([True, True, False, True])
    >>> curve = precision_recall(Reports(score, right, np.arange(4), np.ones(4, int)))
    >>> curve.thresholds.tolist(), curve.recall.tolist()
    ([0.9, 0.8, 0.1], [0.25, 0.5, 0.75])
    """
    if not len(reports.score) or not reports.total:
        nothing = np.empty(0)
        return PrecisionRecall(nothing, nothing, nothing)
    order = np.argsort(-reports.score)
    score = reports.score[order]
    last_of_tie = np.append(np.flatnonzero(np.diff(score)), len(score) - 1)
    found = np.cumsum(reports.right[order])[last_of_tie]
    return PrecisionRecall(
        thresholds=score[last_of_tie].astype(np.float64),
        precision=found / (last_of_tie + 1),
        recall=found / reports.total,
    )


def recall_at_precision(curve: PrecisionRecall, precision: float) -> float | None:
    """Return the best recall of any threshold whose precision is at least `precision`; None where there is none."""
    reached = curve.recall[curve.precision >= precision]
    return float(reached.max()) if len(reached) else None


def average_precision(curve: PrecisionRecall) -> float | None:
    """Return the area under the curve as a sum of steps; None where the curve has no points.

    Notes
    -----
    AP = sum_i (R_i - R_{i-1}) P_i with R_0 = 0 and no interpolation. Where the last threshold leaves something unfound,
    the part that was never found adds nothing.
    """
    if not len(curve.recall):
        return None
    return float(np.sum(np.diff(curve.recall, prepend=0.0) * curve.precision))


def bootstrap_interval(reports: Reports, *, resamples: int, seed: int) -> tuple[float, float] | None:
    """Return the 95 % interval of recall at 100 % precision over resampled query rows.

    Parameters
    ----------
    reports : Reports
        Each row is drawn with all its reports.
    resamples : int
        Number of bootstrap samples, each of as many rows as there are.
    seed : int
        The same seed gives the same interval.

    Returns
    -------
    tuple of two floats or None
        2.5 % and 97.5 % quantiles; None where recall at 100 % precision is undefined. A resample whose best report is a
        false one counts as recall 0; one without anything to find is left out.

    Notes
    -----
    Neighbouring frames of a drive are not independent, so the true interval is wider than this one.
    """
    score, row, rows = reports.score[reports.right], reports.row[reports.right], len(reports.to_find)
    false_score, false_row = reports.score[~reports.right], reports.row[~reports.right]
    if not resamples or not score.max(initial=-np.inf) > false_score.max(initial=-np.inf):
        return None
    best_false = np.full(rows, -np.inf, dtype=score.dtype)
    np.maximum.at(best_false, false_row, false_score)
    rng = np.random.default_rng(seed)
    recalls = []
    for start in range(0, resamples, step := max(1, _BLOCK_CELLS // rows)):
        weight = _draw_rows(rng, min(step, resamples - start), rows)
        # Precision is 1 exactly above the best false report that was drawn. There are few such levels, because the
        # highest false reports of all are drawn in most samples.
        level = np.where(weight > 0, best_false, -np.inf).max(axis=1)
        found = np.empty(len(weight))
        for value in np.unique(level):
            found[level == value] = weight[level == value] @ np.bincount(row[score > value], minlength=rows)
        to_find = weight @ reports.to_find
        recalls.append(found[to_find > 0] / to_find[to_find > 0])
    every = np.concatenate(recalls)
    return (float(np.quantile(every, 0.025)), float(np.quantile(every, 0.975))) if len(every) else None


def _draw_rows(rng: np.random.Generator, samples: int, rows: int) -> np.ndarray:
    """Return how often each row is drawn into each sample, float64 (samples, rows)."""
    drawn = rng.integers(rows, size=(samples, rows)) + rows * np.arange(samples)[:, None]
    return np.bincount(drawn.ravel(), minlength=samples * rows).reshape(samples, rows).astype(np.float64)
