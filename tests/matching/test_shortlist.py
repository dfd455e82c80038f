"""Eq. 20 on a shortlist against Eq. 20 on all places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopclosure.matching import index
from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.sequences import SequenceScores
from loopclosure.matching.shortlist import SequenceSearch
from loopclosure.matching.similarity import VectorMap

FLAT = 256


@pytest.fixture(autouse=True, scope="module")
def _short_steps():
    """Let a small map go through all stages of the growth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(index, "_STEP", 128)
        patch.setattr(index, "_CODED", 2 * 128)
        patch.setattr(index, "_SURVIVORS", 200)
        patch.setattr(index, "_BLOCK", 16 * 1024)
        yield


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def walk(count, d=16, *, seed=0):
    """Unit vectors that change slowly, like those of a drive."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count // 8 + 2, d))
    at = np.linspace(0, len(corners) - 1.001, count)
    share = (at % 1)[:, None]
    return unit((1 - share) * corners[at.astype(int)] + share * corners[at.astype(int) + 1])


def again(rows, *, seed=1):
    """The same places seen once more."""
    return unit(rows + np.random.default_rng(seed).normal(0, 0.08, rows.shape))


def dense(ids, scores, size):
    row = np.full(size, np.nan, np.float32)
    row[ids] = scores
    return row


@settings(max_examples=40, deadline=None)
@given(
    length=st.integers(1, 6),
    exclude=st.integers(0, 9),
    both=st.booleans(),
    extra=st.integers(0, 3),
    frames=st.integers(1, 40),
    seed=st.integers(0, 99),
)
def test_a_small_map_is_compared_with_as_a_whole(length, exclude, both, extra, frames, seed):
    rows = walk(frames, seed=seed)
    how = {"exclude_recent": exclude, "both_directions": both, "history": length + extra}
    places = PlaceIndex().restore({} if exclude else {"descriptors": walk(20, seed=seed + 1)})
    search, reference = SequenceSearch(places, length, **how), SequenceScores(length, **how)
    for row in rows:
        wanted = reference.push(places.similarities(row))
        np.testing.assert_array_equal(dense(*search.push(row), len(places)), wanted)
        if exclude:
            places.add(row)


@settings(max_examples=12, deadline=None)
@given(
    length=st.integers(1, 8),
    exclude=st.sampled_from([0, 1, 7, 40]),
    both=st.booleans(),
    extra=st.integers(0, 3),
    related=st.booleans(),
    seed=st.integers(0, 99),
)
def test_scores_of_the_shortlist_are_those_of_all_places(length, exclude, both, extra, related, seed):
    rows = walk(900, seed=seed)
    drive = again(rows[::-1][300:330] if both else rows[300:330]) if related else walk(30, seed=seed + 1)
    how = {"exclude_recent": exclude, "both_directions": both, "history": length + extra}
    places = PlaceIndex(flat_up_to=FLAT).restore({"descriptors": rows})
    assert not places.exact
    search, reference = SequenceSearch(places, length, **how), SequenceScores(length, **how)
    forward = SequenceScores(length, exclude_recent=exclude, history=length + extra)
    candidates = 0
    for row in drive:
        wanted = reference.push(places.similarities(row))
        ids, scores = search.push(row)
        np.testing.assert_allclose(scores, wanted[ids], atol=1e-6)
        assert np.all(np.diff(ids) > 0)
        usual = forward.push(places.similarities(row))
        spread = usual[np.isfinite(usual)]
        if spread.size:
            assert search.usual.size >= min(spread.size, 256)
            assert np.isin(np.round(search.usual, 5), np.round(spread, 5)).mean() > 0.9
            assert search.usual.mean() == pytest.approx(spread.mean(), abs=0.03)
        candidates += ids.size
        if exclude:
            places.add(row)
    assert candidates > 20 * 50


@pytest.mark.parametrize("both", [False, True])
def test_the_best_place_is_the_best_of_all_places(both):
    """One stream whose second lap drives the street again, and back where that is asked for, across the switch."""
    lap = walk(900)
    second = again(lap[500:100:-1] if both else lap[100:500])
    how = {"exclude_recent": 30, "both_directions": both}
    places = PlaceIndex(flat_up_to=FLAT)
    search, reference = SequenceSearch(places, 10, **how), SequenceScores(10, **how)
    switched, same = 0, []
    for row in np.concatenate([lap, second]):
        wanted = reference.push(places.similarities(row))
        ids, scores = search.push(row)
        if not places.exact:
            switched += 1
            same.append(ids[np.argmax(scores)] == np.nanargmax(wanted))
        places.add(row)
    assert switched > 700
    assert np.mean(same) >= 0.99


def test_state_comes_back_before_and_after_the_switch():
    drive = np.concatenate([walk(600), again(walk(600))[:60]])
    how = {"exclude_recent": 20, "both_directions": True}
    for saved_at in (5, 450, 620):
        one = SequenceSearch(PlaceIndex(flat_up_to=FLAT), 6, **how)
        step_through(one, drive[:saved_at])
        places = PlaceIndex(flat_up_to=FLAT).restore(one.places.to_arrays())
        two = SequenceSearch(places, 6, **how).restore(one.to_arrays())
        assert one.places.exact == (saved_at < 600)
        for mine, other in zip(step_through(one, drive[saved_at:]), step_through(two, drive[saved_at:]), strict=True):
            np.testing.assert_array_equal(mine[0], other[0])
            np.testing.assert_array_equal(mine[1], other[1])
        np.testing.assert_array_equal(one.usual, two.usual)


def step_through(search, drive):
    found = []
    for row in drive:
        found.append(search.push(row))
        search.places.add(row)
    return found


def test_a_plain_map_has_the_same_similarities():
    rows = walk(3000)
    plain, places = (kind.restore({"descriptors": rows}) for kind in (VectorMap(), PlaceIndex(flat_up_to=FLAT)))
    np.testing.assert_array_equal(plain.similarities(rows[5]), places.similarities(rows[5]))
