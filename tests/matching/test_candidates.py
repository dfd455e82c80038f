"""The few candidates of a row of scores, and how far they stand out."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.matching.candidates import best_candidates
from loopclosure.matching.scored import Scored


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
        found = best_candidates(Scored(scores), count=4, length=length)
        assert [one.match for one in found] == by_definition(scores, 4, max(length, 5))
        assert [one.score for one in found] == [scores[one.match] for one in found]


def test_nothing_to_choose_from():
    assert best_candidates(Scored(np.zeros(0, np.float32)), count=4, length=10) == []
    assert best_candidates(Scored(np.full(9, np.nan, np.float32)), count=4, length=10) == []


def test_a_lone_candidate_is_measured_by_what_is_usual():
    (one,) = best_candidates(Scored(np.array([0.9], np.float32)), count=4, length=1)
    assert one.standing == pytest.approx((0.9 - 0.5) / 0.125 - np.sqrt(2 * np.log(2)), rel=1e-5)


def test_standing_is_in_deviations_of_the_others():
    rng = np.random.default_rng(0)
    scores = rng.normal(0.5, 0.02, 4000).astype(np.float32)
    scores[2000] = 0.7
    best = best_candidates(Scored(scores), count=1, length=10)[0]
    # 0.2 is ten deviations; the best of 400 windows that do not overlap is expected at sqrt(2 ln 400)
    assert best.standing == pytest.approx(10 - np.sqrt(2 * np.log(400)), abs=0.3)


def test_chance_does_not_stand_out_however_many_places_there_are():
    rng = np.random.default_rng(1)
    for places in (100, 1000, 10_000):
        rows = rng.normal(0.5, 0.125, (50, places)).astype(np.float32)
        standing = [best_candidates(Scored(row), count=1, length=1)[0].standing for row in rows]
        assert abs(np.median(standing)) < 0.6


def test_a_shortlist_stands_out_as_among_all_places():
    rng = np.random.default_rng(2)
    scores = rng.normal(0.48, 0.06, 50_000).astype(np.float32)
    scores[[700, 703, 40_000]] = 0.95, 0.9, 0.85
    usual = np.arange(60, 50_000, 64)
    ids = np.sort(np.argsort(-scores)[:600])
    shortlist = Scored(scores[ids], ids, usual=Scored(scores[usual], usual), places=scores.size)
    some, everything = (best_candidates(row, count=3, length=10) for row in (shortlist, Scored(scores)))
    for one, two in zip(some, everything, strict=True):
        assert (one.match, one.score) == (two.match, two.score)
        assert one.standing == pytest.approx(two.standing, abs=0.4)  # a deviation from 780 places is 2.5 % off


def test_a_shortlist_as_a_row_and_what_lies_around_a_place():
    shortlist = Scored(
        np.float32([0.9, 0.8, 0.7]), np.array([3, 8, 20]), Scored(np.float32([0.5, 0.9]), np.array([1, 9])), 22
    )
    assert np.flatnonzero(~np.isnan(shortlist.row())).tolist() == [3, 8, 20]
    assert shortlist.row()[[3, 8, 20]].tolist() == shortlist.scores.tolist()
    assert (shortlist.row().size, Scored.nothing(4).row().size) == (22, 4)
    assert [shortlist.around(8, apart) for apart in (4, 5, 12)] == [slice(1, 2), slice(0, 2), slice(0, 3)]
    others, count = shortlist.others(8, 5)  # place 9 shows what is at 8, not what chance gives
    assert (others.tolist(), count) == ([0.5], 22)
