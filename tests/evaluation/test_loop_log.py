"""The run log: what is read, and what is refused."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from loopclosure.errors import LoopClosureError
from loopclosure.evaluation import LOOPS_HEADER, LoopLog, read_loops
from loopclosure.records import Decision, Reason

DECISIONS = [
    Decision(0, None, None, False, None, Reason.TOO_RECENT),
    Decision(1, 0, 0.25, False, None, Reason.BELOW_THRESHOLD),
    Decision(2, 1, 0.75, True, 31, Reason.ACCEPTED),
]


def assert_same(one, other):
    for name in ("match", "score", "accepted", "inliers"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(one, name).dtype == getattr(other, name).dtype
    assert one.reason == other.reason


def test_a_log_read_back_is_the_log_of_the_decisions(tmp_path):
    with (tmp_path / "loops.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(LOOPS_HEADER)
        for d in DECISIONS:
            writer.writerow([d.query, d.match, d.score, str(d.accepted).lower(), d.inliers, d.reason])
    log = LoopLog.from_decisions(DECISIONS)
    assert log.match.tolist() == [-1, 0, 1]
    assert log.inliers.tolist() == [-1, -1, 31]
    assert_same(read_loops(tmp_path), log)
    assert_same(read_loops(tmp_path / "loops.csv"), log)


def test_three_columns_are_enough_and_then_every_match_counts_as_accepted(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("\ufeffscore , query,match\n,0,\n0.5,1,0\n\n0.25,2,0\n")
    log = read_loops(path)
    assert (log.match.tolist(), log.accepted.tolist()) == ([-1, 0, 0], [False, True, True])
    assert np.isnan(log.score[0])
    assert log.score[1:].tolist() == [0.5, 0.25]
    assert log.reason == ("", "", "")


def test_a_log_without_rows_is_legal(tmp_path):
    (tmp_path / "loops.csv").write_text(",".join(LOOPS_HEADER) + "\n")
    assert len(read_loops(tmp_path)) == 0
    assert len(LoopLog.from_decisions([])) == 0


@pytest.mark.parametrize("word", ["true", "True", "1"])
def test_words_for_accepted(tmp_path, word):
    (tmp_path / "loops.csv").write_text(f"query,match,score,accepted\n0,,,false\n1,0,0.5,{word}\n2,0,0.5,0\n")
    assert read_loops(tmp_path).accepted.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty, wanted the header query,match,score,accepted,inliers,reason"),
        ("query,match\n0,\n", "has the columns 'query,match', wanted at least query,match,score"),
        ("query,match,score\n1,0,0.5\n", "row 0 speaks of frame 1, wanted 0: one row a frame"),
        ("query,match,score\n0,,\n0,,\n", "row 1 speaks of frame 0, wanted 1"),
        ("query,match,score\n,,\n", "row 0 speaks of frame -1"),
        ("query,match,score\n0,,\n1,0\n", "line 3: 2 cells under 3 columns"),
        ("query,match,score\n0,x,1\n", "line 2: match is 'x'"),
        ("query,match,score\n0,-1,1\n", "line 2: match is '-1'"),
        ("query,match,score\n0,99999999999999999999,1\n", "line 2: match is '9999"),
        ("query,match,score\n0,,\n1,0,high\n", "line 3: score is 'high'"),
        ("query,match,score\n0,,\n1,0,nan\n", "frame 1 of the log: a match without a finite score"),
        ("query,match,score\n0,,\n1,0,\n", "frame 1 of the log: a match without a finite score"),
        ("query,match,score\n0,,\n1,0,1e999\n", "frame 1 of the log: a match without a finite score"),
        ("query,match,score\n0,,0.5\n", "frame 0 of the log: a score without a match"),
        ("query,match,score,accepted\n0,,,yes\n", "line 2: accepted is 'yes'"),
        ("query,match,score,accepted\n0,,,true\n", "frame 0 of the log: is accepted, but has no match"),
        ("query,match,score,inliers\n0,,,many\n", "line 2: inliers is 'many'"),
        (b"\xff\xfe", "is not a CSV file"),
        ("query,match,score\n0,," + "9" * 200_000, "is not a CSV file: field larger"),
    ],
)
def test_bad_logs(tmp_path, text, message):
    path = tmp_path / "loops.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(LoopClosureError, match=message) as caught:
        read_loops(path)
    assert "\n" not in str(caught.value)


def test_logs_that_are_not_there_or_too_large(tmp_path, monkeypatch):
    with pytest.raises(LoopClosureError, match=r"cannot read the run log .*loops\.csv: No such file"):
        read_loops(tmp_path)
    (tmp_path / "loops.csv").write_text("query,match,score\n")
    monkeypatch.setattr("loopclosure.evaluation.log.MAX_LOG_BYTES", 3)
    with pytest.raises(LoopClosureError, match="larger than 3 bytes"):
        read_loops(tmp_path)


def test_decisions_out_of_order():
    with pytest.raises(LoopClosureError, match="the decisions: row 0 speaks of frame 2, wanted 0"):
        LoopLog.from_decisions(DECISIONS[::-1])
