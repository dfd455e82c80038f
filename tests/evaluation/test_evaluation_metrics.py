"""Metrics against plain-loop readings of their definitions, and against scikit-learn where the definitions meet."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from sklearn.metrics import average_precision_score, precision_recall_curve

from loopclosure.errors import ConfigError, LoopClosureError, TruthError
from loopclosure.evaluation import (
    LoopLog,
    PrecisionRecall,
    Reports,
    Truth,
    average_precision,
    bootstrap_interval,
    evaluate,
    evaluate_run,
    load_truth,
    precision_recall,
    recall_at_n,
    recall_at_precision,
)

METRICS = {
    "recall_at_100_precision",
    "recall_at_99_precision",
    "recall_at_95_precision",
    "average_precision",
    "recall_at_100_precision_interval",
    "precision",
    "recall",
    "accepted",
    "true_positives",
    "false_positives",
    "rows_with_truth",
    "rows",
    "top1",
    "protocol",
}


def make_log(match, score, accepted=None):
    match = np.asarray(match, dtype=np.int64)
    score = np.where(match >= 0, np.asarray(score, dtype=np.float64), np.nan)
    accepted = match >= 0 if accepted is None else np.asarray(accepted) & (match >= 0)
    return LoopLog(match, score, accepted, np.full(len(match), -1), ("",) * len(match))


def make_truth(pairs, ignored=None, *, one_stream=False, exclude_recent=0):
    pairs = np.asarray(pairs, dtype=bool)
    ignored = np.zeros_like(pairs) if ignored is None else np.asarray(ignored, dtype=bool) & ~pairs
    if one_stream:
        apart = np.subtract.outer(np.arange(len(pairs)), np.arange(len(pairs)))
        pairs, ignored = pairs & (apart >= max(1, exclude_recent)), ignored & (apart >= max(1, exclude_recent))
    return Truth(csr_array(pairs), csr_array(ignored), one_stream, exclude_recent, "made", "all", None, "0" * 64)


@st.composite
def cases(draw):
    """A log with many ties, its truth with ignored cells, and a tolerance."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    one_stream = draw(st.booleans())
    n = draw(st.integers(1, 14))
    m = n if one_stream else draw(st.integers(1, 14))
    exclude = draw(st.integers(0, 4)) if one_stream else 0
    truth = make_truth(
        rng.random((n, m)) < rng.choice([0.0, 0.1, 0.4]),
        rng.random((n, m)) < rng.choice([0.0, 0.2]),
        one_stream=one_stream,
        exclude_recent=exclude,
    )
    match = [int(rng.integers(-1, i if one_stream else m)) for i in range(n)]
    log = make_log(match, rng.integers(0, 5, n) / 4, rng.random(n) < 0.6)
    return log, truth, draw(st.integers(0, 3))


def judge(log, truth, tolerance):
    """Return 'right', 'wrong' or None for each row, by the words of the definition."""
    pairs, ignored = truth.pairs.toarray(), truth.ignored.toarray()
    verdicts = []
    for query, match in enumerate(log.match.tolist()):
        verdict = None
        in_band = truth.one_stream and query - match < max(1, truth.exclude_recent)
        if match >= 0 and not in_band:
            near = [j for j in range(pairs.shape[1]) if pairs[query, j] and abs(j - match) <= tolerance]
            verdict = "right" if near else None if ignored[query, match] else "wrong"
        verdicts.append(verdict)
    return verdicts


def sweep(verdicts, scores, denominator):
    """Return (threshold, precision, recall) at every distinct score of a judged row."""
    points = []
    judged = [(s, v) for s, v in zip(scores, verdicts, strict=True) if v]
    for threshold in sorted({s for s, _ in judged}, reverse=True):
        told = [v for s, v in judged if s >= threshold]
        if denominator:
            points.append((threshold, told.count("right") / len(told), told.count("right") / denominator))
    return points


def best_recall(points, precision):
    return max((r for _, p, r in points if p >= precision), default=None)


def step_area(points):
    area, before = 0.0, 0.0
    for _, precision, recall in points:
        area, before = area + (recall - before) * precision, recall
    return area if points else None


