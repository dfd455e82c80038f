"""The renderer against plain pinhole and ray-plane formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure.images.simulator.camera import Camera, Pose
from loopclosure.images.simulator.quads import Lazy, Quads
from loopclosure.images.simulator.render import Canvas
from loopclosure.images.simulator.route import closed_route
from loopclosure.images.simulator.shadows import shadow_mask
from loopclosure.images.simulator.surface import Texture

POSE = Pose(3.0, -2.0, 1.5, 0.7, 0.02)


def plain(colour: tuple[int, int, int]) -> Lazy:
    return Lazy(lambda: Texture(np.full((16, 16, 3), colour, np.uint8)))


def in_camera(point: np.ndarray, pose: Pose) -> np.ndarray:
    """Right, down and forward distances by two plain rotations, first the yaw, then the pitch."""
    x, y, z = point - np.array([pose.x_m, pose.y_m, pose.z_m])
    forward = x * math.cos(pose.yaw_rad) + y * math.sin(pose.yaw_rad)
    left = -x * math.sin(pose.yaw_rad) + y * math.cos(pose.yaw_rad)
    ahead = forward * math.cos(pose.pitch_rad) + z * math.sin(pose.pitch_rad)
    up = -forward * math.sin(pose.pitch_rad) + z * math.cos(pose.pitch_rad)
    return np.array([-left, -up, ahead])


@pytest.mark.parametrize("scale", [1, 2])
def test_projection_is_the_pinhole_formula(scale: int) -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (50, 3))
    pixels, depth = Camera(POSE, width=320, height=240, scale=scale).project(points)
    for point, pixel, far in zip(points, pixels, depth, strict=True):
        right, down, ahead = in_camera(point, POSE)
        assert far == pytest.approx(ahead)
        u, v = 159.5 + 208 * right / ahead, 0.56 * 240 - 0.5 + 208 * down / ahead
        # A pixel of the fine picture is half as wide; its centre lies half of its own width from the pixel's edge.
        np.testing.assert_allclose(pixel, ((u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5), rtol=1e-9, atol=1e-9)


def wall() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wall oblique to the camera: upper left corner, edge to the right, edge down."""
    ahead = np.array([math.cos(0.7), math.sin(0.7), 0.0])
    right = np.array([math.sin(0.7), -math.cos(0.7), 0.0])
    return np.array([3, -2, 0]) + 6 * ahead - 3 * right + [0, 0, 3.2], 5 * right + 7 * ahead, np.array([0, 0, -3.0])


