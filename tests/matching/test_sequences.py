"""Eq. 20, incremental against a double loop, forward and backward, in one stream and between two traverses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopclosure.matching.sequences import SequenceScores
from loopclosure.matching.similarity import SetMap, VectorMap


def by_loops(similarity, t, *, length, exclude, both, stream):
    """Score of every candidate of frame t, straight from the definition."""
    count = t if stream else similarity.shape[1]
    scores = np.full(count, np.nan)
    for j in range(count):
        options = []
        enough = t >= length - 1
        if enough and j >= length - 1 and (not stream or t - j >= exclude):
            options.append(np.mean([similarity[t - i, j - i] for i in range(length)]))
        newest = j + length - 1
        apart = not stream or (t - newest >= exclude and newest < t - length + 1)
        if enough and both and newest < count and apart:
            options.append(np.mean([similarity[t - i, j + i] for i in range(length)]))
        if options:
            scores[j] = max(options)
    return scores


@settings(max_examples=60, deadline=None)
@given(
    length=st.integers(1, 6),
    exclude=st.integers(1, 9),
    both=st.booleans(),
    stream=st.booleans(),
    frames=st.integers(1, 25),
    seed=st.integers(0, 99),
)
def test_equals_the_definition(length, exclude, both, stream, frames, seed):
    similarity = np.random.default_rng(seed).random((frames, frames)).astype(np.float32)
    scores = SequenceScores(length, exclude_recent=exclude if stream else 0, both_directions=both)
    for t in range(frames):
        row = similarity[t, :t] if stream else similarity[t]
        wanted = by_loops(similarity, t, length=length, exclude=exclude, both=both, stream=stream)
        np.testing.assert_allclose(scores.push(row), wanted, atol=1e-6)


def test_sums_do_not_drift():
    rng = np.random.default_rng(0)
    scores = SequenceScores(10)
    rows = [rng.random(40).astype(np.float32) for _ in range(20_000)]
    for row in rows:
        last = scores.push(row)
    for j in range(9, 40):
        assert last[j] == np.float32(np.mean([float(rows[-1 - i][j - i]) for i in range(10)]))


def test_distance_of_unit_descriptors_is_the_equation():
    rng = np.random.default_rng(1)
    query, history = rng.normal(size=(2, 4, 16)).astype(np.float32)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    history /= np.linalg.norm(history, axis=1, keepdims=True)
    places, scores = VectorMap(), SequenceScores(4)
    places.restore({"descriptors": history})
    for descriptor in query:
        last = scores.push(places.similarities(descriptor))
    distance = sum(np.sum((p - h) ** 2) for p, h in zip(query, history, strict=True)) / 4 / 4
    assert 1 - last[3] == pytest.approx(distance, abs=1e-6)


def test_state_comes_back():
    similarity = np.random.default_rng(2).random((30, 30)).astype(np.float32)
    one = SequenceScores(5, exclude_recent=3, both_directions=True)
    for t in range(20):
        one.push(similarity[t, :t])
    two = SequenceScores(5, exclude_recent=3, both_directions=True).restore(one.to_arrays())
    for t in range(20, 30):
        np.testing.assert_array_equal(one.push(similarity[t, :t]), two.push(similarity[t, :t]))


def test_map_grows_without_changing_what_it_holds():
    rng = np.random.default_rng(3)
    descriptors = rng.normal(size=(2500, 4)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    places = VectorMap()
    assert places.similarities(descriptors[0]).shape == (0,)
    places.restore({"descriptors": descriptors})
    np.testing.assert_array_equal(places.to_arrays()["descriptors"], descriptors)
    wanted = 1 - np.square(descriptors - descriptors[7]).sum(1) / 4
    np.testing.assert_allclose(places.similarities(descriptors[7]), wanted, atol=1e-6)
    assert np.argmax(places.similarities(descriptors[7])) == 7


def test_sets_are_compared_by_best_counterparts():
    rng = np.random.default_rng(4)
    sets = rng.normal(size=(3, 2, 5)).astype(np.float32)
    sets /= np.linalg.norm(sets, axis=2, keepdims=True)
    places = SetMap()
    places.restore({"descriptors": sets})
    got = places.similarities(sets[1])
    for n in range(3):
        cosines = [[float(a @ b) for b in sets[1]] for a in sets[n]]
        there = np.mean([max(row) for row in cosines])
        back = np.mean([max(row[i] for row in cosines) for i in range(2)])
        assert got[n] == pytest.approx((1 + (there + back) / 2) / 2, abs=1e-6)
    np.testing.assert_allclose(places.similarities(sets[1][::-1]), got, atol=1e-6)
