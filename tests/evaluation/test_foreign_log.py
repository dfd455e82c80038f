"""A log that another program wrote is scored as the usual published rule says, read in plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.evaluation import evaluate_run


@pytest.mark.parametrize("tolerance", [0, 1, 2, 5, 40])
def test_scored_by_the_published_rule(tmp_path, tolerance):
    rng = np.random.default_rng(7)
    frames = 400
    truth = np.zeros((frames, frames), np.uint8)
    for query in range(200, 400):
        if rng.random() < 0.8:
            truth[query, query - 200 + int(rng.integers(-2, 3))] = 1
    np.save(tmp_path / "truth.npy", truth)
    rows = [(q, max(0, q - 200 + int(rng.integers(-6, 7))), round(rng.random(), 2)) for q in range(150, 400)]
    (tmp_path / "log.csv").write_text(
        "query,match,score\n" + "".join(f"{q},,\n" for q in range(150)) + "".join(f"{q},{m},{s}\n" for q, m, s in rows)
    )
    right = [any(truth[q, j] for j in range(max(0, m - tolerance), min(frames, m + tolerance + 1))) for q, m, _ in rows]
    positives = int(truth.any(1).sum())
    wanted = None
    for threshold in sorted({score for *_, score in rows}):
        kept = [hit for hit, (*_, score) in zip(right, rows, strict=True) if score >= threshold]
        if all(kept):
            wanted = max(wanted or 0, sum(kept) / positives)
    metrics, _ = evaluate_run(tmp_path / "log.csv", tmp_path / "truth.npy", tolerance=tolerance, bootstrap=0)
    assert metrics["recall"] == pytest.approx(sum(right) / positives)
    assert metrics["precision"] == pytest.approx(sum(right) / len(rows))
    assert metrics["recall_at_100_precision"] == (None if wanted is None else pytest.approx(wanted))
