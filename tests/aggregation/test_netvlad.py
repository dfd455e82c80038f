"""NetVLAD against a plain-loop reading of Eq. 19, and its torch twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from loopclosure.aggregation.netvlad import NetVLAD
from loopclosure.aggregation.netvlad_torch import NetVLADLayer
from loopclosure.errors import FitError


def make_maps(count=6, depth=10, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 4, 3, depth)).astype(np.float32)


def by_loops(layer: NetVLAD, one_map: np.ndarray) -> np.ndarray:
    """Eq. 19, one number at a time, in double precision."""
    depth = one_map.shape[-1]
    vectors = [vector / math.sqrt(sum(x * x for x in vector)) for vector in one_map.reshape(-1, depth).astype(float)]
    rows = []
    for k in range(len(layer.centres_)):
        row = np.zeros(depth)
        for y in vectors:
            logits = [
                sum(layer.weights_[m][j] * y[j] for j in range(depth)) + layer.bias_[m]
                for m in range(len(layer.centres_))
            ]
            top = max(logits)
            share = math.exp(logits[k] - top) / sum(math.exp(value - top) for value in logits)
            for j in range(depth):
                row[j] += share * (y[j] - layer.centres_[k][j])
        rows.append(row / math.sqrt(sum(x * x for x in row)))
    flat = np.concatenate(rows)
    return flat / math.sqrt(sum(x * x for x in flat))


def test_equals_the_equation_read_in_loops():
    maps = make_maps()
    layer = NetVLAD(4).fit(maps)
    descriptors = layer.transform(maps)
    for one_map, descriptor in zip(maps, descriptors, strict=True):
        np.testing.assert_allclose(descriptor, by_loops(layer, one_map), atol=1e-5)


def test_torch_twin_gives_the_same_and_comes_back():
    maps = make_maps()
    layer = NetVLAD(5).fit(maps)
    twin = NetVLADLayer(layer)
    there = twin(torch.from_numpy(maps).permute(0, 3, 1, 2)).detach().numpy()
    np.testing.assert_allclose(there, layer.transform(maps), atol=1e-5)
    np.testing.assert_array_equal(twin.to_numpy().transform(maps), layer.transform(maps))


def test_torch_twin_learns():
    twin = NetVLADLayer(NetVLAD(3).fit(make_maps()))
    twin(torch.from_numpy(make_maps()).permute(0, 3, 1, 2))[:, 0].sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in twin.parameters())


def test_alpha_gives_the_second_cluster_a_hundredth_on_average():
    maps = make_maps(20)
    layer = NetVLAD(6).fit(maps)
    vectors = maps.reshape(-1, 10) / np.linalg.norm(maps.reshape(-1, 10), axis=1, keepdims=True)
    logits = np.sort(vectors @ layer.weights_.T + layer.bias_, axis=1)
    assert np.mean(logits[:, -2] - logits[:, -1]) == pytest.approx(math.log(0.01), rel=1e-4)


def test_rows_are_unit_and_order_of_positions_does_not_matter():
    maps = make_maps()
    layer = NetVLAD(4).fit(maps)
    descriptors = layer.transform(maps)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(layer.transform(maps[:, ::-1, ::-1]), descriptors, atol=1e-6)
    np.testing.assert_allclose(layer.transform(maps[2:3])[0], descriptors[2], atol=1e-6)


def test_blank_maps_give_zeros_and_no_nan():
    layer = NetVLAD(4).fit(make_maps())
    assert not layer.transform(np.zeros((1, 4, 3, 10), np.float32)).any()
    flat = NetVLAD(4).fit(np.ones((2, 4, 3, 10), np.float32))
    assert np.isfinite(flat.transform(make_maps())).all()


def test_no_images_are_legal():
    assert NetVLAD(4).fit(make_maps()).transform(make_maps(0)).shape == (0, 40)


def test_errors_say_what_is_wrong():
    with pytest.raises(FitError, match="12 local vectors cannot make 64 clusters"):
        NetVLAD(64).fit(make_maps(1))
    with pytest.raises(FitError, match="call fit first"):
        NetVLAD(4).transform(make_maps())
    with pytest.raises(FitError, match="7 dimensions, the clusters 10"):
        NetVLAD(4).fit(make_maps()).transform(make_maps(depth=7))
