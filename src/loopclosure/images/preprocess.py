"""Images to the input of a network: the only mean and standard deviation arithmetic of the library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from loopclosure.errors import ConfigError
from loopclosure.images.decode import Image, check_image


@dataclass(frozen=True)
class Preprocessing:
    """Resize, then ``(x / 255 - mean) / std``, channels first.

    An axis that shrinks is averaged over the area of each new pixel (no aliasing); an axis that grows is interpolated
    linearly. The aspect ratio is not kept: the whole image is seen.

    Attributes
    ----------
    height, width : int
        Size of the input, pixels.
    mean, std : tuple of 3 float
        Of the red, green and blue values in 0..1.

    Raises
    ------
    ConfigError
        If a size is not positive, or `mean` or `std` are not three finite numbers (`std` above 0).

    Examples
    --------
    >>> prepare = Preprocessing(2, 2, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
    >>> prepare(np.full((4, 4, 3), 255, np.uint8))[0]
    array([[1., 1.],
           [1., 1.]], dtype=float32)
    """

    height: int
    width: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Check the values."""
        if min(self.height, self.width) < 1:
            raise ConfigError(f"the network input is {self.width}x{self.height} pixels, wanted at least 1x1")
        for name in ("mean", "std"):
            values = tuple(float(value) for value in getattr(self, name))  # a header gives lists
            if len(values) != 3 or not np.isfinite(values).all() or (name == "std" and min(values) <= 0):
                raise ConfigError(f"{name} = {values}: wanted three finite numbers{' above 0' * (name == 'std')}")
            object.__setattr__(self, name, values)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width

    def __call__(self, image: Image) -> npt.NDArray[np.float32]:
        """Prepare one image.

        Parameters
        ----------
        image : uint8 (h, w, 3)
            RGB, any size.

        Returns
        -------
        float32 (3, height, width)
        """
        return self.batch([image])[0]

    def batch(self, images: Sequence[Image]) -> npt.NDArray[np.float32]:
        """Prepare several images; they may differ in size.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB.

        Returns
        -------
        float32 (n, 3, height, width)

        Raises
        ------
        ImageError
            If one is no uint8 (h, w, 3) array.
        """
        scale = (1 / (255 * np.array(self.std))).astype(np.float32)
        shift = (np.array(self.mean) / self.std).astype(np.float32)
        out = np.empty((len(images), 3, self.height, self.width), np.float32)
        for image, planes in zip(images, out, strict=True):
            resized = _resize(check_image(image, min_side=1), self.height, self.width)
            for channel in range(3):
                np.multiply(resized[:, :, channel], scale[channel], out=planes[channel])
                planes[channel] -= shift[channel]
        return out


def _resize(image: Image, height: int, width: int) -> Image:
    # OpenCV averages areas only where no axis grows, so the axes that shrink go first.
    smaller = (min(height, image.shape[0]), min(width, image.shape[1]))
    if smaller != image.shape[:2]:
        image = cv2.resize(image, smaller[::-1], interpolation=cv2.INTER_AREA)
    if smaller != (height, width):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    return image