@settings(max_examples=300, deadline=None)
@given(cases(), st.sampled_from(["row", "pair"]))
def test_every_metric_is_its_definition_in_plain_loops(case, level):
    log, truth, tolerance = case
    found, curve = evaluate(log, truth, tolerance=tolerance, level=level, bootstrap=0)
    verdicts = judge(log, truth, tolerance)
    truths = truth.pairs.toarray().sum(axis=1)
    rows_with_truth = sum(1 for count in truths if count)
    denominator = rows_with_truth if level == "row" else int(truths.sum())
    points = sweep(verdicts, log.score.tolist(), denominator)

    assert set(found) == METRICS
    assert [tuple(p) for p in zip(curve.thresholds, curve.precision, curve.recall, strict=True)] == points
    for name, precision in (("100", 1.0), ("99", 0.99), ("95", 0.95)):
        assert found[f"recall_at_{name}_precision"] == best_recall(points, precision)
    assert found["average_precision"] == (None if not points else pytest.approx(step_area(points), abs=1e-12))
    told = [v for v, accepted in zip(verdicts, log.accepted, strict=True) if accepted]
    right, wrong = told.count("right"), told.count("wrong")
    assert (found["true_positives"], found["false_positives"]) == (right, wrong)
    assert found["precision"] == (right / (right + wrong) if right + wrong else None)
    assert found["recall"] == (right / denominator if denominator else None)
    assert (found["rows"], found["rows_with_truth"]) == (len(log), rows_with_truth)
    assert found["top1"] == (verdicts.count("right") / rows_with_truth if rows_with_truth else None)
    band = [truth.one_stream and i - j < max(1, truth.exclude_recent) for i, j in enumerate(log.match.tolist())]
    assert found["accepted"] == sum(a and not b for a, b in zip(log.accepted.tolist(), band, strict=True))


@settings(max_examples=100, deadline=None)
@given(cases())
def test_no_number_leaves_its_range_and_all_go_into_json(case):
    log, truth, tolerance = case
    found, _ = evaluate(log, truth, tolerance=tolerance, bootstrap=20)
    assert json.loads(json.dumps(found, allow_nan=False))["rows"] == len(log)
    for name in ("average_precision", "precision", "recall", "top1", "recall_at_95_precision"):
        assert found[name] is None or 0 <= found[name] <= 1
    interval = found["recall_at_100_precision_interval"]
    assert (interval is None) == (found["recall_at_100_precision"] is None)
    assert interval is None or 0 <= interval[0] <= interval[1] <= 1