def test_a_textured_wall_is_seen_as_rays_meet_its_plane() -> None:
    origin, across, down = wall()
    ramp = np.zeros((256, 256, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = np.arange(256)[None, :], np.arange(256)[:, None]
    quads = Quads()
    quads.add(origin, across, down, Lazy(lambda: Texture(ramp)))
    canvas = Canvas(Camera(POSE, width=320, height=240))
    canvas.draw(quads)
    corner, along, below = in_camera(origin, POSE), in_camera(origin + across, POSE), in_camera(origin + down, POSE)
    matrix = np.stack([along - corner, below - corner], axis=1)
    inside = 0
    for v in range(0, 240, 7):
        for u in range(0, 320, 7):
            ray = np.array([(u - 159.5) / 208, (v - 133.9) / 208, 1.0])
            a, b, far = np.linalg.solve(np.column_stack([matrix, -ray]), -corner)
            seen = canvas.colour[v, u]
            if 0.02 < a < 0.98 and 0.02 < b < 0.98 and far > 0:
                inside += 1
                np.testing.assert_allclose(seen[:2], [256 * a - 0.5, 256 * b - 0.5], atol=3)
                assert canvas.inverse_depth[v, u] == pytest.approx(1 / far, rel=1e-4)
            elif not (-0.02 < a < 1.02 and -0.02 < b < 1.02 and far > 0):
                assert seen[3] == 0
    assert inside > 100


def test_the_nearer_wall_hides_the_other_in_any_order() -> None:
    origin, across, down = wall()
    away = np.array([math.cos(0.7), math.sin(0.7), 0.0])
    for first in (0, 1):
        canvas = Canvas(Camera(POSE, width=160, height=120))
        label = np.zeros((120, 160), np.uint8)
        for number in (first, 1 - first):
            quads = Quads()
            quads.add(
                origin + number * (2 * away + (0, 0, 1.5)), across, down, plain(((200, 0, 0), (0, 200, 0))[number])
            )
            canvas.draw(quads, label=label if number == 1 and first == 0 else None)
        red, green = (canvas.colour[..., k] == 200 for k in (0, 1))
        assert red.sum() > 1000
        assert green.sum() > 100
        front = Canvas(Camera(POSE, width=160, height=120))
        quads = Quads()
        quads.add(origin, across, down, plain((200, 0, 0)))
        front.draw(quads)
        np.testing.assert_array_equal(red, front.colour[..., 0] == 200)
        if first == 0:
            np.testing.assert_array_equal(label.astype(bool), green)


def test_a_wall_is_not_seen_from_behind_nor_behind_the_camera() -> None:
    origin, across, down = wall()
    for turned in ((origin + across, -across, down), (2 * np.array([3, -2, 1.5]) - origin, across, down)):
        canvas = Canvas(Camera(POSE, width=160, height=120))
        quads = Quads()
        quads.add(*turned, plain((255, 255, 255)))
        canvas.draw(quads)
        assert not canvas.colour.any()


def test_ground_under_the_camera_is_cut_at_the_near_plane() -> None:
    canvas = Canvas(Camera(Pose(0, 0, 1.5, 0), width=160, height=120))
    quads = Quads()
    quads.add(np.array([-50.0, 50, 0]), np.array([100.0, 0, 0]), np.array([0, -100.0, 0]), plain((90, 90, 90)))
    canvas.draw(quads)
    horizon = 0.56 * 120 - 0.5
    rows = np.flatnonzero((canvas.colour[..., 0] == 90).all(axis=1))
    # The plane ends 50 m ahead: 104 px * 1.5 m / 50 m below the horizon.
    assert rows.min() == math.ceil(horizon + 104 * 1.5 / 50)
    assert rows.max() == 119
    assert len(rows) == rows.max() - rows.min() + 1


def test_a_facing_picture_stands_where_its_foot_is() -> None:
    camera = Camera(POSE, width=320, height=240)
    foot = np.array([9.0, 3.5, 0.0])
    quads = Quads()
    quads.add_facing(foot, 1.0, 1.8, plain((255, 0, 0)))
    canvas = Canvas(camera)
    canvas.draw(quads)
    rows, columns = np.nonzero(canvas.colour[..., 0])
    (low, high), depth = camera.project(np.array([[9.0, 3.5, 0.0], [9.0, 3.5, 1.8]]))
    assert rows.max() == pytest.approx(low[1], abs=1)
    assert rows.min() == pytest.approx(high[1], abs=1)
    assert columns.mean() == pytest.approx(low[0], abs=1)
    assert np.ptp(columns) + 1 == pytest.approx(208 / depth[0], abs=2)


def test_a_shadow_lies_where_the_sun_throws_it() -> None:
    # A wall 2 m high and 4 m wide, the sun at 45 degrees behind it: a square of 4 m x 2 m on the ground.
    sun = np.array([0.0, -1.0, 1.0]) / math.sqrt(2)
    caster = np.array([[0.0, 0, 0], [4, 0, 0], [4, 0, 2], [0, 0, 2]])
    mask = shadow_mask([caster], sun, np.array([-2.0, 6, 0]), np.array([8.0, 0, 0]), np.array([0, -8.0, 0]))
    assert mask is not None
    y, x = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]]
    metres_x, metres_y = -2 + 8 * (x + 0.5) / mask.shape[1], 6 - 8 * (y + 0.5) / mask.shape[0]
    inside = (metres_x > 0.4) & (metres_x < 3.6) & (metres_y > 0.4) & (metres_y < 1.6)
    outside = (metres_x < -0.4) | (metres_x > 4.4) | (metres_y < -0.4) | (metres_y > 2.4)
    assert mask[inside].min() > 0.95
    assert mask[outside].max() < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_locate_finds_what_the_route_made(seed: int) -> None:
    route = closed_route(700.0, seed)
    rng = np.random.default_rng(seed)
    s, left = rng.uniform(0, 700, 500), rng.uniform(-5.5, 8, 500)
    found_s, found_left = route.locate(route.at(s, left)[0], 12.0)
    np.testing.assert_allclose(found_left, left, atol=1e-6)
    np.testing.assert_allclose((found_s - s + 350) % 700 - 350, 0, atol=1e-6)
