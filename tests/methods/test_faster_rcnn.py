"""Regions against torchvision's own model, and what is made of them against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights, fasterrcnn_resnet50_fpn
from torchvision.models.detection.image_list import ImageList

from loopclosure import Config
from loopclosure.errors import ConfigError, WeightsError
from loopclosure.features.regions import RegionNetwork, Regions
from loopclosure.methods import build_method
from loopclosure.methods.faster_rcnn import pool_regions
from loopclosure.weights import WEIGHTS


@pytest.fixture(scope="module")
def theirs():
    """torchvision's model with numbers of its own."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        model = fasterrcnn_resnet50_fpn(weights=None, weights_backbone=None, rpn_post_nms_top_n_test=20).eval()
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.eps = 0.0  # as torchvision sets it for the COCO weights
    return model


def test_regions_are_torchvisions(theirs, lap, tmp_path):
    torch.save(theirs.state_dict(), tmp_path / "own.pth")
    network = RegionNetwork(weights=str(tmp_path / "own.pth"), height=64, width=96, most=20)
    found = network.regions(lap[:2])
    batch = torch.from_numpy(network.preprocessing.batch(lap[:2]))
    with torch.inference_mode():
        pyramid = theirs.backbone(batch)
        boxes, _ = theirs.rpn(ImageList(batch, [(64, 96)] * 2), pyramid)
        vectors = theirs.roi_heads.box_roi_pool(pyramid, boxes, [(64, 96)] * 2).mean((2, 3))
    assert [len(one.scores) for one in found] == [len(one) for one in boxes]
    np.testing.assert_allclose(np.concatenate([one.boxes for one in found]), torch.cat(boxes).numpy(), atol=1e-3)
    np.testing.assert_allclose(np.concatenate([one.vectors for one in found]), vectors.numpy(), atol=1e-4)
    assert all((np.diff(one.scores) <= 0).all() and one.scores.max() <= 1 for one in found)


def test_weights_of_another_network_are_refused(theirs, tmp_path):
    state = theirs.backbone.state_dict()
    torch.save(state, tmp_path / "part.pth")
    with pytest.raises(WeightsError, match="does not fit fasterrcnn_resnet50_fpn: missing"):
        RegionNetwork(weights=str(tmp_path / "part.pth"))


def test_the_table_has_torchvisions_address():
    row, published = WEIGHTS["fasterrcnn-coco"], FasterRCNN_ResNet50_FPN_Weights.COCO_V1
    assert row.url == published.url
    assert row.size_mb == published.meta["_file_size"]
    assert f"-{row.sha256}.pth" in row.file


def test_mean_and_maximum_are_weighted_by_the_score():
    rng = np.random.default_rng(0)
    scores, vectors = rng.random(5, np.float32), rng.normal(size=(5, 256)).astype(np.float32)
    mean, most = np.zeros(256), np.full(256, -np.inf)
    for score, vector in zip(scores, vectors, strict=True):
        for channel in range(256):
            mean[channel] += score * vector[channel] / scores.sum()
            most[channel] = max(most[channel], score * vector[channel])
    found = pool_regions(Regions(np.zeros((5, 4), np.float32), scores, vectors))
    np.testing.assert_allclose(found[:256], mean / np.linalg.norm(mean), atol=1e-6)
    np.testing.assert_allclose(found[256:], most / np.linalg.norm(most), atol=1e-6)


def test_an_image_without_regions_says_nothing():
    none = Regions(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros((0, 256), np.float32))
    assert not pool_regions(none).any()
    assert RegionNetwork(weights="random", height=32, width=32).regions([]) == []


def test_another_network_is_refused():
    with pytest.raises(ConfigError, match="runs on fasterrcnn_resnet50_fpn and its layer fpn alone, found vgg16"):
        build_method(Config().with_settings({"method": "faster-rcnn", "features.backbone": "vgg16"}))