@settings(max_examples=100, deadline=None)
@given(cases())
def test_a_restriction_to_rows_is_the_evaluation_of_those_rows(case):
    log, truth, tolerance = case
    if truth.one_stream:  # rows cut out of two traverses are two traverses again
        truth = make_truth(truth.pairs.toarray(), truth.ignored.toarray())
    kept = np.arange(len(log)) % 3 != 1
    part = make_log(log.match[kept], log.score[kept], log.accepted[kept])
    cut = make_truth(truth.pairs.toarray()[kept], truth.ignored.toarray()[kept])
    expected = evaluate(part, cut, tolerance=tolerance, bootstrap=30).metrics
    for queries in (kept, np.flatnonzero(kept)):
        assert evaluate(log, truth, tolerance=tolerance, bootstrap=30, queries=queries).metrics == expected
    assert (
        evaluate(log, truth, tolerance=tolerance, bootstrap=30, queries=slice(None, None, 2)).metrics["rows"]
        == (len(log) + 1) // 2
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_all_pairs_agree_with_scikit_learn(seed, ties):
    rng = np.random.default_rng(seed)
    pairs = rng.random((9, 7)) < 0.3
    pairs[0, 0] = True
    scores = np.round(rng.random((9, 7)), 1 if ties else 9) + 0.3 * pairs
    log = make_log(scores.argmax(axis=1), scores.max(axis=1))
    found, curve = evaluate(log, make_truth(pairs), tolerance=0, level="pair", scores=scores, bootstrap=0)
    precision, recall, thresholds = precision_recall_curve(pairs.ravel(), scores.ravel())
    np.testing.assert_allclose(curve.thresholds, thresholds[::-1])
    np.testing.assert_allclose(curve.precision, precision[-2::-1])
    np.testing.assert_allclose(curve.recall, recall[-2::-1])
    assert found["average_precision"] == pytest.approx(average_precision_score(pairs.ravel(), scores.ravel()))


@settings(max_examples=60, deadline=None)
@given(cases(), st.integers(0, 2**32 - 1))
def test_all_pairs_are_their_definition_in_plain_loops(case, seed):
    log, truth, tolerance = case
    scores = np.random.default_rng(seed).integers(0, 9, truth.pairs.shape) / 8
    scores[:, ::5] = np.nan
    _, curve = evaluate(log, truth, tolerance=tolerance, level="pair", scores=scores, bootstrap=0)
    pairs, ignored = truth.pairs.toarray(), truth.ignored.toarray()
    verdicts, flat, to_find = [], [], 0
    for i, j in np.ndindex(*pairs.shape):
        if truth.one_stream and i - j < max(1, truth.exclude_recent):
            continue
        right = any(pairs[i, k] for k in range(pairs.shape[1]) if abs(k - j) <= tolerance)
        to_find += right
        if not math.isnan(scores[i, j]):
            verdicts.append("right" if right else None if ignored[i, j] else "wrong")
            flat.append(scores[i, j])
    points = [tuple(p) for p in zip(curve.thresholds, curve.precision, curve.recall, strict=True)]
    assert points == sweep(verdicts, flat, to_find)


@settings(max_examples=60, deadline=None)
@given(cases(), st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_recall_at_n_is_its_definition_in_plain_loops(case, seed, n):
    _, truth, tolerance = case
    scores = np.random.default_rng(seed).integers(0, 5, truth.pairs.shape) / 4
    scores[:, 1::4] = np.nan
    pairs, ignored = truth.pairs.toarray(), truth.ignored.toarray()
    hits = total = 0
    for i in range(len(pairs)):
        candidates = []
        for j in range(pairs.shape[1]):
            if math.isnan(scores[i, j]) or (truth.one_stream and i - j < max(1, truth.exclude_recent)):
                continue
            right = any(pairs[i, k] for k in range(pairs.shape[1]) if abs(k - j) <= tolerance)
            if right or not ignored[i, j]:
                candidates.append((-scores[i, j], right))  # among equal scores the wrong ones come first
        total += bool(pairs[i].any())
        hits += any(right for _, right in sorted(candidates)[:n])
    assert recall_at_n(scores, truth, n, tolerance=tolerance) == (hits / total if total else None)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_bootstrap_interval_is_that_of_samples_drawn_one_by_one(seed):
    rng = np.random.default_rng(seed)
    rows, n = 8, 20
    row, right = rng.integers(0, rows, n), rng.random(n) < 0.7
    reports = Reports(rng.integers(0, 6, n) / 5, right, row, np.bincount(row[right], minlength=rows))
    interval = bootstrap_interval(reports, resamples=40, seed=3)
    recalls = []
    for drawn in np.random.default_rng(3).integers(rows, size=(40, rows)):
        told = [(reports.score[k], right[k]) for r in drawn for k in range(n) if row[k] == r]
        to_find = sum(int(reports.to_find[r]) for r in drawn)
        worst = max((s for s, good in told if not good), default=-math.inf)
        if to_find:
            recalls.append(sum(good and s > worst for s, good in told) / to_find)
    if recall_at_precision(precision_recall(reports), 1.0) is None:
        assert interval is None
    else:
        assert interval == pytest.approx(np.quantile(recalls, (0.025, 0.975)), abs=1e-12)


def test_bootstrap_interval_does_not_depend_on_the_block_size(monkeypatch):
    rng = np.random.default_rng(0)
    right = rng.random(200) < 0.9
    reports = Reports(rng.random(200) + right, right, np.arange(200), np.ones(200, dtype=int))
    whole = bootstrap_interval(reports, resamples=50, seed=1)
    monkeypatch.setattr("loopclosure.evaluation.metrics._BLOCK_CELLS", 700)
    assert bootstrap_interval(reports, resamples=50, seed=1) == whole
    assert bootstrap_interval(reports, resamples=50, seed=2) != whole
    assert bootstrap_interval(reports, resamples=0, seed=1) is None


def test_bootstrap_interval_has_the_width_of_the_binomial_where_every_report_is_right():
    right = np.arange(400) < 300
    reports = Reports(np.ones(300), np.ones(300, dtype=bool), np.arange(300), np.ones(400, dtype=int))
    low, high = bootstrap_interval(reports, resamples=2000, seed=0)
    half = 1.96 * np.sqrt(right.mean() * (1 - right.mean()) / 400)
    assert (low, high) == pytest.approx((0.75 - half, 0.75 + half), abs=0.006)


def test_equal_scores_stand_or_fall_together():
    truth = make_truth(np.eye(4))
    found, curve = evaluate(make_log([0, 1, 2, 0], [0.9, 0.5, 0.5, 0.5]), truth, tolerance=0)
    assert curve.thresholds.tolist() == [0.9, 0.5]
    assert found["recall_at_100_precision"] == 0.25  # not 0.5 or 0.75, in whatever order the ties are sorted


def test_what_is_undefined_is_none_and_never_one():
    nothing = evaluate(make_log([-1, -1], [0, 0]), make_truth(np.eye(2)), tolerance=0).metrics
    assert nothing["recall_at_100_precision"] is None
    assert nothing["average_precision"] is None
    assert nothing["precision"] is None
    assert (nothing["recall"], nothing["top1"]) == (0.0, 0.0)

    no_loops = evaluate(make_log([0, 1], [0.5, 0.6]), make_truth(np.zeros((2, 2))), tolerance=0).metrics
    assert (no_loops["precision"], no_loops["recall"], no_loops["top1"]) == (0.0, None, None)
    assert no_loops["false_positives"] == 2

    wrong_first = evaluate(make_log([1, 1], [0.9, 0.5]), make_truth(np.eye(2)), tolerance=0).metrics
    assert wrong_first["recall_at_100_precision"] is None
    assert wrong_first["recall_at_100_precision_interval"] is None
    assert average_precision(PrecisionRecall(*[np.empty(0)] * 3)) is None


def test_zero_rows_are_legal():
    log = LoopLog(np.empty(0, np.int64), np.empty(0), np.empty(0, bool), np.empty(0, np.int64), ())
    found, curve = evaluate(log, make_truth(np.empty((0, 3))), tolerance=1)
    assert (found["rows"], found["top1"], len(curve.recall)) == (0, None, 0)
    assert recall_at_n(np.empty((0, 3)), make_truth(np.empty((0, 3))), 1) is None


def test_an_ignored_match_counts_neither_way_but_its_row_stays_to_be_found():
    pairs, ignored = np.eye(3), np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])
    found = evaluate(make_log([1, 1, 2], [0.9, 0.8, 0.7]), make_truth(pairs, ignored), tolerance=0).metrics
    assert (found["true_positives"], found["false_positives"], found["accepted"]) == (2, 0, 3)
    assert (found["precision"], found["recall"]) == (1.0, pytest.approx(2 / 3))


