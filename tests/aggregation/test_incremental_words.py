"""Words that are made on the way: founding, trial, removal, the search in cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure.aggregation.incremental_words import UNKNOWN, IncrementalWords
from loopclosure.aggregation.netvlad import unit
from loopclosure.errors import ConfigError, ModelError

WIDTH = 24


def make_features(count, seed):
    return unit(np.random.default_rng(seed).normal(size=(count, WIDTH)).astype(np.float32))


def show(words, features):
    return words.learn(features, words.find(features))


def test_starts_empty_and_knows_what_it_saw():
    words = IncrementalWords()
    features = make_features(20, 0)
    assert (words.find(features) == UNKNOWN).all()
    numbers, removed = show(words, features)
    assert len(words) == len(set(numbers.tolist())) == 20
    assert not len(removed)
    np.testing.assert_array_equal(words.find(features), numbers)
    assert (words.find(-features) == UNKNOWN).all()


@pytest.mark.parametrize("binary", [False, True])
def test_search_of_all_cells_finds_the_nearest_within_the_radius(binary):
    rng = np.random.default_rng(2)
    if binary:
        known, asked = rng.integers(0, 256, (300, 4), np.uint8), rng.integers(0, 256, (80, 4), np.uint8)
    else:
        known = make_features(300, 1)
        asked = unit(known[:80] + make_features(80, 2) * np.linspace(0, 1, 80, dtype=np.float32)[:, None])
    radius = 8 if binary else 0.8

    def distance(one, other):
        return np.count_nonzero(np.unpackbits(one ^ other)) if binary else math.dist(one, other)

    words = IncrementalWords(radius=radius, cell_size=16, probes=10_000)
    numbers, _ = show(words, known)
    found = words.find(asked)
    assert 0 < np.count_nonzero(found >= 0) < 80
    for descriptor, word in zip(asked, found, strict=True):
        distances = [distance(descriptor, other) for other in known]
        if word == UNKNOWN:
            assert min(distances) >= radius - 1e-5
        else:
            assert distances[numbers.tolist().index(word)] == pytest.approx(min(distances), abs=1e-5)
            assert min(distances) < radius


def test_few_cells_find_most_of_what_all_cells_find():
    known = make_features(2000, 3)
    asked = unit(known[:500] + 0.03 * make_features(500, 4))
    few, all_of_them = (IncrementalWords(cell_size=32, probes=probes) for probes in (6, 10_000))
    for words in (few, all_of_them):
        show(words, known)
    same = few.find(asked) == all_of_them.find(asked)
    assert same.mean() > 0.95


def test_cells_stay_small_unless_all_their_words_are_equal():
    words = IncrementalWords(cell_size=16)
    for seed in range(10):
        show(words, make_features(60, seed))
    members = np.bincount(words.to_arrays()["cell"][words.to_arrays()["cell"] >= 0])
    assert members.max() <= 16
    assert members.sum() == len(words)
    equal = IncrementalWords(cell_size=4)
    show(equal, np.repeat(make_features(1, 0), 20, axis=0))
    assert len(equal) == 20


def test_rare_words_go_and_common_ones_stay():
    words = IncrementalWords(trial=3, min_frames=2)
    rare, common = make_features(5, 0), make_features(5, 1)
    rare_numbers, _ = show(words, rare)
    common_numbers, _ = show(words, common)
    gone = [show(words, common)[1] for _ in range(6)]
    np.testing.assert_array_equal(np.concatenate(gone), np.sort(rare_numbers))
    assert len(gone[1]) == 5, "after three frames of trial"
    assert len(words) == 5
    assert (words.find(rare) == UNKNOWN).all()
    np.testing.assert_array_equal(words.find(common), common_numbers)
    assert (words.frames[common_numbers] == 7).all()


def test_a_drive_through_noise_leaves_no_words_behind():
    words = IncrementalWords(trial=4)
    for seed in range(40):
        show(words, make_features(30, seed))
    assert len(words) <= 5 * 30
    assert len(words.frames) <= 10 * 30, "numbers of removed words are used again"


def test_blank_frames_are_legal():
    words = IncrementalWords()
    nothing = np.zeros((0, WIDTH), np.float32)
    assert not len(show(words, nothing)[0])
    show(words, make_features(5, 0))
    assert words.find(nothing).shape == (0,)
    assert not len(show(words, nothing)[0])


def test_saved_words_go_on_as_if_they_had_never_stopped():
    words = IncrementalWords(trial=3, cell_size=16)
    drive = [np.concatenate([make_features(20, seed), make_features(20, seed + 1)]) for seed in range(20)]
    for features in drive[:10]:
        show(words, features)
    loaded = IncrementalWords(trial=3, cell_size=16).restore(words.to_arrays())
    for features in drive[10:]:
        for one, other in zip(show(words, features), show(loaded, features), strict=True):
            np.testing.assert_array_equal(one, other)


def test_misuse_is_named():
    with pytest.raises(ConfigError, match="cell_size = 1"):
        IncrementalWords(cell_size=1)
    words = IncrementalWords()
    show(words, make_features(5, 0))
    arrays = words.to_arrays()
    with pytest.raises(ModelError, match="damaged"):
        IncrementalWords().restore({**arrays, "cell": arrays["cell"] + 9})
