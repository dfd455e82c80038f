"""Regions that look like objects, and what the network sees in each of them (Ren et al. 2015)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torchvision.models.detection import FasterRCNN, fasterrcnn_resnet50_fpn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.rpn import concat_box_prediction_layers

from loopclosure.features.checkpoints import load_strictly, read_checkpoint
from loopclosure.images.preprocess import Preprocessing
from loopclosure.weights import Progress, file_sha256, locate, weights_for

BACKBONE = "fasterrcnn_resnet50_fpn"
CHANNELS = 256
_HEADS = ("roi_heads.box_head", "roi_heads.box_predictor")  # they only name the objects
_ANCHOR_SIZES, _ASPECT_RATIOS = ((32,), (64,), (128,), (256,), (512,)), ((0.5, 1.0, 2.0),)


class Regions(NamedTuple):
    """What one image shows, region by region, the likeliest object first.

    Attributes
    ----------
    boxes : ndarray of float32, shape (p, 4)
        Left, top, right and bottom edge, pixels of the network's input.
    scores : ndarray of float32, shape (p,)
        Probability that it is an object of any kind.
    vectors : ndarray of float32, shape (p, 256)
        Feature pyramid of the backbone, averaged over the region.
    """

    boxes: np.ndarray
    scores: np.ndarray
    vectors: np.ndarray


class RegionNetwork:
    """Backbone, feature pyramid and region proposals of torchvision's Faster R-CNN.

    Parameters
    ----------
    weights : str or path
        ``"default"`` (COCO), a name, a file, or ``"random"``.
    height, width : int
        Size of the network's input, pixels.
    most : int
        Regions that are kept of each image, after overlapping ones were dropped.
    progress : callable, optional
        Told ``(arrived, in_all)`` bytes while weights are downloaded.

    Attributes
    ----------
    weights_name : str
        Name of the weights.
    weights_sha256 : str or None
        Of the file that was loaded; None for random weights.

    Raises
    ------
    WeightsError
        If the weights are not to be had or do not fit.
    """

    def __init__(
        self,
        *,
        weights: str = "default",
        height: int = 480,
        width: int = 640,
        most: int = 100,
        progress: Progress | None = None,
    ) -> None:
        record = weights_for(BACKBONE, weights)
        self.weights_name = record.name
        self.weights_sha256 = None
        self.preprocessing = Preprocessing(height, width, record.mean, record.std)
        network = _build(most)
        if record.random:
            _draw(network)
        else:
            path = locate(record, progress=progress)
            load_strictly(network, read_checkpoint(path), heads=_HEADS, origin=f"{path} does not fit {BACKBONE}")
            self.weights_sha256 = file_sha256(path)
        self._network = network.eval()

    def regions(self, images: Sequence[np.ndarray]) -> list[Regions]:
        """Find the regions of several images in one batch.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB, any size; may be empty.

        Returns
        -------
        list of n Regions
            With no row for an image in which nothing can be an object.
        """
        if not len(images):
            return []
        batch = torch.from_numpy(self.preprocessing.batch(images))
        sizes = [(self.preprocessing.height, self.preprocessing.width)] * len(images)
        with torch.inference_mode():
            pyramid = self._network.backbone(batch)
            boxes, scores = self._propose(ImageList(batch, sizes), list(pyramid.values()))
            vectors = self._network.roi_heads.box_roi_pool(pyramid, boxes, sizes).mean(dim=(2, 3))
        ends = np.cumsum([len(found) for found in boxes])[:-1]
        columns = ([found.numpy() for found in boxes], [found.numpy() for found in scores])
        return [Regions(*row) for row in zip(*columns, np.split(vectors.numpy(), ends), strict=True)]

    def _propose(self, images: ImageList, levels: list[torch.Tensor]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Do what torchvision's proposal network does, which keeps the scores to itself."""
        rpn = self._network.rpn
        objectness, deltas = rpn.head(levels)
        counts = [level[0].numel() for level in objectness]
        anchors = rpn.anchor_generator(images, levels)
        objectness, deltas = concat_box_prediction_layers(objectness, deltas)
        proposals = rpn.box_coder.decode(deltas, anchors).view(len(anchors), -1, 4)
        boxes, scores = rpn.filter_proposals(proposals, objectness, images.image_sizes, counts)
        return boxes, scores


def _build(most: int) -> FasterRCNN:
    """Return the network without numbers: no time, no memory, no random state."""
    anchors = AnchorGenerator(_ANCHOR_SIZES, _ASPECT_RATIOS * len(_ANCHOR_SIZES))  # holds numbers from the start
    with torch.device("meta"):
        network = fasterrcnn_resnet50_fpn(
            weights=None, weights_backbone=None, rpn_anchor_generator=anchors, rpn_post_nms_top_n_test=most
        )
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eps = 0.0  # as torchvision does for the COCO weights
    return network


def _draw(network: FasterRCNN, seed: int = 0) -> None:
    """Fill convolutions with normal numbers of variance 1 / fan-in."""
    generator = torch.Generator().manual_seed(seed)
    network.to_empty(device="cpu")
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.normal_(0, module.weight[0].numel() ** -0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.BatchNorm2d):
                module.reset_parameters()
        network.rpn.head.bbox_pred.weight.zero_()  # drawn numbers would move all regions out of the image
