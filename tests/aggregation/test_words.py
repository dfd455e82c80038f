"""Vocabularies: words, tf-idf, binary and float, against plain readings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure.aggregation.kmeans import as_vectors, lloyd, nearest, spread_start
from loopclosure.aggregation.words import BagOfWords, VocabularyTree, occurrence
from loopclosure.errors import ConfigError, FitError, ModelError
from loopclosure.store import load_arrays, save_arrays


def make_images(kind, images=12, features=80, groups=30, seed=0):
    """Noisy copies of a few prototypes, so that words exist."""
    rng = np.random.default_rng(seed)
    if kind == "binary":
        prototypes = rng.integers(0, 256, (groups, 32), dtype=np.uint8)
        flips = rng.random((images, features, 32, 8)) < 0.04
        noise = np.packbits(flips, axis=-1)[..., 0]
        return list(prototypes[rng.integers(0, groups, (images, features))] ^ noise)
    prototypes = rng.normal(size=(groups, 16))
    chosen = prototypes[rng.integers(0, groups, (images, features))]
    return list((chosen + 0.1 * rng.normal(size=chosen.shape)).astype(np.float32))


KINDS = ["float", "binary"]


def distance(one, other):
    if one.dtype == np.uint8:
        return sum(int(a ^ b).bit_count() for a, b in zip(one.tolist(), other.tolist(), strict=True))
    return math.dist(one, other)


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_keep_the_distance(kind):
    first, second = make_images(kind, 2, 10)
    for one, other, v, w in zip(first, second, as_vectors(first), as_vectors(second), strict=True):
        squared = float(np.square(v - w).sum())
        expected = 4 * distance(one, other) if kind == "binary" else distance(one, other) ** 2
        assert squared == pytest.approx(expected, rel=1e-4)


def test_nearest_is_the_nearest():
    rng = np.random.default_rng(1)
    vectors, centres = rng.normal(size=(50, 6)).astype(np.float32), rng.normal(size=(9, 6)).astype(np.float32)
    found = nearest(vectors, centres)
    for vector, row in zip(vectors, found, strict=True):
        assert row == min(range(9), key=lambda k: math.dist(vector, centres[k]))


def test_lloyd_reaches_means_or_majorities():
    vectors = as_vectors(np.concatenate(make_images("binary", 5, 40, groups=4)))
    for binary in (False, True):
        centres = lloyd(vectors, vectors[:4], iterations=50, binary=binary)
        owner = nearest(vectors, centres)
        for k in np.unique(owner):
            mean = vectors[owner == k].mean(0)
            expected = np.where(mean >= 0, 1, -1) if binary else mean
            np.testing.assert_allclose(centres[k], expected, atol=1e-5)


def test_spread_start_takes_no_vector_twice():
    vectors = np.repeat(np.eye(5, dtype=np.float32), 20, axis=0)
    start = spread_start(vectors, 8, np.random.default_rng(0))
    assert len(np.unique(start, axis=0)) == len(start) == 5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("branching", "levels"), [(4, 3), (20, 1), (100, 1)])
def test_descent_follows_the_nearest_child(kind, branching, levels):
    images = make_images(kind)
    tree = VocabularyTree(branching, levels, seed=3).fit(images)
    for descriptor, word in zip(images[0], tree.assign(images[0]), strict=True):
        node = 0
        while tree.children_[node]:
            first = tree.first_child_[node]
            children = range(first, first + tree.children_[node])
            node = min(children, key=lambda child: (distance(descriptor, tree.centres_[child]), child))
        assert tree.word_[node] == word
    assert sorted(tree.word_[tree.word_ >= 0]) == list(range(len(tree)))


@pytest.mark.parametrize("kind", KINDS)
def test_prototypes_become_words(kind):
    """With as many words as prototypes, nearly all copies of one prototype share a word."""
    tree = VocabularyTree(10, 1, iterations=30).fit(make_images(kind, groups=10))
    of_one = make_images(kind, 2, 1, groups=10)[0]
    rng = np.random.default_rng(5)
    if kind == "binary":
        noise = np.packbits(rng.random((20, 32, 8)) < 0.04, axis=-1)[..., 0]
        copies = of_one ^ noise
    else:
        copies = of_one + 0.1 * rng.normal(size=(20, 16)).astype(np.float32)
    assert len(set(tree.assign(copies).tolist())) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_bag_is_tf_idf(kind):
    images = make_images(kind)
    tree = VocabularyTree(3, 3).fit(images)
    bags = [tree.transform(image) for image in images]
    words = [tree.assign(image).tolist() for image in images]
    weight = {}
    for word in set(words[0]):
        n_images = sum(word in of_image for of_image in words)
        weight[word] = words[0].count(word) / len(words[0]) * math.log(len(images) / n_images)
    total = sum(weight.values())
    assert bags[0].words.tolist() == sorted(weight)
    np.testing.assert_allclose(bags[0].weights, [weight[w] / total for w in sorted(weight)], rtol=1e-4, atol=1e-7)
    assert all(bag.weights.sum() == pytest.approx(1, abs=1e-5) for bag in bags)


def test_order_of_features_changes_nothing():
    images = make_images("float")
    tree = VocabularyTree(4, 2).fit(images)
    for one, other in zip(tree.transform(images[0]), tree.transform(images[0][::-1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_image_without_features_has_no_words(kind):
    images = make_images(kind)
    tree = VocabularyTree(4, 2).fit([*images, images[0][:0]])
    bag = tree.transform(images[0][:0])
    assert len(bag.words) == len(bag.weights) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_images_that_show_nothing_make_one_word(kind):
    images = make_images(kind)
    tree = VocabularyTree(4, 2).fit([image[:0] for image in images])
    assert len(tree) == 1
    assert tree.transform(images[0]).words.tolist() == [0]
    assert np.isfinite(tree.idf_).all()


def test_equal_descriptors_make_one_word():
    tree = VocabularyTree(4, 2).fit([np.ones((20, 8), np.float32)] * 3)
    assert len(tree) == 1
    assert not tree.transform(np.ones((5, 8), np.float32)).weights.any()


@pytest.mark.parametrize("kind", KINDS)
def test_seed_decides_and_saving_keeps(kind, tmp_path):
    images = make_images(kind)
    tree = VocabularyTree(4, 3, max_samples=500, seed=7).fit(images)
    again = VocabularyTree(4, 3, max_samples=500, seed=7).fit(images)
    save_arrays(tmp_path, kind="model", header={}, arrays=tree.to_arrays())
    loaded = VocabularyTree().restore(load_arrays(tmp_path, kind="model")[1])
    for other in (again, loaded):
        assert len(other) == len(tree)
        for image in images:
            np.testing.assert_array_equal(other.transform(image).words, tree.transform(image).words)
            np.testing.assert_array_equal(other.transform(image).weights, tree.transform(image).weights)


def test_damaged_trees_are_refused():
    arrays = VocabularyTree(4, 2).fit(make_images("float")).to_arrays()
    circle = arrays["first_child"].copy()
    circle[1] = 0
    for damage in ({"first_child": circle}, {"idf": arrays["idf"][1:]}, {"children": arrays["children"] + 1}):
        with pytest.raises(ModelError, match="no tree"):
            VocabularyTree().restore({**arrays, **damage})


def test_misuse_is_named():
    images = make_images("float")
    with pytest.raises(FitError, match="fit first"):
        VocabularyTree().assign(images[0])
    with pytest.raises(FitError, match="no images"):
        VocabularyTree().fit([])
    with pytest.raises(FitError, match="different kinds"):
        VocabularyTree().fit([images[0], make_images("binary")[0]])
    with pytest.raises(FitError, match="same extractor"):
        VocabularyTree(4, 2).fit(images).assign(make_images("binary")[0])
    with pytest.raises(ConfigError, match="branching"):
        VocabularyTree(1)


def test_occurrence_by_hand():
    bags = [BagOfWords(np.array([0, 3]), np.ones(2)), BagOfWords(np.array([], np.int64), np.ones(0))]
    assert occurrence(bags, 4).tolist() == [[True, False, False, True], [False] * 4]
