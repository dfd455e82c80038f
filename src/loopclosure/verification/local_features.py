"""The local features of one frame, in a byte an entry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.features.keypoints import DESCRIPTOR_SIZES, Keypoints

_ROOT_SIFT_STEP = 1 / 512  # entries of a RootSIFT row are rarely above a half; a byte holds them as it holds SIFT's


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """Points of one image and their descriptors, a byte an entry.

    Attributes
    ----------
    points : ndarray of float32, shape (n, 2)
        Column and row in pixels of the image, centre of the first pixel at (0, 0), strongest first.
    descriptors : ndarray of uint8, shape (n, 128) or (n, 32)
        RootSIFT in steps of 1/512, or the packed bits of ORB.
    size : tuple of int
        Width and height of the image, pixels.
    """

    points: np.ndarray
    descriptors: np.ndarray
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def nbytes(self) -> int:
        """Bytes that they take."""
        return int(self.points.nbytes + self.descriptors.nbytes)

    def vectors(self) -> np.ndarray:
        """Return the descriptors as float32 rows whose squared Euclidean distance is what the kind compares by.

        That of unpacked bits is the Hamming distance.
        """
        binary = self.descriptors.shape[1] == DESCRIPTOR_SIZES["orb"]
        return (np.unpackbits(self.descriptors, axis=1) if binary else self.descriptors).astype(np.float32)


def compact(keypoints: Keypoints, size: tuple[int, int]) -> LocalFeatures:
    """Store keypoints of an image of `size` (width, height) in a byte an entry."""
    descriptors = keypoints.descriptors
    if descriptors.dtype != np.uint8:
        descriptors = np.minimum(np.rint(descriptors / _ROOT_SIFT_STEP), 255).astype(np.uint8)
    return LocalFeatures(keypoints.points, descriptors, size)