def test_precision_limits_are_exact():
    right = np.arange(100) != 99
    curve = precision_recall(Reports(np.zeros(100), right, np.arange(100), np.ones(100, int)))
    assert recall_at_precision(curve, 0.99) == 0.99
    assert recall_at_precision(curve, 1.0) is None


@pytest.mark.parametrize(
    ("settings_", "message"),
    [
        ({"tolerance": -1}, "tolerance is -1"),
        ({"tolerance": 0, "level": "frame"}, "wanted row or pair"),
        ({"tolerance": 0, "bootstrap": -5}, "bootstrap is -5"),
        ({"tolerance": 0, "scores": np.zeros((2, 2))}, "wanted level pair"),
        ({"tolerance": 0, "queries": np.array([7])}, "do not select among 2 rows"),
        ({"tolerance": 0, "queries": np.ones(3, dtype=bool)}, "do not select among 2 rows"),
    ],
)
def test_settings_out_of_range(settings_, message):
    with pytest.raises(ConfigError, match=message):
        evaluate(make_log([0, 1], [0.5, 0.5]), make_truth(np.eye(2)), **settings_)


def test_results_and_truth_that_do_not_belong_together():
    with pytest.raises(TruthError, match="truth has 2 queries, the log 1"):
        evaluate(make_log([0], [0.5]), make_truth(np.eye(2)), tolerance=0)
    with pytest.raises(TruthError, match="matches frame 2, but the truth has 2 references"):
        evaluate(make_log([0, 2], [0.5, 0.5]), make_truth(np.eye(2)), tolerance=0)
    with pytest.raises(TruthError, match="frame 0 of the log matches frame 0, wanted an earlier one"):
        evaluate(make_log([0, 0], [0.5, 0.5]), make_truth(np.eye(2), one_stream=True), tolerance=0)
    with pytest.raises(TruthError, match="scores are"):
        recall_at_n(np.zeros((3, 2)), make_truth(np.eye(2)), 1)
    with pytest.raises(ConfigError, match="n is 0"):
        recall_at_n(np.zeros((2, 2)), make_truth(np.eye(2)), 0)
    with pytest.raises(ConfigError, match="tolerance is -1"):
        recall_at_n(np.zeros((2, 2)), make_truth(np.eye(2)), 1, tolerance=-1)


# A run folder


def write_run(folder, rows, facts=None):
    folder.mkdir()
    lines = ["query,match,score,accepted,inliers,reason"]
    lines += [f"{i},{'' if m is None else m},{'' if m is None else s},{a},," for i, (m, s, a) in enumerate(rows)]
    (folder / "loops.csv").write_text("\n".join(lines) + "\n")
    if facts is not None:
        (folder / "run.json").write_text(json.dumps(facts))
    return folder


