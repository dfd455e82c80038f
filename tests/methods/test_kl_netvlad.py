"""The default descriptor against a plain reading: NetVLAD and layout of a weighted map, centred, whitened, weighed."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config
from loopclosure.aggregation.change import change
from loopclosure.errors import ModelError
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.methods import build_method
from loopclosure.store import agreed_config


@pytest.fixture(scope="module")
def images():
    return [frame.image for frame in Drive(SimulationSettings(frames=24, width=96, height=72, revisit=False))]


def fitted(images, **settings):
    small = {"features.height": 96, "features.width": 96, "aggregation.clusters": 5, "aggregation.components": 8}
    config = Config().with_settings(small | {name.replace("__", "."): value for name, value in settings.items()})
    method = build_method(config)
    method.fit(method.features(images))
    return method


def unit(vector):
    return vector / np.linalg.norm(vector)


def netvlad_by_definition(maps, weights, arrays):
    """Eq. 19, each position as often as it counts."""
    centres, sharp, bias = (arrays[f"netvlad.{name}"].astype(float) for name in ("centres", "weights", "bias"))
    found = np.zeros_like(centres)
    for row in range(maps.shape[0]):
        for column in range(maps.shape[1]):
            local = unit(maps[row, column].astype(float))
            odds = np.exp(sharp @ local + bias - (sharp @ local + bias).max())
            for k in range(len(centres)):
                found[k] += weights[row, column] * odds[k] / odds.sum() * (local - centres[k])
    return unit(np.concatenate([unit(one) for one in found]))


def layout_by_definition(maps, weights):
    rows, columns, channels = maps.shape
    found = np.zeros((rows, columns // 2, channels))
    for row in range(rows):
        for column in range(columns):
            found[row, column // 2] += weights[row, column] * maps[row, column] / 2
    return unit(found.ravel())


def test_a_descriptor_is_netvlad_and_layout_of_what_changes(images):
    method = fitted(images)
    maps = method.features(images[:6])
    weights = change(maps[5], maps[0])
    assert np.ptp(weights) > 0.5
    expected = [netvlad_by_definition(maps[5], weights, method.to_arrays()), layout_by_definition(maps[5], weights)]
    np.testing.assert_allclose(method.describe(maps), np.concatenate(expected), atol=2e-5)


def test_what_the_map_keeps_is_both_parts_whitened_and_weighed(images):
    method = fitted(images, aggregation__layout_weight=0.5)
    arrays = method.to_arrays()
    descriptor = method.describe(method.features(images[:6])) - 0.01
    parts = np.split(descriptor, [arrays["netvlad.centres"].size])
    kept = [unit(arrays[f"reduction.basis{i}"] @ part) for i, part in enumerate(parts)]
    expected = np.concatenate([kept[0], 0.5 * kept[1]]) / np.sqrt(1.25)
    np.testing.assert_allclose(method.reduce(descriptor), expected, atol=1e-5)


def test_each_part_can_be_left_out(images):
    plain = fitted(images, aggregation__layout_weight=0, aggregation__change_over=0)
    maps = plain.features(images[:6])
    ones = np.ones(maps[5].shape[:2])
    alone = netvlad_by_definition(maps[5], ones, plain.to_arrays())
    assert plain.window == 1
    np.testing.assert_allclose(plain.describe(maps[5:]), alone, atol=2e-5)
    even = fitted(images, aggregation__change_over=0)
    both = np.concatenate([alone, layout_by_definition(maps[5], ones)])
    np.testing.assert_allclose(even.describe(maps[5:]), both, atol=2e-5)
    assert plain.reduce(plain.describe(maps[5:])).shape == (8,)
    assert even.reduce(even.describe(maps[5:])).shape == (16,)


def test_without_whitening_there_is_neither(images):
    method = fitted(images, aggregation__components=0)
    assert (method.window, method.calibrated) == (1, False)
    assert method.describe(method.features(images[:1])).shape == (5 * 112,)


def test_state_comes_back(images):
    method = fitted(images)
    again = build_method(method.config)
    again.restore(method.to_arrays())
    maps = method.features(images[3:9])
    np.testing.assert_array_equal(again.reduce(again.describe(maps)), method.reduce(method.describe(maps)))


def test_a_model_is_not_used_without_the_whitening_that_it_was_fitted_for():
    header = {"config": Config().with_settings({"aggregation.centre_window": 0}).model_dump()}
    with pytest.raises(ModelError, match="centre_window = 0, wanted 60"):
        agreed_config(Config(), header)
