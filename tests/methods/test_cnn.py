"""`cnn` and its relatives: pooling against torch, components against scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from loopclosure import Config
from loopclosure.aggregation.pooling import pool_cells
from loopclosure.errors import ConfigError, FitError, ModelError
from loopclosure.features.backbones import Backbone
from loopclosure.methods import build_method
from loopclosure.methods.cnn import PooledPCA

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("shape", [(2, 14, 14, 5), (1, 7, 10, 3), (3, 2, 1, 4)])
@pytest.mark.parametrize("cells", [1, 3, 4])
def test_cells_are_torchs_adaptive_average_pooling(shape, cells):
    maps = RNG.random(shape, np.float32)
    wanted = torch.nn.functional.adaptive_avg_pool2d(torch.from_numpy(maps).permute(0, 3, 1, 2), cells)
    found = pool_cells(maps, cells)
    assert found.shape == (shape[0], cells * cells, shape[3])
    np.testing.assert_allclose(found, wanted.flatten(2).transpose(1, 2).numpy(), atol=1e-6)


def test_descriptor_is_the_pooled_map(lap):
    method = build_method(Config().with_settings({"method": "cnn", "features.height": 64, "features.width": 64}))
    method.fit([])
    maps = Backbone("efficientnet-lite0", "s16", height=64, width=64).maps(lap[:1])["s16"]
    pooled = pool_cells(maps).ravel()
    np.testing.assert_allclose(method.describe(method.features(lap[:1])), pooled / np.linalg.norm(pooled), atol=1e-5)


@pytest.mark.parametrize("whiten", [False, True])
@pytest.mark.parametrize(("rule", "kept"), [({"components": 6}, 6), ({"gamma": 0.9}, 4), ({"gamma": 0.1}, 19)])
def test_components_are_scikit_learns(rule, kept, whiten):
    features = RNG.normal(size=(20, 9, 4)).astype(np.float32) + 5
    rows = features.reshape(20, 36)
    wanted = PCA(kept, whiten=whiten, svd_solver="full").fit(rows).transform(rows)
    found = PooledPCA(**rule, whiten=whiten).fit(features).transform(features)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(np.abs(found), np.abs(wanted), atol=1e-3)  # a component may be turned round


def test_energy_chooses_the_components():
    directions = np.linalg.qr(RNG.normal(size=(30, 30)))[0][:2]
    features = (RNG.normal(size=(50, 2)) * [10, 1]) @ directions
    assert PooledPCA(energy=0.9).fit(features).transform(features).shape == (50, 1)
    assert PooledPCA(energy=1.0).fit(features).transform(features).shape == (50, 2)


def test_equal_frames_give_finite_codes():
    features = np.full((5, 9, 4), 0.3, np.float32)
    for whiten in (False, True):
        code = PooledPCA(gamma=0.5, whiten=whiten).fit(features)
        assert np.isfinite(code.transform(features)).all()


def test_errors():
    with pytest.raises(FitError, match="found 1 frame"):
        PooledPCA(gamma=0.5).fit(np.zeros((1, 9, 4), np.float32))
    with pytest.raises(FitError, match="5 frames allow at most 4"):
        PooledPCA(components=7).fit(RNG.random((5, 9, 4)))
    with pytest.raises(ModelError, match="damaged"):
        PooledPCA(gamma=0.5).restore({"mean": np.zeros(3), "basis": np.zeros((2, 4))})
    with pytest.raises(ConfigError, match="cnn-ae knows"):
        build_method(Config().with_settings({"method": "cnn-ae", "compression.energy": 0.9}))
    with pytest.raises(ConfigError, match="that is --method kl-netvlad --backbone vgg16"):
        build_method(Config().with_settings({"method": "netvlad-vgg16", "compression.reading": "channel"}))
