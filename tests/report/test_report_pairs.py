"""What truth says of a pair, which pairs are shown, and that the right pictures stand side by side."""

from __future__ import annotations

import numpy as np
import pytest
from handmade import decide, draw_image
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from loopclosure.errors import TruthError
from loopclosure.evaluation import LoopLog, evaluate, load_truth
from loopclosure.report import Pair, judge, loop_pairs, spread


def plain_spread(pairs, most, apart):
    """Take the best, strike out its neighbours, and again."""
    left, chosen = list(pairs), []
    while left and len(chosen) < most:
        best = left[0]
        for pair in left:
            if pair.score > best.score:
                best = pair
        chosen.append(best)
        left = [pair for pair in left if not best.query - apart < pair.query < best.query + apart]
    return chosen


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.sampled_from([0.1, 0.5, 0.7, 0.9, 1.0]), max_size=30),
    st.integers(0, 6),
    st.integers(1, 8),
)
def test_spread_is_the_plain_greedy_choice(scores, most, apart):
    pairs = [Pair(query, 0, score, True) for query, score in enumerate(scores)]
    assert spread(pairs, most, apart=apart) == plain_spread(pairs, most, apart)


def test_spread_of_one_long_loop_is_not_ten_neighbours():
    pairs = [Pair(query, query - 100, 0.9 - abs(query - 150) / 1000, True) for query in range(100, 200)]
    queries = sorted(pair.query for pair in spread(pairs, 8, apart=12))
    assert queries[0] < 112
    assert queries[-1] > 180
    assert min(np.diff(queries)) >= 12


@pytest.mark.parametrize("tolerance", [0, 1, 2])
@pytest.mark.parametrize("one_stream", [True, False])
def test_verdicts_are_those_of_evaluate(make_truth, tolerance, one_stream):
    rng = np.random.default_rng(tolerance)
    true = {(int(q), int(rng.integers(0, q))) for q in rng.integers(5, 60, 40)}
    truth = make_truth(sorted(true), (60, None if one_stream else 60))
    decisions = [
        decide(
            q, None if q % 7 == 0 else int(rng.integers(0, q)), float(rng.random()), accepted=bool(rng.random() < 0.7)
        )
        for q in range(60)
    ]
    pairs = judge(decisions, truth, tolerance=tolerance)
    metrics = evaluate(LoopLog.from_decisions(decisions), truth, tolerance=tolerance, bootstrap=0).metrics
    assert sum(p.accepted and p.right is True for p in pairs) == metrics["true_positives"]
    assert sum(p.accepted and p.right is False for p in pairs) == metrics["false_positives"]
    for pair in pairs:
        near = any(q == pair.query and abs(m - pair.match) <= tolerance for q, m in true)
        assert pair.right is near


def test_ignored_pairs_are_not_judged(tmp_path):
    cells = np.zeros((4, 4), np.uint8)
    cells[2, 0], cells[3, 0] = 255, 128
    Image.fromarray(cells).save(tmp_path / "truth.png")
    truth = load_truth(tmp_path / "truth.png", frames=(4, None))
    decisions = [decide(0, None, None), decide(1, None, None), decide(2, 0, 0.9), decide(3, 0, 0.9)]
    assert [pair.right for pair in judge(decisions, truth)] == [True, None]


def test_truth_of_other_frames_is_refused(make_truth):
    truth = make_truth([(3, 1)], (5, None))
    with pytest.raises(TruthError, match="5 queries"):
        judge([decide(0, None, None)], truth)


def test_no_decisions_give_no_pairs():
    assert judge([]) == []


def test_pairs_show_the_query_left_of_its_match():
    images = [draw_image(number) for number in range(6)]
    pairs = [Pair(5, 1, 0.912, True, True), Pair(4, 2, 0.5, True, False), Pair(3, 0, 0.4, False)]
    figure = loop_pairs(pairs, images, images)
    shown = [axes for axes in figure.axes if axes.images]
    for axes, number in zip(shown, [5, 1, 4, 2, 3, 0], strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), images[number])
    assert [axes.get_title(loc="left") for axes in shown[:2]] == ["query 5", "match 1"]
    verdicts = [axes.get_title(loc="right") for axes in shown[1::2]]
    assert "0.91" in verdicts[0]
    assert "✓ right" in verdicts[0]
    assert "✗ wrong" in verdicts[1]
    assert "right" not in verdicts[2]
    assert "wrong" not in verdicts[2]
    frames = [axes.spines["left"].get_linestyle() for axes in shown]
    assert frames[0] == frames[1] != frames[2] == frames[3]


def test_missing_images_keep_their_place():
    figure = loop_pairs([Pair(1, 0, 0.9, True)], [None, None], None)
    assert sum(any(text.get_text() == "no image" for text in axes.texts) for axes in figure.axes) == 2
    figure.canvas.draw()


def test_no_pairs_are_a_legal_picture():
    loop_pairs([], [], []).canvas.draw()
