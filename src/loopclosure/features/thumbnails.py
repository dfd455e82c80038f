"""Images to patch-normalised grey thumbnails, the descriptor of SeqSLAM.

Source: Milford and Wyeth, "SeqSLAM: visual route-based navigation for sunny summer days and stormy winter nights",
ICRA 2012, and its public implementation OpenSeqSLAM (2013). With `quantise` the values are OpenSeqSLAM's for the same
grey thumbnail.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import numpy as np
from PIL import Image

from loopclosure.errors import ConfigError, ImageError

_HIGHEST = 3  # horizontal and vertical frequency of a kept coefficient, together


def thumbnails(
    images: Iterable[np.ndarray], *, width: int = 64, height: int = 32, patch: int = 8, quantise: bool = False
) -> np.ndarray:
    """Describe images by patch-normalised grey thumbnails.

    Parameters
    ----------
    images : iterable of ndarray of uint8, shape (h, w, 3)
        RGB images; they may differ in size.
    width, height : int
        Size of the thumbnail, pixels; multiples of `patch`.
    patch : int
        Side of the square patches, pixels; at least 2.
    quantise : bool
        Whether to round to whole standard deviations as OpenSeqSLAM does.

    Returns
    -------
    ndarray of float32 or uint8, shape (n, height, width)
        Deviation of each pixel from its patch, in standard deviations; quantised, 127 stands for none. All zeros for
        an image without any structure.

    Raises
    ------
    ImageError
        If an image is not uint8 (h, w, 3) or has no pixels.
    ConfigError
        If the thumbnail cannot be cut into whole patches.

    Examples
    --------
    >>> thumbnails([np.zeros((48, 64, 3), np.uint8)], width=16, height=8, quantise=True).shape
    (1, 8, 16)
    """
    grey = [grey_thumbnail(image, width=width, height=height) for image in images]
    stack = np.stack(grey) if grey else np.empty((0, height, width), np.uint8)
    return normalise_patches(stack, patch, quantise=quantise)


def grey_thumbnail(image: np.ndarray, *, width: int = 64, height: int = 32) -> np.ndarray:
    """Reduce an RGB image to a small grey one with an antialiased Lanczos filter.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w, 3)
    width, height : int
        Size of the thumbnail, pixels.

    Returns
    -------
    ndarray of uint8, shape (height, width)
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ImageError(f"found an image of {image.dtype} {image.shape}, wanted uint8 (h, w, 3) with pixels in it")
    return np.asarray(Image.fromarray(image).convert("L").resize((width, height), Image.Resampling.LANCZOS))


def normalise_patches(grey: np.ndarray, patch: int = 8, *, quantise: bool = False) -> np.ndarray:
    """Give every square patch zero mean and unit standard deviation (with n - 1).

    Parameters
    ----------
    grey : ndarray of uint8, shape (n, height, width)
    patch : int
        Side of the patches, pixels.
    quantise : bool
        Whether to round to whole standard deviations, halves away from zero, and to store them around 127.

    Returns
    -------
    ndarray of float32 or uint8, shape (n, height, width)
        A flat patch is 0. Quantised, this is what OpenSeqSLAM makes of it, and far from every other patch; as float32
        it is the mean of every patch, so that an area without structure says little.

    Raises
    ------
    ConfigError
        If `patch` is less than 2 or does not divide height and width.

    Examples
    --------
    >>> normalise_patches(np.array([[[1, 3], [3, 1]]], np.uint8), patch=2)[0].round(2)
    array([[-0.87,  0.87],
           [ 0.87, -0.87]], dtype=float32)
    """
    n, height, width = grey.shape
    if patch < 2 or height % patch or width % patch:
        raise ConfigError(f"a thumbnail of {width}x{height} pixels cannot be cut into patches of {patch}x{patch}")
    patches = grey.reshape(n, height // patch, patch, width // patch, patch).astype(np.float64)
    patches -= patches.mean(axis=(2, 4), keepdims=True)
    deviation = np.sqrt((patches**2).sum(axis=(2, 4), keepdims=True) / (patch * patch - 1))
    flat = deviation == 0
    patches /= np.where(flat, 1, deviation)
    if not quantise:
        return patches.reshape(grey.shape).astype(np.float32)
    levels = 127 + np.trunc(patches + np.copysign(0.5, patches))
    return np.where(flat, 0, levels).reshape(grey.shape).astype(np.uint8)


def low_frequencies(thumbnails: np.ndarray, patch: int = 4) -> np.ndarray:
    """Reduce every patch to its nine lowest frequencies, as JPEG does: half the numbers, nearly the same products.

    Parameters
    ----------
    thumbnails : ndarray of float32, shape (n, height, width)
        From `normalise_patches`, not quantised; moved sideways or not.
    patch : int
        Side of the patches, pixels; at least 4.

    Returns
    -------
    ndarray of float32, shape (n, 9 * patches)
        Coefficients of the orthonormal cosine transform whose two frequencies sum to 1, 2 or 3. The constant one is
        left out, because it is 0 in a patch without a mean.

    Examples
    --------
    >>> low_frequencies(np.zeros((2, 32, 64), np.float32)).shape
    (2, 1152)
    """
    n, height, width = thumbnails.shape
    patches = thumbnails.reshape(n, height // patch, patch, width // patch, patch).swapaxes(2, 3)
    pixels = patches.reshape(n, height * width // patch**2, patch**2)
    return (pixels @ _low_cosines(patch)).reshape(n, pixels.shape[1] * _low_cosines(patch).shape[1])


@cache
def _low_cosines(patch: int) -> np.ndarray:
    """Return the cosine patterns of `low_frequencies`, one column each."""
    place = np.arange(patch)
    waves = np.cos(np.pi / patch * np.outer(place, place + 0.5))
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    low = [(u, v) for u in place for v in place if 0 < u + v <= _HIGHEST]
    return np.stack([np.outer(waves[u], waves[v]).ravel() for u, v in low], axis=1).astype(np.float32)
