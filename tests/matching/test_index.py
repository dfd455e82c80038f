"""The index against all cosines in numpy: below and beyond the size from which codes are made."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopclosure.errors import ModelError
from loopclosure.matching import index
from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.similarity import VectorMap

FLAT = 256
pytestmark = pytest.mark.usefixtures("short_steps")


def street(count, d=16, *, seed=0):
    """Unit vectors that change slowly, like those of a drive; some frames are blank."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count // 8 + 2, d))
    at = np.linspace(0, len(corners) - 1.001, count)
    share = (at % 1)[:, None]
    rows = (1 - share) * corners[at.astype(int)] + share * corners[at.astype(int) + 1]
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    rows[rng.random(count) < 0.01] = 0
    return rows.astype(np.float32)


def indexed(rows, *, flat_up_to=FLAT):
    places = PlaceIndex(flat_up_to=flat_up_to)
    for row in rows:
        places.add(row)
    return places


def by_numpy(rows, query, k, *, newest=None, without=()):
    allowed = np.setdiff1d(np.arange(len(rows) if newest is None else newest + 1), without)
    cosines = rows[allowed] @ query
    order = np.argsort(-cosines, kind="stable")[:k]
    return allowed[order], cosines[order]


def recall(places, rows, queries, k=10, **limits):
    return np.mean(
        [
            np.isin(by_numpy(rows, q, k, **limits)[0], places.search(q, k, newest=limits.get("newest"))[0])
            for q in queries
        ]
    )


@pytest.fixture(scope="module")
def rows():
    return street(6000)


@pytest.fixture(scope="module")
def queries(rows):
    rng = np.random.default_rng(1)
    noisy = rows[rng.integers(0, len(rows), 100)] + rng.normal(0, 0.05, (100, rows.shape[1])).astype(np.float32)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


@settings(max_examples=60, deadline=None)
@given(
    count=st.integers(0, 60),
    k=st.integers(1, 20),
    newest=st.integers(-3, 70),
    gone=st.integers(0, 5),
    seed=st.integers(0, 99),
)
def test_a_small_index_is_exact(count, k, newest, gone, seed):
    rng = np.random.default_rng(seed)
    rows = street(60, seed=seed)[:count]
    places = indexed(rows)
    without = rng.choice(count, min(gone, count), replace=False)
    places.remove(without)
    query = street(1, seed=seed + 1)[0]
    ids, cosines = places.search(query, k, newest=newest)
    wanted, wanted_cosines = by_numpy(rows, query, k, newest=min(newest, count - 1), without=without)
    np.testing.assert_allclose(cosines, wanted_cosines, atol=1e-6)
    np.testing.assert_allclose(rows[ids] @ query, cosines, atol=1e-6)
    assert len(set(ids)) == len(wanted)
    assert not set(ids) & set(without)


def test_a_large_index_finds_nearly_all_and_says_exact_cosines(rows, queries, monkeypatch):
    places = indexed(rows)
    assert not places.exact
    assert recall(places, rows, queries) > 0.99
    monkeypatch.setattr(index, "_SURVIVORS", 12)
    assert 0.8 < recall(places, rows, queries) < 1
    for query in queries[:20]:
        ids, cosines = places.search(query, 10)
        np.testing.assert_allclose(cosines, rows[ids] @ query, atol=1e-6)
        assert np.all(np.diff(cosines) <= 0)


def test_every_stage_of_the_growth_answers_well(rows):
    places = PlaceIndex(flat_up_to=FLAT)
    stages, found = set(), []
    for i, row in enumerate(rows):
        if i % 37 == 36:
            query = rows[i // 2]
            stages.add((places.exact, len(places._codes)))
            found.append(np.isin(by_numpy(rows[:i], query, 5)[0], places.search(query, 5)[0]).mean())
        places.add(row)
    assert stages == {(True, 0), (True, 1), (False, 1), (False, 2)}
    assert np.mean(found) > 0.98


@pytest.mark.parametrize("newest", [5999, 5990, 5800, 3000, 10])
def test_newer_places_are_not_found(rows, queries, newest):
    places = indexed(rows)
    assert max(places.search(query, 10, newest=newest)[0].max() for query in queries) <= newest
    assert recall(places, rows, queries, newest=newest) > 0.98


def test_removed_places_are_not_found(rows, queries):
    places = indexed(rows)
    gone = np.unique(np.concatenate([places.search(query, 3)[0] for query in queries] + [np.arange(5950, 6000)]))
    places.remove(gone)
    assert not set(gone) & {i for query in queries for i in places.search(query, 10)[0]}
    assert recall(places, rows, queries, without=gone) > 0.98
    for row in rows[:2000]:  # what was removed does not come back with the next file
        places.add(row)
    assert not set(gone) & {i for query in queries for i in places.search(query, 50)[0]}
    assert not places.rows(gone).any()


def test_same_places_same_answers_and_state_comes_back(rows, queries):
    """Saved at any stage of its growth, an index goes on as one that was not."""
    for saved_at in (200, 700, 1000, 1300, 1500, 3000):
        one = indexed(rows[:saved_at])
        one.remove(np.array([3, 100, saved_at - 1]))
        two = PlaceIndex(flat_up_to=FLAT).restore(one.to_arrays())
        for places in (one, two):
            for row in rows[saved_at : saved_at + 1500]:
                places.add(row)
        assert one.exact == two.exact
        for query in queries[:30]:
            for mine, other in zip(one.search(query, 10), two.search(query, 10), strict=True):
                np.testing.assert_array_equal(mine, other)


def test_what_a_plain_map_saved_is_indexed_at_once(rows, queries):
    plain = VectorMap().restore({"descriptors": rows})
    places = PlaceIndex(flat_up_to=FLAT).restore(plain.to_arrays())
    assert not places.exact
    assert recall(places, rows, queries) > 0.99
    np.testing.assert_array_equal(places.similarities(queries[0]), plain.similarities(queries[0]))


@pytest.mark.parametrize(("d", "exact"), [(7, False), (64, False), (300, True)])
def test_vectors_of_any_length(d, exact):
    rows = street(1500, d)
    places = indexed(rows)
    assert places.exact == exact
    assert recall(places, rows, rows[5:1500:50]) > 0.98


def test_blank_frames_are_places_like_others():
    places = indexed(np.zeros((3000, 8), np.float32))
    ids, cosines = places.search(np.zeros(8, np.float32), 4)
    assert len(set(ids)) == 4
    np.testing.assert_array_equal(cosines, np.zeros(4))


def test_memory_is_counted(rows):
    places = indexed(rows)
    assert rows.nbytes * 1.05 < places.nbytes < rows.nbytes * 1.2


def test_wrong_use_is_told(rows):
    places = indexed(rows[:300])
    with pytest.raises(ModelError, match="one vector a place"):
        places.add(rows[:2])
    with pytest.raises(ModelError, match="same method"):
        places.add(rows[0, :5])
    with pytest.raises(ModelError, match="holds 300"):
        places.remove(np.array([300]))


@pytest.mark.parametrize(
    "damage",
    [
        {"live.progress": np.array([10**9, 0])},
        {"live.progress": np.array([6000, 10**9])},
        {"live.progress": np.array([-1, 0])},
        {"live.centres": np.zeros((4, 3), np.float32)},
        {"removed": np.array([-1])},
        {"removed": np.array([10**9])},
    ],
)
def test_damaged_state_is_told(rows, damage):
    arrays = indexed(rows).to_arrays()
    with pytest.raises(ModelError):
        PlaceIndex(flat_up_to=FLAT).restore(arrays | damage)