ROWS = [(None, 0, "false"), (0, 0.9, "true"), (0, 0.4, "false"), (1, 0.8, "true")]


def test_a_run_folder_brings_its_own_mode_and_exclusion_band(tmp_path):
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\n1,0\n3,1\n")
    plain = evaluate_run(write_run(tmp_path / "plain", ROWS), truth, tolerance=0).metrics
    assert (plain["true_positives"], plain["rows_with_truth"]) == (2, 2)
    assert plain["protocol"]["mode"] == "one stream"
    assert plain["protocol"]["exclusion"] == 0
    facts = {"frames": 4, "references": None, "config": {"sequence": {"exclude_recent": 2}}}
    run = write_run(tmp_path / "banded", ROWS, facts)
    for source in (run, run / "loops.csv"):
        banded = evaluate_run(source, truth, tolerance=0).metrics
        assert (banded["true_positives"], banded["rows_with_truth"], banded["accepted"]) == (1, 1, 1)
        assert banded["protocol"]["exclusion"] == 2
    given_band = evaluate_run(run, truth, tolerance=0, exclude_recent=0).metrics
    assert given_band["rows_with_truth"] == 2


def test_a_run_of_two_traverses_has_no_band(tmp_path):
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\n1,0\n0,6\n")
    facts = {"frames": 4, "references": 7, "config": {"sequence": {"exclude_recent": 30}}}
    found, _ = evaluate_run(write_run(tmp_path / "run", ROWS, facts), truth, tolerance=0)
    assert found["protocol"]["mode"] == "two traverses"
    assert (found["true_positives"], found["false_positives"], found["rows_with_truth"]) == (1, 1, 2)
    told = evaluate_run(tmp_path / "run" / "loops.csv", truth, tolerance=0, references=7).metrics
    assert told == found
    with pytest.raises(LoopClosureError, match="has 7 reference frames, but 5 were asked for"):
        evaluate_run(tmp_path / "run", truth, tolerance=0, references=5)


def test_the_protocol_tells_every_rule(tmp_path):
    poses = tmp_path / "poses.csv"
    poses.write_text("frame,x,y\n0,0,0\n1,5,0\n2,0,1\n3,5,1\n")
    found = evaluate_run(
        write_run(tmp_path / "run", ROWS), poses, tolerance=1, radius_m=2, exclude_recent=2, level="pair"
    ).metrics
    protocol = found["protocol"]
    assert len(protocol.pop("truth_hash")) == 64
    assert protocol == {
        "level": "pair",
        "scored": "best match of each row",
        "tolerance": 1,
        "exclusion": 2,
        "view": "all",
        "mode": "one stream",
        "truth_form": "poses csv",
        "radius_m": 2.0,
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not readable JSON"),
        ("[]", "holds list, wanted an object"),
        ('{"frames": 5}', "tells of 5 frames, the log has 4 rows"),
        ('{"frames": "many"}', "frames is 'many', wanted a number"),
        ('{"config": {"sequence": {"exclude_recent": -2}}}', "exclude_recent is -2"),
        ("[" * 100_000, "not readable JSON"),
    ],
)
def test_a_damaged_run_file(tmp_path, text, message):
    run = write_run(tmp_path / "run", ROWS)
    (run / "run.json").write_text(text)
    (tmp_path / "truth.csv").write_text("query,match\n1,0\n")
    with pytest.raises(LoopClosureError, match=message) as caught:
        evaluate_run(run, tmp_path / "truth.csv", tolerance=0)
    assert "\n" not in str(caught.value)


def test_a_perfect_log_of_a_real_truth_finds_everything(data_folder):
    truth = load_truth(data_folder / "ground_truth" / "city_GT_final.mat", exclude_recent=50)
    starts, matches = truth.pairs.indptr, truth.pairs.indices
    match = [int(matches[a]) if b > a else -1 for a, b in itertools.pairwise(starts)]
    found, _ = evaluate(make_log(match, np.ones(len(match))), truth, tolerance=0)
    assert (found["true_positives"], found["rows_with_truth"], found["rows"]) == (551, 551, 1237)
    assert found["recall_at_100_precision"] == 1.0
    assert found["recall_at_100_precision_interval"] == (1.0, 1.0)
    capped, _ = evaluate(make_log(match, np.ones(len(match))), truth, tolerance=0, level="pair")
    assert capped["recall"] == pytest.approx(551 / 8321)
