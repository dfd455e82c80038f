"""FAB-MAP against loops over all words, the original's outputs, and what its name promises."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure.aggregation.chow_liu import ChowLiuTree
from loopclosure.aggregation.words import EMPTY_BAG, BagOfWords, l1_normalised
from loopclosure.errors import ConfigError, ModelError
from loopclosure.matching.fabmap import FabMap, log_odds, posterior
from loopclosure.matching.inverted_index import InvertedIndex
from loopclosure.store import load_arrays, save_arrays

N_WORDS = 40


def bag_of(words):
    words = np.asarray(words, np.int64)
    return BagOfWords(words, l1_normalised(np.ones(len(words))))


def make_bags(count, seed, n_words=N_WORDS):
    """Neighbouring words tend to appear together."""
    rng = np.random.default_rng(seed)
    bags = []
    for _ in range(count):
        seen = rng.random(n_words) < 0.15
        seen |= np.roll(seen, 1) & (rng.random(n_words) < 0.7)
        bags.append(bag_of(np.flatnonzero(seen)))
    return bags


def factor_by_definition(tree, q, z, z_parent, p_there, there, absent):
    """p(z_q | z_parent, place) = sum over e of p(z_q | e_q, z_parent) p(e_q | place)."""
    marginal = tree.marginal_[q] if z else 1 - tree.marginal_[q]
    seen = tree.given_parent_[q] if z_parent else tree.given_no_parent_[q]
    given_parent = seen if z else 1 - seen
    total = 0.0
    for p_e, p_seen in ((p_there, there), (1 - p_there, absent)):
        detector = p_seen if z else 1 - p_seen
        alpha = marginal * (1 - detector) * (1 - given_parent)
        beta = (1 - marginal) * detector * given_parent
        total += p_e * beta / (alpha + beta)
    return total


def log_likelihood_by_loops(tree, query, place, there, absent):
    """`place` is a bag, or None for the average place."""
    total = 0.0
    for q in range(len(tree.parent_)):
        prior = tree.marginal_[q]
        if place is None:
            p_there = prior
        else:
            was_seen = q in place.words
            if_there = there if was_seen else 1 - there
            if_absent = absent if was_seen else 1 - absent
            p_there = if_there * prior / (if_there * prior + if_absent * (1 - prior))
        z, z_parent = q in query.words, tree.parent_[q] in query.words
        total += math.log(factor_by_definition(tree, q, z, z_parent, p_there, there, absent))
    return total


@pytest.mark.parametrize(("there", "absent"), [(0.39, 0.0), (0.6, 0.05)])
def test_likelihoods_are_those_of_loops_over_all_words(there, absent):
    training, places, queries = make_bags(50, 0), make_bags(12, 1), make_bags(6, 2)
    detector = {"p_seen_if_there": there, "p_seen_if_absent": absent}
    sampled = FabMap.learn(training, N_WORDS, **detector)
    for bag in places:
        sampled.add(bag)
    tree = sampled.tree
    mean_field = FabMap(tree, new_place="mean_field", **detector)
    for bag in places:
        mean_field.add(bag)
    for query in queries:
        unseen = sampled.log_likelihood_unseen(query)
        known, new = sampled.log_likelihoods(query)
        expected = [log_likelihood_by_loops(tree, query, place, there, absent) for place in places]
        np.testing.assert_allclose(known + unseen, expected, atol=1e-9)
        samples = [log_likelihood_by_loops(tree, query, place, there, absent) for place in training]
        assert new + unseen == pytest.approx(math.log(sum(map(math.exp, samples)) / len(samples)), abs=1e-9)
        known, new = mean_field.log_likelihoods(query)
        np.testing.assert_allclose(known + unseen, expected, atol=1e-9)
        assert new + unseen == pytest.approx(log_likelihood_by_loops(tree, query, None, there, absent), abs=1e-9)


def test_factors_are_probabilities():
    tree = FabMap.learn(make_bags(30, 0), N_WORDS).tree
    for q in range(N_WORDS):
        for z_parent in (False, True):
            both = [factor_by_definition(tree, q, z, z_parent, 0.3, 0.39, 0.0) for z in (False, True)]
            assert sum(both) == pytest.approx(1)


@pytest.fixture(scope="module")
def original(data_folder):
    with np.load(data_folder / "reference" / "fabmap_model.npz", allow_pickle=False) as model:
        parent, *probabilities = model["chow_liu_tree"]
        names = ("marginal", "given_parent", "given_no_parent")
        tree = ChowLiuTree.from_arrays({"parent": parent, **dict(zip(names, probabilities, strict=True))})
        parts = ("train", "day_left", "day_right", "corridor_ref", "corridor_query")
        return tree, {part: [bag_of(np.flatnonzero(row > 0)) for row in model[f"bow_{part}"]] for part in parts}


@pytest.mark.parametrize(("reference", "query"), [("day_left", "day_right"), ("corridor_ref", "corridor_query")])
@pytest.mark.parametrize("version", ["FABMAP1_Meanfield", "FABMAP2_Sampled"])
def test_original_outputs(original, data_folder, reference, query, version):
    tree, bags = original
    mean_field = version == "FABMAP1_Meanfield"
    fabmap = FabMap(
        tree,
        InvertedIndex(bags["train"]),
        new_place="mean_field" if mean_field else "sampled",
    )
    for bag in bags[reference]:
        fabmap.add(bag)
    with np.load(data_folder / "reference" / f"fabmap_{reference}__{query}_{version}.npz", allow_pickle=False) as z:
        expected = {name: z[name] for name in z.files}
    agree = 0
    for i, bag in enumerate(bags[query]):
        known, new = fabmap.log_likelihoods(bag)
        offset = fabmap.log_likelihood_unseen(bag) if mean_field else 0.0
        valid = np.isfinite(expected["loglik"][i])
        np.testing.assert_allclose((known + offset)[valid], expected["loglik"][i][valid], atol=1e-6)
        assert new + offset == pytest.approx(expected["loglik_newplace"][i], abs=1e-6)
        agree += np.array_equal(np.argsort(-known[valid]), np.argsort(-expected["loglik"][i][valid]))
        # The original gives the new place the prior of any other candidate.
        candidates = expected["candidate"][i] & valid
        p_new = 1 / (candidates.sum() + 1)
        odds = log_odds(known[candidates], new, p_new=p_new)
        assert odds.max() == pytest.approx(expected["best_logodds"][i], abs=1e-6)
    assert agree >= 0.99 * len(bags[query])


def test_log_odds_and_posterior_by_definition():
    rng = np.random.default_rng(0)
    known, new = rng.normal(size=8), 0.3
    weights = [math.exp(value) * 0.1 / 8 for value in known] + [math.exp(new) * 0.9]
    p = np.array(weights) / sum(weights)
    np.testing.assert_allclose(log_odds(known, new), np.log(p[:-1] / (1 - p[:-1])), atol=1e-12)
    np.testing.assert_allclose(posterior(known, new), 0.99 * p + 0.01 / 9, atol=1e-12)


def test_nothing_underflows_with_ten_thousand_places():
    rng = np.random.default_rng(0)
    known = -3500 - np.abs(rng.normal(0, 1500, 10_000))
    known[77] = 0
    odds = log_odds(known, -3000.0)
    assert np.isfinite(odds).all()
    np.testing.assert_array_equal(np.argsort(odds, kind="stable"), np.argsort(known, kind="stable"))
    assert odds[77] == pytest.approx(3000 - math.log(0.9) + math.log(0.1 / 10_000))
    assert posterior(known, -3000.0).sum() == pytest.approx(1)


def test_a_rare_appearance_says_more_than_a_common_one():
    """Two places share one word with the query each: a word of every second image, and a rare one."""
    training = [bag_of([0, 5 + i % 3]) if i % 2 else bag_of([5 + i % 3]) for i in range(60)] + [bag_of([1])]
    fabmap = FabMap.learn(training, 10)
    for words in ([0, 8], [1, 8]):
        fabmap.add(bag_of(words))
    common, rare = fabmap.similarities(bag_of([0, 1]))
    assert rare > common


def test_words_that_always_come_together_are_not_counted_twice():
    """Ten words of one thing (a brick wall) must not outvote two words of two things.

    With p(z = 1 | e = 0) = 0 the tree cancels out of the ratio of a word that is seen, hence a detector that errs.
    """
    rng = np.random.default_rng(0)
    wall, seen = rng.random(400) < 0.1, rng.random((400, 12)) < 0.1
    seen[:, :10] = wall[:, None]
    training = [bag_of(np.flatnonzero(row)) for row in seen]
    dependent = FabMap.learn(training, 12, p_seen_if_absent=0.05)
    roots = {**dependent.tree.to_arrays(), "parent": np.arange(12)}
    roots["given_parent"] = roots["given_no_parent"] = roots["marginal"]
    independent = FabMap(ChowLiuTree.from_arrays(roots), InvertedIndex(training), p_seen_if_absent=0.05)
    for fabmap in (dependent, independent):
        for words in (range(10), [10, 11]):
            fabmap.add(bag_of(list(words)))
    by_tree, naive = (np.diff(fabmap.log_likelihoods(bag_of(range(12)))[0])[0] for fabmap in (dependent, independent))
    assert naive < by_tree


def test_new_place_wins_over_places_that_look_otherwise():
    training = make_bags(60, 0)
    fabmap = FabMap.learn(training, N_WORDS)
    places = make_bags(20, 1)
    for bag in places:
        fabmap.add(bag)
    assert fabmap.similarities(places[4]).argmax() == 4
    known, new = fabmap.log_likelihoods(places[4])
    assert known[4] > new
    assert fabmap.similarities(make_bags(1, 99)[0]).max() < fabmap.similarities(places[4])[4]


def test_only_candidates_compete():
    learned = FabMap.learn(make_bags(60, 0), N_WORDS)
    samples = InvertedIndex(make_bags(60, 0))
    everywhere, stream = (FabMap(learned.tree, samples, exclude_recent=exclude) for exclude in (0, 3))
    places = make_bags(10, 1)
    for fabmap in (everywhere, stream):
        for bag in [*places, places[3], places[4]]:  # with the new frame, the band holds three
            fabmap.add(bag)
    with_copy, without = everywhere.similarities(places[3]), stream.similarities(places[3])
    assert with_copy.shape == without.shape == (12,)
    assert without[3] > with_copy[3] + 0.5
    np.testing.assert_allclose(without[10:], math.log((0.1 / 10) / (1 - 0.1 / 10)), rtol=1e-5)


@pytest.mark.parametrize("new_place", ["sampled", "mean_field"])
def test_blank_frames_say_nothing(new_place):
    fabmap = FabMap.learn([*make_bags(30, 0), EMPTY_BAG], N_WORDS, new_place=new_place)
    assert fabmap.similarities(make_bags(1, 3)[0]).shape == (0,)
    assert fabmap.similarities(EMPTY_BAG).shape == (0,)
    places = make_bags(5, 1)
    for bag in (places[0], EMPTY_BAG, *places[1:]):
        fabmap.add(bag)
    known, new = fabmap.log_likelihoods(places[2])
    assert known[1] == new
    scores = fabmap.similarities(EMPTY_BAG)
    np.testing.assert_allclose(scores, math.log((0.1 / 6) / (1 - 0.1 / 6)), rtol=1e-5)
    assert fabmap.similarities(places[2]).argmax() == 3


def test_saving_keeps_the_map(tmp_path):
    training = make_bags(30, 0)
    fabmap = FabMap.learn(training, N_WORDS)
    for bag in [*make_bags(10, 1), EMPTY_BAG]:
        fabmap.add(bag)
    save_arrays(tmp_path, kind="detector", header={}, arrays=fabmap.to_arrays())
    arrays = load_arrays(tmp_path, kind="detector")[1]
    loaded = FabMap(fabmap.tree, InvertedIndex(training)).restore(arrays)
    for bag in make_bags(5, 2):
        np.testing.assert_allclose(loaded.similarities(bag), fabmap.similarities(bag), rtol=1e-6)
        loaded.add(bag)
        fabmap.add(bag)
    assert len(loaded) == len(fabmap) == 16
    assert loaded.nbytes == fabmap.nbytes > 0
    with pytest.raises(ModelError, match="outside the 40"):
        loaded.restore({**arrays, "words": arrays["words"] + N_WORDS})


def test_misuse_is_named():
    bags = make_bags(10, 0)
    with pytest.raises(ConfigError, match="wanted 0 <="):
        FabMap.learn(bags, N_WORDS, p_seen_if_there=0.0)
    with pytest.raises(ConfigError, match="p_new"):
        FabMap.learn(bags, N_WORDS, p_new=1.0)
    with pytest.raises(ConfigError, match="training images"):
        FabMap(ChowLiuTree().fit(np.eye(4, dtype=bool)))
