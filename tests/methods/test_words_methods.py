"""`fabmap`, `bow` and `bow-incremental`, beyond the contract of all methods."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config, ImageSequence, LoopDetector
from loopclosure.aggregation.words import EMPTY_BAG
from loopclosure.errors import ConfigError, FitError, ModelError
from loopclosure.features.keypoints import KeypointExtractor
from loopclosure.matching.fabmap import FabMap
from loopclosure.matching.standard import StandardScores
from loopclosure.methods import build_method

NAMES = ["fabmap", "bow", "bow-incremental"]
TRAINED = ["fabmap", "bow"]
SMALL = {
    "words.max_features": 150,
    "words.side": 160,
    "words.branching": 8,
    "sequence.length": 4,
    "sequence.exclude_recent": 10,
    "learning.refit_at": (20,),
}


def settings(name, **more):
    return Config().with_settings({"method": name} | SMALL | {key.replace("__", "."): more[key] for key in more})


def fitted(name, images, **more):
    method = build_method(settings(name, **more))
    if not method.fitted:
        method.fit(method.features(images))
    return method


def assert_same_description(one, two):
    for part, other in zip(one, two, strict=True):
        np.testing.assert_array_equal(part, other)


@pytest.mark.parametrize(("kind", "dtype"), [("rootsift", np.float16), ("orb", np.uint8)])
def test_features_are_the_strongest_descriptors_over_rows_of_zeros(lap, kind, dtype):
    features = build_method(settings("bow", words__keypoints=kind, words__max_features=2000)).features(lap[:1])[0]
    expected = KeypointExtractor(kind, max_features=2000, side=160)(lap[0]).descriptors
    assert features.dtype == dtype
    assert 10 < len(expected) < len(features) == 2000
    np.testing.assert_allclose(features[: len(expected)], expected, atol=1e-3)
    assert not features[len(expected) :].any()


@pytest.mark.parametrize("kind", ["rootsift", "orb"])
@pytest.mark.parametrize("name", NAMES)
def test_a_revisit_is_found_with_either_kind_of_feature(name, kind, lap, second_lap):
    detector = LoopDetector(settings(name, words__keypoints=kind))
    detector.set_reference(lap)
    decisions = [decision for decision in detector.detect(second_lap) if decision.match is not None]
    assert np.mean([abs(d.match - d.query) <= 1 for d in decisions]) >= 0.9  # chance: 0.12


@pytest.mark.parametrize("name", TRAINED)
def test_words_of_an_image_do_not_depend_on_the_rows_of_zeros(name, lap):
    method = fitted(name, lap)
    features = method.features(lap[3:4])[0]
    more = np.concatenate([features, np.zeros_like(features)])
    assert_same_description(method.describe([features]), method.describe([more]))
    assert_same_description(method.describe([np.zeros_like(features)]), EMPTY_BAG)


@pytest.mark.parametrize("name", TRAINED)
def test_a_model_decides_as_its_teacher(name, lap, second_lap, tmp_path):
    teacher = LoopDetector(settings(name))
    teacher.fit(lap, source="lap")
    teacher.save_model(tmp_path / "model")
    pupil = LoopDetector(model=tmp_path / "model")
    assert pupil.learned_on == [f"{len(lap)} of {len(lap)} frames of the lap"]
    for image in [*lap[:9], None, *second_lap]:
        one, two = teacher.add(image), pupil.add(image)
        assert (one.match, one.reason) == (two.match, two.reason)
        assert one.score == (two.score if two.score is None else pytest.approx(two.score, rel=1e-5))


@pytest.mark.parametrize("name", TRAINED)
def test_a_detector_that_was_saved_while_learning_learns_the_same_words(name, lap, second_lap, tmp_path):
    detector = LoopDetector(settings(name))
    for image in lap[:12]:
        detector.add(image)
    detector.save(tmp_path)
    again = LoopDetector.load(tmp_path)
    for image in [*lap[12:], *second_lap]:
        detector.add(image)
        again.add(image)
    one, two = detector.method.to_arrays(), again.method.to_arrays()
    assert one.keys() == two.keys()
    for key, array in one.items():
        np.testing.assert_array_equal(array, two[key])


@pytest.mark.parametrize("name", NAMES)
def test_a_drive_that_begins_in_the_dark_goes_on(name, lap, second_lap):
    black = [np.zeros((64, 64, 3), np.uint8)] * 12  # longer than the first warm-up
    decisions = list(LoopDetector(settings(name, learning__refit_at=(30,))).detect([*black, *lap, *second_lap]))
    assert all(d.score is None or np.isfinite(d.score) for d in decisions)
    assert not any(d.accepted for d in decisions[: len(lap)])
    revisit = decisions[12 + len(lap) + 3 :]
    assert np.mean([abs(d.match - (d.query - len(lap))) <= 1 for d in revisit]) >= 0.9


@pytest.mark.parametrize(("exclude", "candidates"), [(0, 30), (1, 30), (6, 25)])
def test_bow_counts_in_standard_deviations_of_the_candidates(exclude, candidates):
    row = np.random.default_rng(0).random(30).astype(np.float32)
    found = StandardScores(1, exclude_recent=exclude).push(row)
    shown = row[:candidates].tolist()
    mean = sum(shown) / candidates
    spread = (sum((value - mean) ** 2 for value in shown) / candidates) ** 0.5
    np.testing.assert_allclose(found[:candidates], [(value - mean) / spread for value in shown], rtol=1e-4)
    assert np.isnan(found[candidates:]).all()


def test_a_row_without_differences_counts_as_zeros():
    scores = StandardScores(1)
    for row in (np.full(9, 0.3), 0.3 + 1e-7 * np.arange(9), np.ones(1)):
        assert not scores.push(row.astype(np.float32)).any()
    assert scores.push(np.zeros(0, np.float32)).shape == (0,)


def test_recent_frames_take_no_probability_from_candidates(lap):
    method = fitted("fabmap", lap)
    bags = [method.describe([one]) for one in method.features(lap)]
    alone, stream = method.new_map(exclude_recent=0), method.new_map(exclude_recent=5)
    for bag in bags[:10]:
        alone.add(bag)
        stream.add(bag)
    for _ in range(4):  # the robot stands still
        stream.add(bags[5])
    expected = alone.similarities(bags[5])
    np.testing.assert_allclose(stream.similarities(bags[5])[:10], expected, rtol=1e-6)
    assert expected.argmax() == 5


def test_fabmap_is_the_likelihood_over_its_words(lap, second_lap):
    """The method adds nothing to `FabMap`, which is tested by the equations."""
    method = fitted("fabmap", lap)
    words = fitted("bow", lap)
    bags = [words.describe([one]) for one in words.features(lap)]
    expected = FabMap.learn(bags, len(words.vocabulary))
    places = method.new_map(exclude_recent=0)
    for image, bag in zip(lap, bags, strict=True):
        expected.add(bag)
        places.add(method.describe(method.features([image])))
    query = method.describe(method.features(second_lap[7:8]))
    np.testing.assert_allclose(places.similarities(query), expected.similarities(query), rtol=1e-6)


def test_incremental_words_ignore_rows_of_zeros(lap):
    method = build_method(settings("bow-incremental"))
    padded, bare = method.new_map(exclude_recent=0), method.new_map(exclude_recent=0)
    for image in lap:
        rows = method.describe(method.features([image]))
        shown = rows[rows.any(axis=1)]
        np.testing.assert_array_equal(padded.similarities(rows), bare.similarities(shown))
        padded.add(rows)
        bare.add(shown)
    assert padded.nbytes == bare.nbytes > 0


@pytest.mark.parametrize("name", TRAINED)
def test_words_of_other_features_are_refused(name, lap):
    arrays = fitted(name, lap[:4]).to_arrays()
    with pytest.raises(ModelError, match="rootsift features, wanted orb"):
        build_method(settings(name, words__keypoints="orb")).restore(arrays)


def test_a_damaged_fabmap_model_is_refused(lap):
    method = fitted("fabmap", lap[:4])
    arrays = method.to_arrays()
    shorter = {key: array[1:] if key.startswith("tree.") else array for key, array in arrays.items()}
    shorter["tree.parent"] = np.zeros_like(shorter["tree.parent"])
    with pytest.raises(ModelError, match="damaged"):
        build_method(method.config).restore(shorter)
    with pytest.raises(ModelError, match="damaged"):
        build_method(method.config).restore({**arrays, "samples.words": arrays["samples.words"] + 10_000})


@pytest.mark.parametrize("name", TRAINED)
def test_misuse_is_named(name, lap):
    method = build_method(settings(name))
    with pytest.raises(FitError, match="fit first"):
        method.describe(method.features(lap[:1]))
    with pytest.raises(ConfigError, match=r"words\.keypoints"):
        settings(name, words__keypoints="surf")


@pytest.mark.parametrize("name", NAMES)
def test_real_places_are_found_again(name, data_folder):
    """Every tenth frame of two walks through one campus; words of the trained methods come from other streets."""

    def every(step, folder):
        images = ImageSequence(data_folder / folder)
        return [images[i] for i in range(0, len(images), step)]

    detector = LoopDetector(
        settings(name, words__max_features=400, words__branching=40, words__side=320, sequence__length=3)
    )
    if not detector.method.fitted:
        detector.fit(every(10, "street/images"), source="streets")
    detector.set_reference(every(10, "gardens_point/day_left"))
    decisions = [d for d in detector.detect(every(10, "gardens_point/day_right")) if d.match is not None]
    assert np.mean([d.match == d.query for d in decisions]) >= 0.6  # chance: 0.05
