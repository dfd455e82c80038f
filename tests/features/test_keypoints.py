"""Keypoints: unit RootSIFT at blobs and corners, packed ORB, points in pixels of the image given, blank images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from loopclosure.errors import ConfigError, ImageError
from loopclosure.features.keypoints import DESCRIPTOR_SIZES, KeypointExtractor, root_sift

KINDS = sorted(DESCRIPTOR_SIZES)


def street(seed: int = 0, size: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Many grey boxes: corners everywhere."""
    rng = np.random.default_rng(seed)
    image = np.full((*size, 3), 128, np.uint8)
    for _ in range(80):
        row, column = rng.integers(0, size[0]), rng.integers(0, size[1])
        image[row : row + rng.integers(5, 40), column : column + rng.integers(5, 40)] = rng.integers(0, 256, 3)
    return image


@pytest.mark.parametrize("kind", KINDS)
def test_descriptors_have_kind_and_limit(kind: str) -> None:
    found = KeypointExtractor(kind, max_features=50)(street())
    assert 10 < len(found) <= 50
    assert found.descriptors.shape == (len(found), DESCRIPTOR_SIZES[kind])
    assert found.descriptors.dtype == (np.uint8 if kind == "orb" else np.float32)
    assert found.points.shape == (len(found), 2)
    assert found.points.dtype == np.float32


@pytest.mark.parametrize("kind", KINDS)
def test_same_image_gives_same_features(kind: str) -> None:
    extractor = KeypointExtractor(kind)
    first, second = extractor(street()), extractor(street())
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    np.testing.assert_array_equal(first.points, second.points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("grey", [0, 128, 255])
def test_blank_image_has_no_features(kind: str, grey: int) -> None:
    found = KeypointExtractor(kind)(np.full((90, 120, 3), grey, np.uint8))
    assert found.points.shape == (0, 2)
    assert found.descriptors.shape == (0, DESCRIPTOR_SIZES[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("side", [320, 640])
def test_points_are_in_pixels_of_the_image(kind: str, side: int) -> None:
    """One bright square: its features lie around it whatever the scale of the work."""
    image = np.zeros((240, 320, 3), np.uint8)
    image[100:130, 200:230] = 255
    points = KeypointExtractor(kind, side=side)(image).points
    assert len(points)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    np.testing.assert_allclose(centre, [214.5, 114.5], atol=2)
    assert (np.abs(points - [214.5, 114.5]) < 40).all()


def test_root_sift_is_the_root_of_shares() -> None:
    grey = cv2.cvtColor(street(), cv2.COLOR_RGB2GRAY)
    _, raw = cv2.SIFT_create().detectAndCompute(grey, None)
    rooted = root_sift(raw)
    for row, expected in zip(rooted[:20], raw[:20], strict=True):
        total = sum(float(value) for value in expected)
        np.testing.assert_allclose(row, [(float(value) / total) ** 0.5 for value in expected], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rooted, axis=1), 1, atol=1e-5)
    assert not root_sift(np.zeros((2, 128), np.float32)).any()


@pytest.mark.parametrize("kind", ["rootsift", "corners"])
def test_strongest_features_come_first(kind: str) -> None:
    all_of_them = KeypointExtractor(kind, max_features=200)(street())
    few = KeypointExtractor(kind, max_features=20)(street())
    np.testing.assert_array_equal(few.points, all_of_them.points[:20])


@pytest.mark.parametrize("most", [7, 100, 5000])
def test_corners_are_those_of_shi_and_tomasi(most: int) -> None:
    grey = cv2.cvtColor(street(), cv2.COLOR_RGB2GRAY)
    points = KeypointExtractor("corners", max_features=most, side=320)(street()).points
    wanted = cv2.goodFeaturesToTrack(grey, maxCorners=most, qualityLevel=0.001, minDistance=6)[:, 0]
    np.testing.assert_array_equal(points, wanted)
    assert len(points) == most if most <= 100 else 100 < len(points) < 5000
    response = cv2.cornerMinEigenVal(grey, 3)
    strengths = [response[int(row), int(column)] for column, row in points]
    assert strengths == sorted(strengths, reverse=True)
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    assert distances[~np.eye(len(points), dtype=bool)].min() >= 6


def test_corners_are_described_upright_and_in_one_size() -> None:
    grey = cv2.cvtColor(street(), cv2.COLOR_RGB2GRAY)
    found = KeypointExtractor("corners", max_features=60, side=320)(street())
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    for point, descriptor in zip(found.points.tolist(), found.descriptors, strict=True):
        _, ((*raw,),) = cv2.SIFT_create().compute(grey, [cv2.KeyPoint(*point, size=3.2, angle=0)])
        np.testing.assert_allclose(descriptor, [(value / sum(raw)) ** 0.5 for value in raw], atol=1e-5)


def test_corners_of_a_view_that_moved_are_found_again_as_they_were() -> None:
    image = street(size=(240, 420))
    extractor = KeypointExtractor("corners", max_features=5000, side=400)
    left, right = extractor(image[:, :400]), extractor(image[:, 20:])
    before = {tuple(point): row for point, row in zip(left.points.tolist(), left.descriptors, strict=True)}
    inside = [
        (before.get((column + 20, row)), descriptor)
        for (column, row), descriptor in zip(right.points.tolist(), right.descriptors, strict=True)
        if 30 < column < 350 and 30 < row < 210
    ]
    same = [np.abs(one - other).max() < 0.02 for one, other in inside if one is not None]
    assert len(same) > 0.95 * len(inside) > 50
    assert np.mean(same) > 0.95


def test_wrong_input_is_named() -> None:
    with pytest.raises(ConfigError, match="surf"):
        KeypointExtractor("surf")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="max_features = 0"):
        KeypointExtractor(max_features=0)
    for image in (np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3), np.float32), np.zeros((0, 5, 3), np.uint8)):
        with pytest.raises(ImageError, match="wanted"):
            KeypointExtractor()(image)
