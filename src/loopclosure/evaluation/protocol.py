"""A run against its truth: the numbers of ``metrics.json`` and the rules under which they hold."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from loopclosure.errors import ConfigError, TruthError
from loopclosure.evaluation.log import LoopLog
from loopclosure.evaluation.metrics import (
    PrecisionRecall,
    Reports,
    average_precision,
    bootstrap_interval,
    precision_recall,
    recall_at_precision,
)
from loopclosure.evaluation.pairs import pair_reports
from loopclosure.evaluation.truth import Truth

Level = Literal["row", "pair"]


class Evaluation(NamedTuple):
    """Result of `evaluate`.

    Attributes
    ----------
    metrics : dict
        Content of ``metrics.json``; what is undefined is None.
    curve : PrecisionRecall
        What the figures at a given precision were read from.
    """

    metrics: dict[str, Any]
    curve: PrecisionRecall


class _Judged(NamedTuple):
    """What truth says of each row's match, bool (n,) each: is it a candidate at all, is it right, is it wrong."""

    candidate: np.ndarray
    right: np.ndarray
    wrong: np.ndarray


def evaluate(
    log: LoopLog,
    truth: Truth,
    *,
    tolerance: int,
    level: Level = "row",
    scores: np.ndarray | None = None,
    queries: slice | np.ndarray | None = None,
    bootstrap: int = 1000,
    seed: int = 0,
) -> Evaluation:
    """Measure a log against truth.

    Parameters
    ----------
    log : LoopLog
        Best candidate of every frame.
    truth : Truth
        For the same frames.
    tolerance : int
        A match within so many reference frames of a true match of its query is right.
    level : {'row', 'pair'}
        What recall counts: frames that have a true match, or true pairs. One match a frame caps the second.
    scores : ndarray of float, shape (n_queries, n_references), optional
        At level ``pair`` alone: rank all pairs instead of the best of each row; NaN where masked. Here the true pairs
        to be found are those within the tolerance.
    queries : slice or ndarray, optional
        Rows that count; default all.
    bootstrap : int
        Resamples behind ``recall_at_100_precision_interval``; 0 gives none.
    seed : int
        Of the resampling.

    Returns
    -------
    Evaluation

    Raises
    ------
    TruthError
        If the log and the truth do not belong together.
    ConfigError
        If a setting is out of range.

    Notes
    -----
    A row is a true positive if its match is true within the tolerance and a false positive if it is not, whether or not
    the row has a true match. A match that the truth marks as ignored is neither, and its row stays among those that
    should have been found: the denominator depends on the truth alone. A match inside the exclusion band of the truth
    is no candidate.
    """
    _check_settings(tolerance, level, scores, bootstrap)
    _check_belong(log, truth)
    counted = _selected(len(log), queries)
    with_truth = counted & (truth.matches_per_query() > 0)
    judged = _judge(log, truth, tolerance)
    best = _best_of_rows(log, truth, judged, level)
    reports = _only(best if scores is None else pair_reports(scores, truth, tolerance), counted)
    curve = precision_recall(reports)
    reported = log.accepted & counted
    found, false = int((judged.right & reported).sum()), int((judged.wrong & reported).sum())
    metrics = {
        "recall_at_100_precision": recall_at_precision(curve, 1.0),
        "recall_at_99_precision": recall_at_precision(curve, 0.99),
        "recall_at_95_precision": recall_at_precision(curve, 0.95),
        "average_precision": average_precision(curve),
        "recall_at_100_precision_interval": bootstrap_interval(reports, resamples=bootstrap, seed=seed),
        "precision": _share(found, found + false),
        "recall": _share(found, int(best.to_find[counted].sum())),
        "accepted": int((judged.candidate & reported).sum()),
        "true_positives": found,
        "false_positives": false,
        "rows_with_truth": int(with_truth.sum()),
        "rows": int(counted.sum()),
        "top1": _share(int((judged.right & with_truth).sum()), int(with_truth.sum())),
        "protocol": _protocol(truth, tolerance, level, all_pairs=scores is not None),
    }
    return Evaluation(metrics, curve)


def _selected(rows: int, queries: slice | np.ndarray | None) -> np.ndarray:
    selected = np.zeros(rows, dtype=bool)
    try:
        selected[slice(None) if queries is None else queries] = True
    except IndexError as error:
        raise ConfigError(f"queries do not select among {rows} rows: {error}") from None
    return selected


def _judge(log: LoopLog, truth: Truth, tolerance: int) -> _Judged:
    candidate = (log.match >= 0) & truth.allows(np.arange(len(log)), log.match)
    right, wrong = np.zeros_like(candidate), np.zeros_like(candidate)
    query = np.flatnonzero(candidate)
    match = log.match[query]
    right[query] = truth.frames_off(query, match) <= tolerance
    wrong[query] = ~right[query] & ~truth.is_ignored(query, match)
    return _Judged(candidate, right, wrong)


def _best_of_rows(log: LoopLog, truth: Truth, judged: _Judged, level: Level) -> Reports:
    row = np.flatnonzero(judged.right | judged.wrong)
    matches = truth.matches_per_query()
    return Reports(log.score[row], judged.right[row], row, matches if level == "pair" else np.minimum(matches, 1))


def _only(reports: Reports, counted: np.ndarray) -> Reports:
    """Keep the rows that count, and number them anew so that no others are resampled."""
    if counted.all():
        return reports
    kept = counted[reports.row]
    number = np.cumsum(counted) - 1
    return Reports(reports.score[kept], reports.right[kept], number[reports.row[kept]], reports.to_find[counted])


def _check_settings(tolerance: int, level: str, scores: np.ndarray | None, bootstrap: int) -> None:
    if tolerance < 0:
        raise ConfigError(f"tolerance is {tolerance}, wanted 0 or more frames")
    if level not in ("row", "pair"):
        raise ConfigError(f"level is '{level}', wanted row or pair")
    if scores is not None and level != "pair":
        raise ConfigError("a matrix of scores was given at level row, wanted level pair: a row reports one match")
    if bootstrap < 0:
        raise ConfigError(f"bootstrap is {bootstrap}, wanted 0 or more resamples")


def _check_belong(log: LoopLog, truth: Truth) -> None:
    if len(log) != truth.n_queries:
        raise TruthError(f"the truth has {truth.n_queries} queries, the log {len(log)}: are they of one sequence?")
    if truth.one_stream:
        late = log.match >= np.arange(len(log))
        if late.any():
            query = int(np.argmax(late))
            raise TruthError(
                f"frame {query} of the log matches frame {log.match[query]}, wanted an earlier one: "
                "is it a run of two traverses? then say how many references it has"
            )
    elif log.match.max(initial=-1) >= truth.n_references:
        raise TruthError(f"the log matches frame {log.match.max()}, but the truth has {truth.n_references} references")


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _protocol(truth: Truth, tolerance: int, level: Level, *, all_pairs: bool) -> dict[str, Any]:
    return {
        "level": level,
        "scored": "all pairs" if all_pairs else "best match of each row",
        "tolerance": tolerance,
        "exclusion": truth.exclude_recent,
        "view": truth.view,
        "mode": "one stream" if truth.one_stream else "two traverses",
        "truth_form": truth.form,
        "truth_hash": truth.sha256,
        "radius_m": truth.radius_m,
    }
