"""The Chow-Liu tree against brute force over all spanning trees, and counts by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from loopclosure.aggregation.chow_liu import ChowLiuTree
from loopclosure.errors import FitError, ModelError


def make_seen(n, words, seed):
    """Words that partly copy the word before them."""
    rng = np.random.default_rng(seed)
    seen = rng.random((n, words)) < 0.4
    for word in range(1, words):
        copied = rng.random(n) < 0.6
        seen[copied, word] = seen[copied, word - 1]
    return seen


def information(seen, i, j):
    """Mutual information of two words in nats, from the four joint probabilities."""
    total = 0.0
    for a, b in itertools.product((False, True), repeat=2):
        joint = sum(row[i] == a and row[j] == b for row in seen) / len(seen)
        first = sum(row[i] == a for row in seen) / len(seen)
        second = sum(row[j] == b for row in seen) / len(seen)
        if joint:
            total += joint * math.log(joint / (first * second))
    return total


def spanning_trees(words):
    pairs = list(itertools.combinations(range(words), 2))
    for edges in itertools.combinations(pairs, words - 1):
        group = list(range(words))
        for i, j in edges:
            old, new = group[i], group[j]
            group = [new if g == old else g for g in group]
        if len(set(group)) == 1:
            yield edges


@pytest.mark.parametrize("seed", range(4))
def test_tree_has_the_greatest_information_of_all_trees(seed):
    words = 5
    seen = make_seen(40, words, seed)
    weight = {pair: information(seen, *pair) for pair in itertools.combinations(range(words), 2)}
    best = max(sum(weight[edge] for edge in edges) for edges in spanning_trees(words))
    parent = ChowLiuTree(information_bound=0).fit(seen).parent_
    edges = [tuple(sorted((word, int(parent[word])))) for word in range(words) if parent[word] != word]
    assert len(edges) == words - 1
    assert sum(weight[edge] for edge in edges) == pytest.approx(best, abs=1e-9)


def test_probabilities_are_smoothed_counts():
    seen = make_seen(50, 6, 1)
    tree = ChowLiuTree().fit(seen)
    for word, parent in enumerate(tree.parent_):
        column, of_parent = seen[:, word], seen[:, parent]
        assert tree.marginal_[word] == pytest.approx(0.98 * column.mean() + 0.01)
        if parent != word:
            assert tree.given_parent_[word] == pytest.approx(0.98 * column[of_parent].mean() + 0.01)
            assert tree.given_no_parent_[word] == pytest.approx(0.98 * column[~of_parent].mean() + 0.01)
        else:
            assert tree.given_parent_[word] == tree.given_no_parent_[word] == tree.marginal_[word]


def test_no_word_is_its_own_ancestor():
    parent = ChowLiuTree().fit(make_seen(60, 200, 2)).parent_
    for word in range(200):
        chain = [word]
        while parent[chain[-1]] != chain[-1]:
            chain.append(int(parent[chain[-1]]))
            assert len(chain) <= 200
    assert ChowLiuTree().fit(make_seen(60, 200, 2)).parent_.tolist() == parent.tolist()


def test_independent_words_stay_apart():
    seen = np.array(list(itertools.product((False, True), repeat=3)))
    assert ChowLiuTree().fit(seen).parent_.tolist() == [0, 1, 2]


def test_words_always_or_never_seen_are_legal():
    seen = np.zeros((6, 4), bool)
    seen[:, 0] = True
    seen[:3, 1] = seen[:3, 2] = True
    tree = ChowLiuTree().fit(seen)
    for values in (tree.marginal_, tree.given_parent_, tree.given_no_parent_):
        assert ((values > 0) & (values < 1)).all()


def test_reference_probabilities(data_folder):
    """Along the edges of the original's tree our counts give the original's probabilities."""
    with np.load(data_folder / "reference" / "fabmap_model.npz", allow_pickle=False) as model:
        seen, reference = model["bow_train"] > 0, model["chow_liu_tree"]
    tree = ChowLiuTree().fit(seen)
    np.testing.assert_allclose(tree.marginal_, reference[1], atol=1e-12)
    same = np.flatnonzero((tree.parent_ == reference[0]) & (tree.parent_ != np.arange(seen.shape[1])))
    assert len(same) > seen.shape[1] / 2
    np.testing.assert_allclose(tree.given_parent_[same], reference[2][same], atol=1e-12)
    np.testing.assert_allclose(tree.given_no_parent_[same], reference[3][same], atol=1e-12)


def test_saving_keeps_and_damage_is_refused():
    tree = ChowLiuTree().fit(make_seen(30, 8, 0))
    arrays = tree.to_arrays()
    np.testing.assert_array_equal(ChowLiuTree.from_arrays(arrays).parent_, tree.parent_)
    with pytest.raises(ModelError, match="outside"):
        ChowLiuTree.from_arrays({**arrays, "parent": tree.parent_ + 8})
    with pytest.raises(ModelError, match="probability"):
        ChowLiuTree.from_arrays({**arrays, "marginal": tree.marginal_ + np.nan})
    with pytest.raises(FitError, match="at least one"):
        ChowLiuTree().fit(np.zeros((0, 5), bool))
