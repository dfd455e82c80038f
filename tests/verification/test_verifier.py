"""From two images to an answer, on pictures made here and on simulated drives whose poses are exact."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from textures import texture

from loopclosure.errors import ConfigError, ImageError
from loopclosure.images.simulator import Camera, Drive, SimulationSettings
from loopclosure.verification import LocalFeatures, Verifier, cells
from loopclosure.verification.local_features import compact
from loopclosure.verification.matching import mutual_matches

MODES = pytest.mark.parametrize("mode", ["fast", "strict"])
KINDS = pytest.mark.parametrize("keypoints", ["corners", "rootsift", "orb"])


def compare(verifier, query, match):
    return verifier.verify(verifier.features(query), verifier.features(match))


@MODES
def test_a_copy_of_an_image_is_verified_although_everything_in_it_is_still(mode):
    found = compare(Verifier(mode), texture(0), texture(0))
    assert found.verified
    assert found.model == "homography"
    assert found.matches >= found.inliers > 200
    np.testing.assert_array_equal(found.query_points, found.match_points)


@MODES
def test_a_shifted_image_is_verified_and_its_inliers_shift_alike(mode):
    wide = texture(1, width=460)
    found = compare(Verifier(mode), wide[:, :400], wide[:, 60:])
    assert found.verified
    np.testing.assert_allclose((found.query_points - found.match_points).mean(0), [60, 0], atol=0.1)
    assert found.spread == min(cells(points, (400, 300)).mean() for points in (found.query_points, found.match_points))


@MODES
@pytest.mark.parametrize("size", [(1, 1), (2, 0.5)])
def test_images_of_two_sizes_are_compared(mode, size):
    image = texture(2)
    assert compare(Verifier(mode), image, cv2.resize(image, None, fx=size[0], fy=size[0])).verified


@MODES
def test_different_textures_are_not_verified(mode):
    verifier = Verifier(mode)
    features = [verifier.features(texture(seed)) for seed in range(8)]
    found = [verifier.verify(a, b) for i, a in enumerate(features) for b in features[:i]]
    assert not any(one.verified for one in found)
    assert max(one.support for one in found) < verifier.least_support / 2


@MODES
def test_blank_images_are_not_verified(mode):
    verifier = Verifier(mode)
    blank = np.full((120, 160, 3), 90, np.uint8)
    for query, match in ((blank, blank), (blank, texture(0)), (texture(0), blank)):
        found = compare(verifier, query, match)
        assert not found.verified
        assert (found.inliers, found.matches, found.spread, found.support) == (0, 0, 0, 0)
        assert found.model is None
        assert len(found.query_points) == 0


@MODES
def test_an_object_before_another_background_is_not_verified(mode):
    query, match = texture(3), texture(4)
    query[60:150, 40:130] = match[90:180, 200:290] = texture(5)[:90, :90]
    found = compare(Verifier(mode), query, match)
    assert not found.verified
    assert found.inliers > 15
    inside = (found.query_points > (35, 55)) & (found.query_points < (135, 155))
    assert inside.all(axis=1).mean() > 0.9
    assert found.spread < 0.2


@MODES
def test_what_belongs_to_the_camera_does_not_count(mode):
    query, match = texture(6), texture(7)
    frame = texture(8)
    for image in (query, match):
        image[:50], image[-50:] = frame[:50], frame[-50:]
    assert not compare(Verifier(mode), query, match).verified
    wide = texture(9, width=430)
    query, match = wide[:, :400].copy(), wide[:, 30:].copy()
    for image in (query, match):
        image[-100:] = frame[-100:]
    found = compare(Verifier(mode), query, match)
    assert found.verified
    assert (found.query_points[:, 1] < 205).mean() > 0.95


def test_the_same_images_give_the_same_answer():
    drive = Drive(SimulationSettings(frames=60, spacing_m=2.0, seed=1))
    verifier = Verifier()
    features = [verifier.features(drive[i].image) for i in (5, 36)]
    cv2.setRNGSeed(1)
    first = verifier.verify(*features)
    cv2.setRNGSeed(2)
    again = Verifier().verify(*features)
    assert first.inliers == again.inliers > 10
    np.testing.assert_array_equal(first.query_points, again.query_points)


def test_simulated_loops_are_verified_with_their_motion_and_other_streets_are_not():
    drive = Drive(SimulationSettings(frames=60, spacing_m=2.0, seed=1, width=400, height=300))
    other = Drive(SimulationSettings(frames=60, spacing_m=2.0, seed=11, width=400, height=300))
    camera = Camera(drive.pose(0), width=400, height=300)
    verifier = Verifier("strict", intrinsics=camera.matrix)
    turned, aside, verified = [], [], 0
    for place in range(2, 30, 7):
        match, query = drive[place], drive[30 + place]
        features = verifier.features(query.image)
        assert not verifier.verify(features, verifier.features(other[place].image)).verified
        found = verifier.verify(features, verifier.features(match.image))
        verified += found.verified
        if not found.verified:
            continue
        ends = [Camera(frame.pose, width=400, height=300) for frame in (match, query)]
        rotation = ends[1].rotation @ ends[0].rotation.T
        turned.append(np.degrees(np.linalg.norm(cv2.Rodrigues(found.motion.rotation @ rotation.T)[0])))
        step = ends[0].rotation @ (ends[1].position_m - ends[0].position_m)
        if found.motion.direction is not None:
            cosine = found.motion.direction @ step / np.linalg.norm(step)
            aside.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    assert verified >= 3
    assert np.median(turned) < 0.5
    assert np.median(aside) < 10


@KINDS
def test_matches_are_those_of_plain_loops(keypoints):
    wide = texture(10, width=420)
    verifier = Verifier(keypoints=keypoints)
    half_other = np.hstack([wide[:, 20:220], texture(11)[:, 200:]])
    left, right = (verifier.features(image) for image in (wide[:, :400], half_other))

    def distances(a, b):
        if keypoints == "orb":
            return np.array([[np.sqrt(cv2.norm(x, y, cv2.NORM_HAMMING)) for y in b] for x in a])
        return np.array([[np.linalg.norm(x.astype(float) - y) for y in b] for x in a])

    left = LocalFeatures(left.points[:60], left.descriptors[:60], left.size)
    right = LocalFeatures(right.points[:70], right.descriptors[:70], right.size)
    table = distances(left.descriptors, right.descriptors)
    wanted, standing_out = [], []
    for i, row in enumerate(table):
        j, second = np.argsort(row, kind="stable")[:2]
        if np.argmin(table[:, j]) == i:
            wanted.append((i, j))
            standing_out.append(row[j] < 0.8 * row[second])
    assert 8 < sum(standing_out) < len(wanted)
    pairs, distinct = mutual_matches(left, right, ratio=0.8)
    np.testing.assert_array_equal(pairs, wanted)
    np.testing.assert_array_equal(distinct, standing_out)
    assert verifier.verify(left, right).inliers > 5


@KINDS
def test_features_are_small(keypoints):
    features = Verifier("fast", keypoints=keypoints).features(texture(0, height=600, width=800))
    assert features.size == (800, 600)
    assert 300 < len(features) <= 500
    assert features.nbytes <= 500 * (128 + 8)


def test_a_byte_an_entry_loses_little():
    keypoints = Verifier("fast")._extract(texture(0))
    stored = compact(keypoints, (400, 300)).descriptors / 512
    assert np.abs(stored - keypoints.descriptors)[keypoints.descriptors < 0.49].max() <= 0.5 / 512 + 1e-6


def test_what_cannot_be_used_is_refused():
    with pytest.raises(ConfigError, match="unknown verification 'strickt', did you mean 'strict'"):
        Verifier("strickt")
    with pytest.raises(ConfigError, match="unknown keypoints 'surf'"):
        Verifier(keypoints="surf")
    with pytest.raises(ConfigError, match="transposed"):
        Verifier(intrinsics=np.array([[400.0, 0, 0], [0, 400, 0], [200, 150, 1]]))
    with pytest.raises(ImageError, match="channel"):
        Verifier().features(np.zeros((50, 50), np.uint8))
    with pytest.raises(ConfigError, match="wanted one kind"):
        Verifier().verify(Verifier().features(texture(0)), Verifier(keypoints="orb").features(texture(0)))
