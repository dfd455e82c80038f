"""Eq. 20 on a shortlist against Eq. 20 on all places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.sequences import SequenceScores
from loopclosure.matching.shortlist import SequenceSearch
from loopclosure.matching.similarity import VectorMap

FLAT = 256
pytestmark = pytest.mark.usefixtures("short_steps")


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
    search, reference = SequenceSearch(places, SequenceScores(length, **how)), SequenceScores(length, **how)
    for row in rows:
        wanted = reference.push(places.similarities(row))
        np.testing.assert_array_equal(search.push(row).row(), wanted)
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
    search, reference = SequenceSearch(places, SequenceScores(length, **how)), SequenceScores(length, **how)
    candidates = 0
    for row in drive:
        wanted = reference.push(places.similarities(row))
        found = search.push(row)
        np.testing.assert_allclose(found.scores, wanted[found.ids], atol=1e-6)
        assert np.all(np.diff(found.ids) > 0)
        spread = wanted[np.isfinite(wanted)]
        if spread.size:
            assert found.usual.ids.size >= min(spread.size, 256)
            np.testing.assert_allclose(found.usual.scores, wanted[found.usual.ids], atol=1e-6)
            assert found.usual.scores.mean() == pytest.approx(spread.mean(), abs=0.03)
        candidates += found.ids.size
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
    search, reference = SequenceSearch(places, SequenceScores(10, **how)), SequenceScores(10, **how)
    switched, same = 0, []
    for row in np.concatenate([lap, second]):
        wanted = reference.push(places.similarities(row))
        found = search.push(row)
        if not places.exact:
            switched += 1
            same.append(found.ids[np.argmax(found.scores)] == np.nanargmax(wanted))
        places.add(row)
    assert switched > 700
    assert np.mean(same) >= 0.99


def test_state_comes_back_before_and_after_the_switch():
    drive = np.concatenate([walk(600), again(walk(600))[:60]])
    how = {"exclude_recent": 20, "both_directions": True}
    for saved_at in (5, 450, 620):
        one = SequenceSearch(PlaceIndex(flat_up_to=FLAT), SequenceScores(6, **how))
        step_through(one, drive[:saved_at])
        two = restored(one.places.to_arrays(), one.to_arrays(), 6, **how)
        assert one.places.exact == (saved_at < 600)
        pairs = zip(step_through(one, drive[saved_at:]), step_through(two, drive[saved_at:]), strict=True)
        for mine, other in pairs:
            assert_same(mine, other)


def test_state_comes_back_in_the_first_frames_against_a_large_map():
    rows, drive = walk(900), again(walk(900)[300:340])
    one = restored({"descriptors": rows}, {}, 6)
    for row in drive[:3]:
        one.push(row)
    two = restored({"descriptors": rows}, one.to_arrays(), 6)
    for row in drive[3:]:
        assert_same(one.push(row), two.push(row))


@pytest.mark.parametrize("exclude", [0, 20])
def test_state_of_plain_sums_goes_on_with_a_large_map(exclude):
    """Saved where the whole map was compared: the sums go on until the frames of a sequence are known."""
    rows, drive = walk(900), again(walk(900)[300:340])
    plain, sums = VectorMap().restore({"descriptors": rows}), SequenceScores(6, exclude_recent=exclude)
    for row in drive[:20]:
        sums.push(plain.similarities(row))
    search = restored(plain.to_arrays(), sums.to_arrays(), 6, exclude_recent=exclude)
    for number, row in enumerate(drive[20:]):
        wanted, found = sums.push(plain.similarities(row)), search.push(row)
        assert (found.ids is None) == (number < 5)
        there = ~np.isnan(found.row())
        np.testing.assert_allclose(found.row()[there], wanted[there], atol=1e-6)
        assert np.nanargmax(found.row()) == np.nanargmax(wanted) == 320 + number


def restored(places, state, length, **how):
    search = SequenceSearch(PlaceIndex(flat_up_to=FLAT).restore(places), SequenceScores(length, **how))
    return search.restore(state) if state else search


def assert_same(mine, other):
    np.testing.assert_array_equal(mine.row(), other.row())
    if mine.usual is not None:
        np.testing.assert_array_equal(mine.usual.scores, other.usual.scores)
        np.testing.assert_array_equal(mine.usual.ids, other.usual.ids)


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
