"""Pairs are balanced, true to the labels, the same for the same seed; what is held out is not learned from."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.errors import FitError
from loopclosure.training.measures import best_threshold, pair_accuracy, place_measures
from loopclosure.training.places import SAME, LabelledPlaces, ListedPlaces, PosedPlaces


def labelled():
    labels = np.repeat([0, 1, 2, 3], [5, 10, 20, 60])
    return LabelledPlaces(labels, np.arange(95))


def posed():
    angle = 2 * np.pi * (np.arange(60) % 30) / 30
    positions = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return PosedPlaces(positions, np.arange(60), positive_m=2.5, negative_m=5.0, exclude_recent=10)


def listed():
    rng = np.random.default_rng(1)
    pairs = rng.permutation([(i, j) for i in range(20) for j in range(i)])[:120]
    return ListedPlaces(pairs, (pairs.sum(axis=1) % 3) == 0)


def is_same(places, i, j):
    """What the places say of a pair, from their rule alone; None for unknown."""
    if isinstance(places, LabelledPlaces):
        return places.labels[i] == places.labels[j] if i != j else None
    if isinstance(places, ListedPlaces):
        found = [same for pair, same in zip(places.pairs.tolist(), places.same, strict=True) if sorted(pair) == [i, j]]
        found += [same for pair, same in zip(places.pairs.tolist(), places.same, strict=True) if sorted(pair) == [j, i]]
        return found[0] if found else None
    away = float(np.hypot(*(places.positions[i] - places.positions[j])))
    if away > 5.0:
        return False
    return True if away <= 2.5 and abs(i - j) >= 10 else None


@pytest.mark.parametrize("make", [labelled, posed, listed])
def test_drawn_pairs_are_balanced_and_right(make):
    places = make()
    pairs, same = places.draw(200, np.random.default_rng(0))
    assert pairs.shape == (200, 2)
    assert same.sum() == 100
    for (i, j), told in zip(pairs.tolist(), same, strict=True):
        assert is_same(places, i, j) == told
    blocks = same[:40].sum()
    assert 8 < blocks < 32  # in random order


@pytest.mark.parametrize("make", [labelled, posed, listed])
def test_the_same_seed_draws_the_same_pairs_and_another_others(make):
    first, again, other = (make().draw(50, np.random.default_rng(seed))[0] for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("make", [labelled, posed, listed])
def test_relation_is_the_rule_of_each_pair(make):
    places = make()
    rows, columns = places.members[::3], places.members[::2]
    known = places.relation(rows, columns)
    for a, i in enumerate(rows.tolist()):
        for b, j in enumerate(columns.tolist()):
            wanted = is_same(places, i, j)
            assert known[a, b] == (-1 if wanted is None else wanted), (i, j)


def test_classes_are_drawn_equally_often_whatever_their_size():
    places = labelled()
    pairs, same = places.draw(4000, np.random.default_rng(0))
    counts = np.bincount(places.labels[pairs[same, 0]])
    assert counts.min() > 0.85 * 500
    assert counts.max() < 1.15 * 500


@pytest.mark.parametrize("make", [labelled, posed])
def test_held_out_images_are_not_learned_from(make):
    learned, held = make().split(0.2, np.random.default_rng(0))
    assert not set(learned.members) & set(held.members)
    assert len(learned) + len(held) == len(make())
    assert 0.15 < len(held) / len(make()) < 0.25


def test_held_out_poses_are_one_stretch_on_both_visits():
    _, held = posed().split(0.2, np.random.default_rng(0))
    apart = np.linalg.norm(held.positions[held.members][:, None] - held.positions[held.members], axis=-1)
    assert apart.max() < 2 * np.pi * 10 * 0.25
    assert (held.members < 30).any()
    assert (held.members >= 30).any()
    assert len(held.anchors(SAME)) == len(held)


def test_held_out_pairs_are_of_both_kinds():
    learned, held = listed().split(0.2, np.random.default_rng(0))
    assert 0 < held.same.sum() < len(held.same)
    assert len(learned.pairs) + len(held.pairs) == 120
    assert not set(map(tuple, learned.pairs)) & set(map(tuple, held.pairs))


def test_a_class_too_small_to_hold_out_is_an_error():
    places = LabelledPlaces(np.array([0, 0, 0, 1, 1, 1, 1]), np.arange(7))
    with pytest.raises(FitError, match="3 images, wanted at least 4"):
        places.split(0.2, np.random.default_rng(0))


def test_place_measures_by_hand():
    angles = np.deg2rad([0, 10, 90, 95, 50])
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    relation = np.zeros((5, 5), np.int8)
    np.fill_diagonal(relation, -1)
    relation[[0, 1, 2, 4], [1, 0, 4, 2]] = 1  # 2 and 3 look alike and are two places
    # Best candidates: 0-1 right (10 degrees), 1-0 right, 2-3 and 3-2 wrong (5 degrees), 4-2 or 4-1 (40 degrees).
    measures = place_measures(vectors, relation)
    assert measures["recall_at_100_precision"] is None
    assert measures["recall_at_1"] in (0.5, 0.75)
    relation[[2, 3], [3, 2]] = 1
    assert place_measures(vectors, relation)["recall_at_100_precision"] == pytest.approx(4 / 5)


def test_best_threshold_beats_every_other():
    rng = np.random.default_rng(0)
    same = rng.random(200) < 0.5
    similarity = np.round(rng.normal(size=200) + same, 1)  # with ties
    best = pair_accuracy(similarity, same, best_threshold(similarity, same))
    others = [pair_accuracy(similarity, same, value) for value in np.arange(-4, 4, 0.05)]
    assert best == pytest.approx(max(others))
