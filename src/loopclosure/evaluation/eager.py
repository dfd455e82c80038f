"""What people write instead: torchvision and torch as their tutorials show them, and brute-force search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn
from torchvision import transforms

from loopclosure.aggregation.netvlad import NetVLAD
from loopclosure.aggregation.netvlad_torch import NetVLADLayer
from loopclosure.config import Config
from loopclosure.features.backbones import Backbone

_MOST = 100  # places: its uncompressed descriptors are half a megabyte each, and the search must not decide the race


class EagerPipeline:
    """From an image file to the nearest earlier image: PIL, transforms, fp32 network, NetVLAD without KL, all pairs.

    Parameters
    ----------
    config : Config
        The network, its layer, weights and input size, and the number of clusters.
    files : sequence of Path
        Images to fit the clusters on.

    Attributes
    ----------
    flop : float
        Operations of the network for one image, two for a multiplication with its addition.
    """

    def __init__(self, config: Config, files: Sequence[Path]) -> None:
        features = config.features
        size = (features.height, features.width)
        backbone = Backbone(features.backbone, features.layer, weights=features.weights, height=size[0], width=size[1])
        self._module = backbone.module.to(memory_format=torch.contiguous_format)
        mean, std = backbone.preprocessing.mean, backbone.preprocessing.std
        self._transform = transforms.Compose(
            [transforms.Resize(size), transforms.ToTensor(), transforms.Normalize(mean, std)]
        )
        self.flop = _operations(self._module, size)
        maps = np.concatenate([self._maps(file).permute(0, 2, 3, 1).numpy() for file in files])
        self._netvlad = NetVLADLayer(NetVLAD(config.aggregation.clusters).fit(maps)).eval()
        self._places: list[torch.Tensor] = []

    def __call__(self, file: Path) -> int:
        """Return the nearest earlier image."""
        with torch.inference_mode():
            descriptor = self._netvlad(self._maps(file))
            places = torch.cat(self._places[-_MOST:]) if self._places else descriptor
            self._places = [*self._places[-_MOST:], descriptor]
            return int(torch.cdist(descriptor, places).argmin())

    def _maps(self, file: Path) -> torch.Tensor:
        with Image.open(file) as image, torch.inference_mode():
            (maps,) = self._module(self._transform(image.convert("RGB"))[None])
        return maps


def _operations(module: nn.Module, size: tuple[int, int]) -> float:
    """Count those of the convolutions, which are all but a percent."""
    counts: list[int] = []

    def count(convolution: nn.Module, _inputs: object, output: torch.Tensor) -> None:
        counts.append(2 * output.numel() * convolution.weight[0].numel())

    found = [part for part in module.modules() if isinstance(part, nn.Conv2d)]
    hooks = [convolution.register_forward_hook(count) for convolution in found]
    with torch.inference_mode():
        module(torch.zeros(1, 3, *size))
    for hook in hooks:
        hook.remove()
    return float(sum(counts))
