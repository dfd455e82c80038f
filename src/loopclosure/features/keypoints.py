"""Images to local descriptors: RootSIFT at blobs or at corners, and ORB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from loopclosure.errors import ConfigError, ImageError

KeypointKind = Literal["rootsift", "corners", "orb"]
DESCRIPTOR_SIZES: dict[str, int] = {"rootsift": 128, "corners": 128, "orb": 32}
"""Columns of the descriptors of each kind: float32 for RootSIFT, packed bits (uint8) for ``orb``."""

_CORNER_QUALITY, _CORNER_DISTANCE = 0.001, 6  # least share of the best corner's response; pixels between two corners
_CORNER_SIZE = 3.2  # pixels: the finest layer of SIFT's pyramid that needs no enlarged image


@dataclass(frozen=True)
class Keypoints:
    """The local features of one image, strongest first.

    Attributes
    ----------
    points : ndarray (n, 2) float32
        Column and row in pixels of the image that was given, centre of the first pixel at (0, 0).
    descriptors : ndarray (n, 128) float32 or (n, 32) uint8
        Unit rows of RootSIFT, 256 packed bits for ORB.
    """

    points: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


class KeypointExtractor:
    """Detects and describes the strongest features of an image.

    Deviation from the sources of the methods that use it: FAB-MAP describes with SURF, which public OpenCV builds lack.

    Parameters
    ----------
    kind : {"rootsift", "corners", "orb"}
        SIFT (Lowe 2004) whose descriptors are L1-normalised and rooted (Arandjelovic & Zisserman 2012, Sec. 3),
        so that the Euclidean distance compares them by the Hellinger kernel; the same descriptors, upright and of one
        size, at corners (Shi & Tomasi 1994) that keep a distance, for views that differ little in scale and roll; or
        ORB (Rublee et al. 2011).
    max_features : int
        At most so many features an image.
    side : int
        Pixels to which the longer side of an image is scaled first: a large image costs time, and in a small one
        the detectors miss what is only a few pixels wide.
    contrast_threshold : float
        SIFT's; lower finds features in dark and flat images too.
    fast_threshold : int
        ORB's least difference of grey levels at a corner.

    Examples
    --------
    >>> len(KeypointExtractor("orb")(np.zeros((120, 160, 3), np.uint8)))
    0
    """

    def __init__(
        self,
        kind: KeypointKind = "rootsift",
        *,
        max_features: int = 1000,
        side: int = 640,
        contrast_threshold: float = 0.01,
        fast_threshold: int = 7,
    ) -> None:
        if kind not in DESCRIPTOR_SIZES:
            raise ConfigError(f"unknown keypoints '{kind}', wanted one of {', '.join(DESCRIPTOR_SIZES)}")
        if max_features < 1 or side < 32:
            raise ConfigError(f"max_features = {max_features} and side = {side}: wanted at least 1 and 32")
        self.kind = kind
        self.max_features = max_features
        self.side = side
        self._detector: cv2.Feature2D = (
            cv2.ORB.create(nfeatures=max_features, fastThreshold=fast_threshold)
            if kind == "orb"
            else cv2.SIFT.create(nfeatures=max_features, contrastThreshold=contrast_threshold)
        )

    def __call__(self, image: np.ndarray) -> Keypoints:
        """Return the features of `image`.

        Parameters
        ----------
        image : ndarray (h, w, 3) uint8
            RGB.

        Returns
        -------
        Keypoints
            None of them where the image shows nothing.

        Raises
        ------
        ImageError
            If the array is no RGB image.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise ImageError(f"found an array of shape {image.shape} and {image.dtype}, wanted (h, w, 3) uint8 RGB")
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        scale = self.side / max(grey.shape)
        if scale != 1:
            size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
        found, descriptors = self._detected(grey)
        if not found:
            dtype = np.uint8 if self.kind == "orb" else np.float32
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, DESCRIPTOR_SIZES[self.kind]), dtype))
        # The detectors keep all features that tie with the last one.
        strongest = np.argsort([-point.response for point in found], kind="stable")[: self.max_features]
        points = np.array([found[i].pt for i in strongest.tolist()])
        back = np.array([image.shape[1] / grey.shape[1], image.shape[0] / grey.shape[0]])
        descriptors = descriptors[strongest]
        # Pixel centres, not pixel corners, are whole numbers: hence the half pixels.
        return Keypoints(
            ((points + 0.5) * back - 0.5).astype(np.float32),
            descriptors if self.kind == "orb" else root_sift(descriptors),
        )

    def _detected(self, grey: np.ndarray) -> tuple[Sequence[cv2.KeyPoint], np.ndarray]:
        if self.kind != "corners":
            return self._detector.detectAndCompute(grey, None)
        corners = cv2.goodFeaturesToTrack(grey, self.max_features, _CORNER_QUALITY, _CORNER_DISTANCE)
        points = [] if corners is None else corners[:, 0].tolist()  # strongest first
        return self._detector.compute(
            grey, [cv2.KeyPoint(x, y, _CORNER_SIZE, 0, len(points) - rank) for rank, (x, y) in enumerate(points)]
        )


def root_sift(descriptors: np.ndarray) -> np.ndarray:
    """Return the square roots of L1-normalised SIFT descriptors; a zero row stays zero.

    Parameters
    ----------
    descriptors : ndarray (n, 128)
        SIFT, not negative.

    Returns
    -------
    ndarray (n, 128) float32
        Rows of unit Euclidean length.
    """
    total = descriptors.sum(axis=1, keepdims=True, dtype=np.float32)
    return np.sqrt(np.divide(descriptors, np.maximum(total, np.finfo(np.float32).tiny), dtype=np.float32))
