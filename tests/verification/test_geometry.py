"""Points of made-up scenes, seen by two cameras whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from loopclosure.verification.geometry import fit_geometry, relative_motion

CAMERA = np.array([[416.0, 0, 320], [0, 416, 240], [0, 0, 1]])
SIZE = np.array([640, 480])
NOISE_PX = 0.25


def angle_deg(a, b):
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def seen(points, rotation=None, centre=(0, 0, 0)):
    """Pixels of points for a camera at `centre` to whose axes `rotation` turns those of the world."""
    rotation = np.eye(3) if rotation is None else rotation
    local = (points - np.array(centre)) @ rotation.T
    assert (local[:, 2] > 0.5).all()
    return local[:, :2] / local[:, 2:] * CAMERA[[0, 1], [0, 1]] + CAMERA[:2, 2]


def box(rng, count):
    depth = rng.uniform(4, 25, count)
    across = rng.uniform(-0.6, 0.6, (count, 2)) * depth[:, None]
    return np.column_stack([across, depth])


def wall(rng, count):
    return np.column_stack([rng.uniform(-4, 4, count), rng.uniform(-3, 3, count), np.full(count, 10.0)])


def matched(rng, points, rotation, centre, *, wrong):
    """Noisy matches of both cameras, the last `wrong` of them between places chosen at random."""
    pairs = [seen(points), seen(points, rotation, centre)]
    pairs = [pixels + rng.normal(0, NOISE_PX, pixels.shape) for pixels in pairs]
    return [np.vstack([pixels, rng.uniform(0, SIZE, (wrong, 2))]).astype(np.float32) for pixels in pairs]


def turn(*, yaw=0.0, pitch=0.0):
    return cv2.Rodrigues(np.radians([pitch, yaw, 0.0]))[0]


@pytest.mark.parametrize("wrong", [0, 40, 90])
def test_a_scene_with_depth_gives_its_inliers_and_the_motion(wrong):
    rng = np.random.default_rng(wrong)
    rotation, centre = turn(yaw=7, pitch=-3), np.array([0.8, -0.1, 0.6])
    left, right = matched(rng, box(rng, 90), rotation, centre, wrong=wrong)
    fit = fit_geometry(left, right, threshold_px=1.5)
    assert fit.model == "fundamental"
    assert fit.inliers[:90].mean() > 0.93
    assert fit.inliers[90:].sum() <= 0.12 * wrong  # so many lie near their epipolar line by chance
    motion = relative_motion(left[fit.inliers], right[fit.inliers], CAMERA, threshold_px=1.5)
    assert angle_deg(motion.direction, centre) < 1
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(motion.rotation @ rotation.T)[0])) < 1
    assert motion.rotation_deg == pytest.approx(np.hypot(7, 3), abs=0.5)


def test_a_camera_that_only_turned_gives_a_homography_and_no_direction():
    rng = np.random.default_rng(0)
    rotation = turn(yaw=9)
    left, right = matched(rng, box(rng, 90), rotation, (0, 0, 0), wrong=40)
    fit = fit_geometry(left, right, threshold_px=1.5)
    assert fit.model == "homography"
    assert fit.inliers[:90].mean() > 0.95
    assert fit.inliers[90:].sum() <= 1
    motion = relative_motion(left[fit.inliers], right[fit.inliers], CAMERA, threshold_px=1.5)
    assert motion.direction is None
    assert motion.rotation_deg == pytest.approx(9, abs=0.5)


def test_a_flat_wall_gives_a_homography_and_the_motion():
    rng = np.random.default_rng(1)
    centre = np.array([1.0, 0.1, 1.5])
    left, right = matched(rng, wall(rng, 90), turn(yaw=-5), centre, wrong=40)
    fit = fit_geometry(left, right, threshold_px=1.5)
    assert fit.model == "homography"
    assert fit.inliers[:90].mean() > 0.95
    assert fit.inliers[90:].sum() <= 1


def test_the_same_points_stand_still():
    rng = np.random.default_rng(2)
    points = seen(box(rng, 60)).astype(np.float32)
    fit = fit_geometry(points, points, threshold_px=1.5)
    assert fit.model == "homography"
    assert fit.inliers.all()
    motion = relative_motion(points, points, CAMERA, threshold_px=1.5)
    assert motion.direction is None
    assert motion.rotation_deg < 0.01


@pytest.mark.parametrize("count", [0, 1, 4, 7])
def test_few_matches_give_no_model(count):
    points = np.random.default_rng(0).uniform(0, 400, (count, 2)).astype(np.float32)
    fit = fit_geometry(points, points, threshold_px=1.5)
    assert fit.model is None
    assert fit.inliers.shape == (count,)
    assert not fit.inliers.any()
    assert relative_motion(points, points, CAMERA, threshold_px=1.5) is None


@pytest.mark.parametrize("spoil", [np.zeros_like, lambda points: points[:, :1] * [1, 1], lambda points: points])
def test_points_in_one_place_or_on_a_line_raise_nothing(spoil):
    points = np.random.default_rng(0).uniform(0, 400, (30, 2)).astype(np.float32)
    left, right = spoil(points).astype(np.float32), points
    fit_geometry(left, right, threshold_px=1.5)
    relative_motion(left, right, CAMERA, threshold_px=1.5)


def test_chance_gives_few_inliers_and_the_same_ones_each_time():
    rng = np.random.default_rng(3)
    left, right = (rng.uniform(0, SIZE, (100, 2)).astype(np.float32) for _ in range(2))
    first = fit_geometry(left, right, threshold_px=1.5)
    assert first.inliers.sum() < 20
    cv2.setRNGSeed(99)
    again = fit_geometry(left, right, threshold_px=1.5)
    assert first.model == again.model
    assert (first.inliers == again.inliers).all()
