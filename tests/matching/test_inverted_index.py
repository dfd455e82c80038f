"""The inverted index and the maps over it against dense vectors."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from loopclosure.aggregation.incremental_words import IncrementalWords
from loopclosure.aggregation.netvlad import unit
from loopclosure.aggregation.words import EMPTY_BAG, BagOfWords, l1_normalised
from loopclosure.errors import ModelError
from loopclosure.matching.inverted_index import BagOfWordsMap, IncrementalMap, InvertedIndex

N_WORDS = 60


def make_bag(rng, words=12):
    chosen = np.sort(rng.choice(N_WORDS, words, replace=False))
    return BagOfWords(chosen, l1_normalised(rng.random(words)))


def dense(bag):
    vector = [0.0] * N_WORDS
    for word, weight in zip(bag.words, bag.weights, strict=True):
        vector[word] = float(weight)
    return vector


def make_features(count, seed):
    return unit(np.random.default_rng(seed).normal(size=(count, 24)).astype(np.float32))


def test_postings_are_the_columns_of_the_dense_matrix():
    rng = np.random.default_rng(0)
    bags = [make_bag(rng, int(rng.integers(1, 20))) for _ in range(15)]
    index = InvertedIndex(bags)
    matrix = np.array([dense(bag) for bag in bags])
    words = np.array([3, 59, 0])
    counts, places, weights = index.postings(words)
    for word, start, count in zip(words, np.cumsum(counts) - counts, counts, strict=True):
        np.testing.assert_array_equal(places[start : start + count], np.flatnonzero(matrix[:, word]))
        np.testing.assert_allclose(weights[start : start + count], matrix[matrix[:, word] > 0, word], rtol=1e-6)


def test_forgotten_words_are_nowhere():
    index = InvertedIndex([make_bag(np.random.default_rng(0))])
    word = index.to_arrays()["words"][:1]
    index.forget(word)
    assert index.postings(word)[0].tolist() == [0]
    assert len(index) == 1


def test_score_is_the_l1_score_of_dense_vectors():
    rng = np.random.default_rng(1)
    bags = [make_bag(rng) for _ in range(20)]
    places = BagOfWordsMap(InvertedIndex(bags))
    query = make_bag(rng)
    for score, bag in zip(places.similarities(query), bags, strict=True):
        v, w = dense(query), dense(bag)
        expected = 1 - 0.5 * sum(abs(a / sum(v) - b / sum(w)) for a, b in zip(v, w, strict=True))
        assert score == pytest.approx(expected, abs=1e-6)
    assert places.similarities(bags[7]).argmax() == 7
    assert places.similarities(bags[7])[7] == pytest.approx(1)


def test_blank_frames_score_nothing():
    rng = np.random.default_rng(2)
    places = BagOfWordsMap()
    assert places.similarities(make_bag(rng)).shape == (0,)
    for bag in (EMPTY_BAG, make_bag(rng)):
        places.add(bag)
    scores = places.similarities(EMPTY_BAG)
    assert scores.tolist() == [0, 0]
    assert scores.dtype == np.float32
    assert places.similarities(make_bag(rng))[0] == 0


def test_saving_keeps_the_map_and_damage_is_refused():
    rng = np.random.default_rng(3)
    bags = [EMPTY_BAG, *(make_bag(rng) for _ in range(9)), EMPTY_BAG]
    places = BagOfWordsMap(InvertedIndex(bags))
    arrays = places.to_arrays()
    loaded = BagOfWordsMap().restore(arrays)
    for one in (places, loaded):
        one.add(bags[3])
    np.testing.assert_array_equal(loaded.similarities(bags[3]), places.similarities(bags[3]))
    assert len(BagOfWordsMap().restore(BagOfWordsMap().to_arrays())) == 0
    with pytest.raises(ModelError, match="damaged"):
        BagOfWordsMap().restore({**arrays, "places": arrays["places"] + 5})
    with pytest.raises(ModelError, match="damaged"):
        BagOfWordsMap().restore({**arrays, "words": arrays["words"][1:]})
    with pytest.raises(ModelError, match="damaged"):
        BagOfWordsMap().restore({**arrays, "words": arrays["words"][::-1]})


def test_incremental_score_by_hand():
    features = make_features(12, 0)
    drive = [features[[0, 0, 1, 2]], features[[0, 3, 4]], features[[1, 1, 0, 5, 6]]]
    places = IncrementalMap()
    for frame in drive:
        places.add(frame)
    query = [0, 1, 1, 7]
    shown = [[0, 0, 1, 2], [0, 3, 4], [1, 1, 0, 5, 6]]
    known = {word for words in shown for word in words}

    def idf(word):
        return math.log((3 + 1) / (sum(word in words for words in shown) if word in known else 1))

    total = sum(idf(word) / len(query) for word in query)
    for score, words in zip(places.similarities(features[query]), shown, strict=True):
        tf_q, tf_p = Counter(query), Counter(words)
        common = sum(idf(w) * min(tf_q[w] / len(query), tf_p[w] / len(words)) for w in tf_q)
        assert score == pytest.approx(common / total, abs=1e-6)


def test_incremental_map_finds_a_revisit_without_training():
    """A street of 40 places, each sharing features with the next, driven twice with noise."""
    rng = np.random.default_rng(5)
    world = make_features(42 * 10, 6)
    places = IncrementalMap(IncrementalWords(trial=5))
    for turn in range(2):
        for place in range(40):
            visible = world[place * 10 : place * 10 + 25]
            seen = unit(visible + 0.03 * rng.normal(size=(25, 24)).astype(np.float32))
            frame = np.concatenate([seen, make_features(20, int(rng.integers(1 << 30)))])
            scores = places.similarities(frame)
            if turn and 2 <= place < 38:
                assert scores[:40].argmax() == place
            places.add(frame)


def test_rare_words_count_more_than_common_ones():
    features = make_features(6, 1)
    places = IncrementalMap(IncrementalWords(min_frames=1))
    for place in range(10):
        places.add(features[[0, 1]] if place == 3 else features[[0, 2]] if place != 7 else features[[3, 4]])
    scores = places.similarities(features[[1, 3, 0]])
    assert scores[3] > scores[0] > 0
    assert scores[7] > scores[0]


def test_incremental_blank_frames_and_a_removed_word_leave_no_trace():
    nothing = np.zeros((0, 24), np.float32)
    places = IncrementalMap(IncrementalWords(trial=2))
    assert places.similarities(nothing).shape == (0,)
    places.add(make_features(8, 0))
    for _ in range(3):
        places.add(nothing)
    assert len(places.words) == 0
    assert places.similarities(nothing).tolist() == [0] * 4
    other = make_features(8, 1)
    places.add(other)
    assert places.similarities(other).tolist() == [0, 0, 0, 0, pytest.approx(1, abs=1e-5)]


def test_saved_incremental_map_goes_on():
    drive = [np.concatenate([make_features(15, seed), make_features(15, seed + 1)]) for seed in range(16)]
    places = IncrementalMap(IncrementalWords(trial=3))
    for frame in drive[:8]:
        places.add(frame)
    loaded = IncrementalMap(IncrementalWords(trial=3)).restore(places.to_arrays())
    for frame in drive[8:]:
        np.testing.assert_array_equal(loaded.similarities(frame), places.similarities(frame))
        loaded.add(frame)
        places.add(frame)
