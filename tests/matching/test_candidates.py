"""The few candidates of a row of scores, and how far they stand out."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.matching.candidates import best_candidates


def by_definition(scores, count, apart):
    left, found = dict(enumerate(scores)), []
    left = {place: score for place, score in left.items() if not np.isnan(score)}
    while left and len(found) < count:
        best = max(left, key=lambda place: (left[place], -place))
        found.append(best)
        left = {place: score for place, score in left.items() if abs(place - best) > apart}
    return found


@pytest.mark.parametrize("length", [1, 10])
def test_they_are_the_best_and_lie_apart(length):
    rng = np.random.default_rng(length)
    for _ in range(20):
        scores = rng.random(80).astype(np.float32)
        scores[rng.random(80) < 0.3] = np.nan
        found = best_candidates(scores, count=4, length=length)
        assert [one.match for one in found] == by_definition(scores, 4, max(length, 5))
        assert [one.score for one in found] == [scores[one.match] for one in found]


def test_nothing_to_choose_from():
    assert best_candidates(np.zeros(0, np.float32), count=4, length=10) == []
    assert best_candidates(np.full(9, np.nan, np.float32), count=4, length=10) == []


def test_a_lone_candidate_is_measured_by_what_is_usual():
    (one,) = best_candidates(np.array([0.9], np.float32), count=4, length=1)
    assert one.standing == pytest.approx((0.9 - 0.5) / 0.125 - np.sqrt(2 * np.log(2)), rel=1e-5)


def test_standing_is_in_deviations_of_the_others():
    rng = np.random.default_rng(0)
    scores = rng.normal(0.5, 0.02, 4000).astype(np.float32)
    scores[2000] = 0.7
    best = best_candidates(scores, count=1, length=10)[0]
    # 0.2 is ten deviations; the best of 400 windows that do not overlap is expected at sqrt(2 ln 400)
    assert best.standing == pytest.approx(10 - np.sqrt(2 * np.log(400)), abs=0.3)


def test_chance_does_not_stand_out_however_many_places_there_are():
    rng = np.random.default_rng(1)
    for places in (100, 1000, 10_000):
        rows = rng.normal(0.5, 0.125, (50, places)).astype(np.float32)
        standing = [best_candidates(row, count=1, length=1)[0].standing for row in rows]
        assert abs(np.median(standing)) < 0.6
