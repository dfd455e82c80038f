"""The same place, seen otherwise: another crop, light, focus, and something in front of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torchvision.transforms import v2

from loopclosure.images.decode import Image


class Augmentation:
    """Crop, colour, blur and an occluder, drawn anew for each image. Nothing is mirrored: that is another place.

    Parameters
    ----------
    height, width : int
        Size of what comes out, pixels.

    Notes
    -----
    torchvision draws from torch's global generator. It is set inside and put back as it was.

    Examples
    --------
    >>> Augmentation(64, 48)([np.zeros((240, 320, 3), np.uint8)], seed=0)[0].shape
    (64, 48, 3)
    """

    def __init__(self, height: int, width: int) -> None:
        self._transform = v2.Compose(
            [
                v2.RandomResizedCrop((height, width), scale=(0.6, 1.0), ratio=(0.8, 1.25), antialias=True),
                v2.RandomApply([v2.ColorJitter(brightness=0.4, contrast=0.4, saturation=0.3)], p=0.8),
                v2.RandomApply([v2.GaussianBlur(5, sigma=(0.1, 1.5))], p=0.2),
                v2.RandomErasing(p=0.4, scale=(0.02, 0.2), value=127),
            ]
        )

    def __call__(self, images: Sequence[Image], *, seed: int) -> list[Image]:
        """Return one new uint8 (height, width, 3) image for each; the same seed gives the same ones."""
        planes = [torch.from_numpy(image).permute(2, 0, 1) for image in images]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            changed = [self._transform(image) for image in planes]
        return [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in changed]
