"""The local features of one frame, small enough to keep for every frame of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopclosure.errors import ModelError
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

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"points": self.points, "descriptors": self.descriptors, "size": np.array(self.size, np.int64)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> LocalFeatures:
        """Rebuild what `to_arrays` gave.

        Raises
        ------
        ModelError
            If the arrays do not belong together.
        """
        points, descriptors, size = (arrays[name] for name in ("points", "descriptors", "size"))
        if (
            points.shape != (len(descriptors), 2)
            or points.dtype != np.float32
            or not np.isfinite(points).all()
            or descriptors.dtype != np.uint8
            or descriptors.ndim != 2
            or descriptors.shape[1] not in DESCRIPTOR_SIZES.values()
            or size.shape != (2,)
            or (size < 1).any()
        ):
            raise ModelError(
                f"local features of {points.shape} points and {descriptors.shape} descriptors, wanted (n, 2) and "
                "(n, 128) or (n, 32): is the file damaged?"
            )
        return cls(points, descriptors, (int(size[0]), int(size[1])))


def compact(keypoints: Keypoints, size: tuple[int, int]) -> LocalFeatures:
    """Store keypoints of an image of `size` (width, height) in a byte an entry."""
    descriptors = keypoints.descriptors
    if descriptors.dtype != np.uint8:
        descriptors = np.minimum(np.rint(descriptors / _ROOT_SIFT_STEP), 255).astype(np.uint8)
    return LocalFeatures(keypoints.points, descriptors, size)
