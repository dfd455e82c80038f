"""Truth against a whole matrix of scores, some rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from loopclosure.errors import ConfigError, TruthError
from loopclosure.evaluation.metrics import Reports
from loopclosure.evaluation.truth import Truth

_BLOCK_ROWS = 256


class _Block(NamedTuple):
    """Some rows of scores, and which of their pairs are right and which wrong; the others do not count."""

    rows: slice
    scores: np.ndarray
    right: np.ndarray
    wrong: np.ndarray


def recall_at_n(scores: np.ndarray, truth: Truth, n: int, *, tolerance: int = 0) -> float | None:
    """Return the share of queries with a true match that have one among their `n` best candidates.

    Parameters
    ----------
    scores : ndarray of float, shape (n_queries, n_references)
        Larger = more alike; NaN where masked.
    truth : Truth
        For the same frames.
    n : int
        Candidates a query, at least 1.
    tolerance : int
        Reference frames.

    Returns
    -------
    float or None
        0..1; None where no query has a true match.

    Notes
    -----
    The place of a query is one more than the number of wrong candidates that score at least as high as its best right
    one, so that ties never help. Ignored pairs take no place. (Arandjelovic et al. 2016, section 5.)
    """
    if n < 1:
        raise ConfigError(f"n is {n}, wanted at least 1 candidate")
    with_truth = int((truth.matches_per_query() > 0).sum())
    hits = 0
    for block in _blocks(scores, truth, tolerance):
        right = block.right & np.isfinite(block.scores)
        best = np.where(right, block.scores, -np.inf).max(axis=1, initial=-np.inf)
        ahead = (block.wrong & (block.scores >= best[:, None])).sum(axis=1)
        hits += int((right.any(axis=1) & (ahead < n)).sum())
    return hits / with_truth if with_truth else None


def pair_reports(scores: np.ndarray, truth: Truth, tolerance: int) -> Reports:
    """Return every scored pair as a report; what there is to find are the pairs within the tolerance of a true one."""
    score, right, row = [np.empty(0)], [np.empty(0, dtype=bool)], [np.empty(0, dtype=np.int32)]
    to_find = np.zeros(truth.n_queries, dtype=np.int64)
    for block in _blocks(scores, truth, tolerance):
        told = (block.right | block.wrong) & np.isfinite(block.scores)
        score.append(block.scores[told])
        right.append(block.right[told])
        row.append((block.rows.start + np.nonzero(told)[0]).astype(np.int32))
        to_find[block.rows] = block.right.sum(axis=1)
    return Reports(np.concatenate(score[1:] or score), np.concatenate(right), np.concatenate(row), to_find)


def _blocks(scores: np.ndarray, truth: Truth, tolerance: int) -> Iterator[_Block]:
    if scores.shape != truth.pairs.shape:
        raise TruthError(f"the scores are {scores.shape}, the truth is {truth.pairs.shape}: are they of one sequence?")
    if tolerance < 0:
        raise ConfigError(f"tolerance is {tolerance}, wanted 0 or more frames")
    reference = np.arange(truth.n_references)
    first, last = np.maximum(reference - tolerance, 0), np.minimum(reference + tolerance, len(reference) - 1)
    for start in range(0, truth.n_queries, _BLOCK_ROWS):
        rows = slice(start, min(start + _BLOCK_ROWS, truth.n_queries))
        allowed = truth.allows(np.arange(rows.start, rows.stop)[:, None], reference)
        # A true match lies within the tolerance where their running count rises over the window.
        count = np.zeros((rows.stop - rows.start, len(reference) + 1), dtype=np.int32)
        np.cumsum(truth.pairs[rows].toarray(), axis=1, dtype=np.int32, out=count[:, 1:])
        right = allowed & (count[:, last + 1] > count[:, first])
        yield _Block(rows, scores[rows], right, allowed & ~right & ~truth.ignored[rows].toarray())
