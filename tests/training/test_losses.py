"""Both losses against plain loops; the hardest pairs and negatives against a search through all."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from loopclosure.aggregation.netvlad import unit
from loopclosure.training.losses import ContrastiveLoss, TripletRankingLoss, hardest_pairs, hardest_triplets

SAME, DIFFERENT = ([0, 2, 4], [1, 3, 5]), ([0, 1, 2, 6], [3, 5, 7, 7])


@pytest.fixture
def vectors():
    spread = np.random.default_rng(0).normal([1, 0, 0], 1, size=(8, 3))
    return unit(spread).astype(np.float32)


def as_arrays(pairs):
    return tuple(np.array(rows) for rows in pairs)


@pytest.mark.parametrize("distance", ["euclidean", "cosine"])
@pytest.mark.parametrize("margin", [0.9, 2.5])
def test_contrastive_loss_is_what_loops_say(vectors, distance, margin):
    def apart(i, j):
        if distance == "cosine":
            return 1 - float(vectors[i] @ vectors[j])
        return float(np.sqrt(((vectors[i] - vectors[j]) ** 2).sum()))

    same = [apart(i, j) for i, j in zip(*SAME, strict=True)]
    different = [max(0.0, margin - apart(i, j)) for i, j in zip(*DIFFERENT, strict=True)]
    assert sum(different) > 0
    near = [term for term in different if term > 0]
    assert margin > 0.9 or len(near) < len(different)
    wanted = sum(same) / len(same) + sum(near) / len(near)
    loss = ContrastiveLoss(margin, distance)(torch.from_numpy(vectors), as_arrays(SAME), as_arrays(DIFFERENT))
    assert float(loss) == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize("distance", ["euclidean", "cosine"])
def test_the_gradient_of_a_pair_reaches_both_branches(vectors, distance):
    for same, different, sign in ((([0], [1]), ([], []), -1), (([], []), ([0], [1]), 1)):
        rows = torch.from_numpy(vectors).requires_grad_()
        pairs = (tuple(np.array(part, np.int64) for part in kind) for kind in (same, different))
        ContrastiveLoss(2.0, distance)(rows, *pairs).backward()
        assert (rows.grad[:2].norm(dim=1) > 0.01).all()
        assert not rows.grad[2:].any()
        moved = vectors - 0.01 * rows.grad.numpy()
        before, after = (np.linalg.norm(unit(v)[0] - unit(v)[1]) for v in (vectors, moved))
        assert np.sign(after - before) == sign


def test_triplet_loss_is_what_loops_say(vectors):
    margin = 0.1
    triplets = np.array([[0, 1, 3], [0, 1, 4], [2, 5, 6], [2, 5, 7], [2, 5, 1]])

    def squared(i, j):
        return sum((float(a) - float(b)) ** 2 for a, b in zip(vectors[i], vectors[j], strict=True))

    terms = [max(0.0, squared(q, p) + margin - squared(q, n)) for q, p, n in triplets]
    assert 0 < sum(term > 0 for term in terms) < len(terms)
    loss = TripletRankingLoss(margin)(torch.from_numpy(vectors), triplets)
    assert float(loss) == pytest.approx(sum(terms) / 2, abs=1e-5)


def test_a_step_down_the_triplet_loss_brings_the_positive_nearer_and_the_negative_away(vectors):
    rows = torch.from_numpy(vectors).requires_grad_()
    TripletRankingLoss(5.0)(rows, np.array([[0, 1, 2]])).backward()
    moved = unit(vectors - 0.01 * rows.grad.numpy())
    assert moved[0] @ moved[1] > vectors[0] @ vectors[1]
    assert moved[0] @ moved[2] < vectors[0] @ vectors[2]


def test_hardest_pairs_are_the_hardest_of_all(vectors):
    labels = np.array([0, 0, 1, 1, 2, 2, 2, 0])
    relation = np.where(np.equal.outer(labels, labels), 1, 0).astype(np.int8)
    relation[0, 3] = relation[3, 0] = -1  # unknown
    every = {kind: [] for kind in (1, 0)}
    for i, j in itertools.combinations(range(8), 2):
        if relation[i, j] >= 0:
            every[relation[i, j]].append((float(vectors[i] @ vectors[j]), i, j))
    same, different = hardest_pairs(vectors, relation, most=3)
    assert list(zip(*same, strict=True)) == [(i, j) for _, i, j in sorted(every[1])[:3]]
    assert list(zip(*different, strict=True)) == [(i, j) for _, i, j in sorted(every[0], reverse=True)[:3]]


def test_hardest_triplets_are_the_best_positive_and_the_worst_negatives():
    similarity = np.array([1.0, 0.7, 0.8, 0.79, 0.9, 0.2, 0.85, 0.95], np.float32)
    relation = np.array([-1, 1, 1, 0, 0, 0, 0, -1], np.int8)
    triplets = hardest_triplets(0, similarity, relation, negatives=2, margin=0.1)
    assert triplets.tolist() == [[0, 2, 4], [0, 2, 6]]
    # 0.79 is within half the margin of the positive's 0.8, 0.2 is not
    assert hardest_triplets(0, similarity, relation, negatives=9, margin=0.1)[:, 2].tolist() == [4, 6, 3]
    assert hardest_triplets(0, similarity, np.zeros(8, np.int8), negatives=2, margin=0.1).shape == (0, 3)
