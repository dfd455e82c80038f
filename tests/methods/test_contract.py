"""One contract for every row of the table: what the detector may rely on, whatever the method."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config, LoopDetector, Reason
from loopclosure.compression import autoencoder
from loopclosure.config import METHOD_SETTINGS
from loopclosure.errors import FitError
from loopclosure.methods import METHODS, build_method
from loopclosure.weights import WEIGHTS, weights_for

SMALL = {
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 8,
    "aggregation.centre_window": 15,
    "sequence.length": 3,
    "sequence.exclude_recent": 8,
    "learning.refit_at": (12,),
}
# Drawn networks make nearly the same of all images: what little differs would go with the mean.
RANDOM = {"features.weights": "random", "aggregation.centre_window": 0}
OWN = {"netvlad-resnet152": RANDOM, "netvlad-vgg16": RANDOM, "faster-rcnn": RANDOM}
# The same code in a tenth of the time.
QUICK = {
    "netvlad-resnet152": {"features.backbone": "resnet18"},
    "netvlad-vgg16": {"features.backbone": "alexnet"},
    "faster-rcnn": {"features.height": 32, "features.width": 32},
}


@pytest.fixture(scope="module", autouse=True)
def short_training():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(autoencoder, "_STEPS", 40)
        yield


@pytest.fixture(scope="module")
def network(tmp_path_factory, write_network):
    return write_network(tmp_path_factory.mktemp("onnx"))[0]


@pytest.fixture(scope="module", params=METHODS)
def config(request):
    own = OWN.get(request.param, {}) | QUICK.get(request.param, {})
    if request.param == "onnx":
        own = {"onnx.path": str(request.getfixturevalue("network"))}
    return Config().with_settings({"method": request.param} | SMALL | own)


@pytest.fixture(scope="module")
def method(config, lap):
    method = build_method(config)
    if not method.fitted:
        method.fit(method.features(lap))
    return method


def test_features_are_arrays_of_one_shape_and_repeatable(config, lap):
    method = build_method(config)
    features = method.features(lap[:3])
    assert len(features) == 3
    assert {(one.shape, one.dtype) for one in features} == {(features[0].shape, features[0].dtype)}
    assert method.features([]) == []
    for one, again in zip(features, build_method(config).features(lap[:3]), strict=True):
        np.testing.assert_array_equal(one, again)


def test_descriptors_are_finite_float32_of_length_one_and_repeatable(config, method, lap):
    described = [method.describe([one]) for one in method.features(lap[:3])]
    again = build_method(config)
    again.fit(again.features(lap))
    for one, image in zip(described, lap, strict=False):
        if isinstance(one, np.ndarray):
            assert one.dtype == np.float32
            assert np.isfinite(one).all()
            # A batch of one may round otherwise than a batch of three.
            np.testing.assert_allclose(one, again.describe(again.features([image])), atol=2e-5)
            if one.ndim == 1:
                assert np.linalg.norm(method.reduce(one)) == pytest.approx(1, abs=1e-5)
            assert method.blank().shape == one.shape
            assert not method.blank().any()


def test_a_map_is_empty_at_first_and_takes_blank_frames(method, lap):
    places = method.new_map(exclude_recent=0)
    newest, other = (method.describe([one]) for one in method.features([lap[0], lap[9]]))
    assert len(places) == 0
    assert places.similarities(newest).shape == (0,)
    for descriptor in (newest, other, method.blank()):
        places.add(descriptor)
    row = places.similarities(newest)
    assert row.shape == (3,)
    assert row.dtype == np.float32
    assert row.argmax() == 0
    assert np.isfinite(places.similarities(method.blank())).all()
    again = method.new_map(exclude_recent=0).restore(places.to_arrays())
    np.testing.assert_array_equal(again.similarities(newest), row)


def test_a_copy_scores_highest(config, lap):
    detector = LoopDetector(config)
    detector.set_reference(lap)
    decisions = [decision for decision in detector.detect(lap) if decision.match is not None]
    assert len(decisions) == 16 - 2
    assert [decision.match for decision in decisions] == [decision.query for decision in decisions]


def test_the_second_lap_is_found_in_one_stream(config, lap, second_lap):
    if config.features.weights == "random" or config.method == "onnx":
        pytest.skip("a network that learned nothing recognises no place from another position")
    decisions = list(LoopDetector(config).detect([*lap, *second_lap]))[16 + 2 :]
    assert np.mean([abs(d.match - (d.query - 16)) <= 1 for d in decisions]) >= 0.9  # chance: 0.2


@pytest.mark.parametrize("stop", [5, 19])
def test_a_saved_detector_goes_on_as_if_it_had_never_stopped(config, lap, second_lap, tmp_path, stop):
    stream = [*lap, None, *second_lap[:6]]
    detector = LoopDetector(config)
    for image in stream[:stop]:
        detector.add(image)
    detector.save(tmp_path / "saved")
    again = LoopDetector.load(tmp_path / "saved")
    for image in stream[stop:]:
        one, two = detector.add(image), again.add(image)
        assert (one.query, one.match, one.reason) == (two.query, two.match, two.reason)
        assert one.score == (two.score if two.score is None else pytest.approx(two.score, abs=1e-5))


def test_a_model_gives_the_same_descriptors(config, lap, tmp_path):
    teacher = LoopDetector(config)
    teacher.fit(lap, source="lap")
    teacher.save_model(tmp_path / "model")
    pupil = LoopDetector(model=tmp_path / "model")
    features = pupil.method.features(lap[:1])
    one, two = (detector.method.describe(features) for detector in (teacher, pupil))
    if isinstance(one, np.ndarray):
        np.testing.assert_allclose(one, two, atol=1e-6)


@pytest.mark.parametrize("value", [0, 90, None])
def test_one_frame_equal_frames_and_blank_frames_have_a_clear_answer(config, lap, value):
    image = lap[0] if value is None else np.full((64, 64, 3), value, np.uint8)
    decisions = list(LoopDetector(config).detect([image] * 12))
    assert decisions[0].reason in (Reason.WARMING_UP, Reason.TOO_RECENT)  # all that a stream of one frame says
    assert all(d.score is None or np.isfinite(d.score) for d in decisions)
    assert all((d.match is None) == (d.score is None) for d in decisions)
    assert decisions[-1].match is not None


def test_blank_frames_between_others_are_no_loops(config, lap):
    black = [np.zeros((64, 64, 3), np.uint8)] * 6
    decisions = list(LoopDetector(config).detect([*lap[:10], *black, *lap[10:], *black]))
    assert all(d.score is None or np.isfinite(d.score) for d in decisions)


def test_a_reference_of_one_frame_is_used_or_refused(config, lap):
    detector = LoopDetector(config.with_settings({"sequence.length": 1}))
    try:
        detector.set_reference(lap[:1])
    except FitError:
        return
    scores = [decision.score for decision in detector.detect(lap[:4])]
    assert all(score is None or np.isfinite(score) for score in scores)


def test_random_weights_are_marked(config):
    provenance = build_method(config).provenance
    assert str(provenance.get("weights", "")).startswith("random") == (config.features.weights == "random")


@pytest.mark.parametrize("name", [name for name, entry in METHODS.items() if entry.numbers])
def test_the_table_tells_the_length_of_a_descriptor(name, lap):
    own = OWN.get(name, {})
    small = {"features.height": 64, "features.width": 64} if own else {}
    method = build_method(Config().with_settings({"method": name} | small | own))
    shape = method.features(lap[:1])[0].shape
    rng = np.random.default_rng(0)
    method.fit([rng.random(shape, np.float32) for _ in range(420 if name == "cnn-pca" else 80)])
    assert np.size(method.reduce(method.blank())) == METHODS[name].numbers


def test_the_table_names_the_weights_that_the_settings_choose():
    assert set(METHOD_SETTINGS) <= set(METHODS)
    for name, entry in METHODS.items():
        assert entry.summary
        assert entry.source
        assert entry.learns
        if entry.weights:
            assert WEIGHTS[entry.weights] == weights_for(Config(method=name).features.backbone)


def test_a_name_decides_what_is_not_given():
    assert Config(method="netvlad-vgg16").features.backbone == "vgg16"
    named = Config().with_settings({"method": "netvlad-resnet152"})
    assert (named.features.backbone, named.features.layer, named.compression.reading) == ("resnet152", "conv5", "none")
    given = Config().with_settings({"method": "netvlad-resnet152", "features.backbone": "efficientnet-lite0"})
    assert (given.features.layer, given.compression.reading) == ("s16", "none")
    assert Config.from_dict(given.model_dump(mode="json")) == given
    assert Config.preset("paper").with_settings({"method": "netvlad-vgg16"}).features.backbone == "vgg16"
    assert Config.preset("paper").with_settings({"method": "cnn"}).features.backbone == "resnet152"
