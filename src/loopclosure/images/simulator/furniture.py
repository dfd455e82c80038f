"""Placing trees, lamps, signs, hedges and fences."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from loopclosure.images.simulator.buildings import front_line
from loopclosure.images.simulator.nature import paint_hedge, paint_tree
from loopclosure.images.simulator.quads import Lazy
from loopclosure.images.simulator.randomness import Stream, stream
from loopclosure.images.simulator.street import LAMP_ARM_M, LAMP_HEIGHT_M, YARD_DEPTH_M, Item, Lot
from loopclosure.images.simulator.surface import Rgb, Surface, Texture, box, plain, polygon, shade

if TYPE_CHECKING:
    from loopclosure.images.simulator.scene import Block, Scene

UP = np.array([0.0, 0.0, 1.0])


def add_item(scene: Scene, block: Block, item: Item) -> None:
    """Add a tree or a small thing of the pavement."""
    point, heading = scene.street.route.at(item.s_m, item.left_m)
    foot = np.append(point, 0.0)
    rng = stream(scene.street.seed, Stream.TREE, item.number)
    if item.kind == "tree":
        add_tree(scene, block, foot, item.s_m, rng, height_m=float(rng.uniform(4.5, 8.0)))
        return
    if item.kind == "shelter":
        _add_shelter(scene, block, item, foot, float(heading))
        return
    width, height, paint = {
        "sign": (0.7, 2.9, _sign), "bin": (0.5, 0.95, _bin), "bollard": (0.18, 0.95, _bollard)
    }[item.kind]  # fmt: skip
    tint = scene.light_at(foot + UP, item.s_m)
    block.quads.add_facing(foot, width, height, Lazy(partial(_plain_texture, paint, item.number % 12)), tint)
    block.casters.append(_upright(foot, 0.15, height, scene.light.sun))


def add_tree(
    scene: Scene, block: Block, foot: np.ndarray, s_m: float, rng: np.random.Generator, *, height_m: float
) -> None:
    """Add a tree; it always shows the same side."""
    width_m = height_m * float(rng.uniform(0.5, 0.68))
    look = int(rng.integers(1 << 30))
    tint = scene.light_at(foot + UP * height_m * 0.6, s_m) * 0.92
    block.quads.add_facing(foot, width_m, height_m, Lazy(partial(_tree_texture, look, height_m, width_m)), tint)
    crown = foot + UP * height_m * 0.66
    side = _sideways(scene.light.sun)
    angles = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    block.casters.append(
        crown + 0.42 * width_m * np.cos(angles)[:, None] * side + 0.32 * height_m * np.sin(angles)[:, None] * UP
    )
    block.casters.append(_upright(foot, 0.25, height_m * 0.5, scene.light.sun))


def add_lamp(scene: Scene, block: Block, item: Item) -> None:
    """Add a street lamp with an arm over the road."""
    point, heading = scene.street.route.at(item.s_m, item.left_m)
    foot = np.append(point, 0.0)
    inward = np.array([-np.sin(heading), np.cos(heading), 0.0]) * (1 if item.left_m < 0 else -1)
    metal: Rgb = ((62, 66, 68), (44, 60, 52), (120, 124, 126))[item.number % 3]
    tint = scene.light_at(foot + 2 * UP, item.s_m)
    pole = Lazy(partial(_plain_texture, _pole, sum(metal)))
    block.quads.add_facing(foot, 0.13, LAMP_HEIGHT_M, pole, tint)
    arm = foot + UP * LAMP_HEIGHT_M
    for start, edge in ((arm, inward * LAMP_ARM_M), (arm + inward * LAMP_ARM_M, -inward * LAMP_ARM_M)):
        block.quads.add(start, edge, -UP * 0.09, pole, tint)
    glowing = scene.light.lamps_on
    head = Lazy(partial(_plain_texture, _lamp_head, int(glowing)))
    block.quads.add_facing(arm + inward * LAMP_ARM_M - UP * 0.22, 0.55, 0.24, head, None if glowing else tint)
    block.casters.append(_upright(foot, 0.12, LAMP_HEIGHT_M, scene.light.sun))


def add_yard(scene: Scene, block: Block, lot: Lot) -> None:
    """Add what a lot without a front on the street has: hedges, fences, trees, a wall at its end."""
    left, right = front_line(scene, lot)
    across = right - left
    width = float(np.linalg.norm(across))
    inward = -np.cross(across / width, UP)
    rng = stream(scene.street.seed, Stream.TREE, 1 << 20, lot.number)
    s = (lot.start_m + lot.end_m) / 2
    if lot.kind == "alley":
        paint = partial(_end_wall, int(rng.integers(1 << 30)), width)
        end = left + inward * YARD_DEPTH_M + UP * 7
        block.quads.add(end, across, -UP * 7, scene.texture(paint, s, end, across, -UP * 7))
        return
    tall = float(rng.uniform(0.7, 1.5))
    fence = rng.random() < 0.45
    parts = ((0.0, 0.38), (0.58, 1.0)) if lot.kind == "garden" else ((0.0, 0.44), (0.56, 1.0))
    for first, last in parts:
        edge = across * (last - first)
        look = int(rng.integers(1 << 30))
        picture = partial(_fence if fence else _hedge, look, tall, width * (last - first))
        for start, along in ((left + across * first, edge), (left + across * last, -edge)):
            corner = start + UP * tall
            block.quads.add(corner, along, -UP * tall, scene.texture(picture, s, corner, along, -UP * tall))
        if not fence:
            block.casters.append(
                np.stack(
                    [left + across * first + UP * tall * k for k in (0, 1)]
                    + [left + across * last + UP * tall * k for k in (1, 0)]
                )
            )
    trees = int(rng.integers(3, 7)) if lot.kind == "park" else int(rng.integers(0, 2))
    for _ in range(trees):
        deep = rng.uniform(2, YARD_DEPTH_M - 1) if lot.kind == "park" else 1.6
        add_tree(
            scene,
            block,
            left + across * rng.uniform(0.1, 0.9) + inward * deep,
            s,
            rng,
            height_m=float(rng.uniform(2.5, 9.0 if lot.kind == "park" else 4.0)),
        )
    if lot.kind == "park":
        end = left + inward * (YARD_DEPTH_M + 0.5) + UP * 3.2
        block.quads.add(
            end, across, -UP * 3.2, scene.texture(partial(_hedge, lot.number, 3.2, width), s, end, across, -UP * 3.2)
        )


def _add_shelter(scene: Scene, block: Block, item: Item, foot: np.ndarray, heading: float) -> None:
    along = np.array([np.cos(heading), np.sin(heading), 0.0]) * 3.0 * (1 if item.left_m > 0 else -1)
    back = np.cross(along / 3.0, UP) * -0.9
    tint = scene.light_at(foot + 2 * UP, item.s_m)
    corner = foot + back - along / 2 + UP * 2.3
    block.quads.add(corner, along, -UP * 2.2, Lazy(partial(_plain_texture, _shelter, item.number % 12)), tint)
    block.quads.add(corner + along, -along, -UP * 2.2, Lazy(partial(_plain_texture, _shelter, item.number % 12)), tint)
    poster = Lazy(partial(_plain_texture, _poster, item.number))
    block.quads.add(corner + along, -back, -UP * 2.2, poster, tint)
    block.quads.add(corner + along - back, back, -UP * 2.2, poster, tint)
    block.quads.add(corner - back + UP * 0.18, along, -UP * 0.2, Lazy(partial(_plain_texture, _pole, 120)), tint)
    block.casters.append(np.stack([corner, corner + along, corner + along - back, corner - back]))


def _sideways(sun: np.ndarray) -> np.ndarray:
    side = np.array([-sun[1], sun[0], 0.0])
    return side / np.linalg.norm(side)


def _upright(foot: np.ndarray, width_m: float, height_m: float, sun: np.ndarray) -> np.ndarray:
    """Outline (4, 3) of a post, broadside to the sun."""
    half, top = _sideways(sun) * width_m / 2, UP * height_m
    return np.stack([foot - half, foot + half, foot + half + top, foot - half + top])


@lru_cache(maxsize=64)
def _tree_texture(look: int, height_m: float, width_m: float) -> Texture:
    surface = paint_tree(np.random.default_rng(look), height_m, width_m)
    return Texture(surface.rgb, surface.alpha)


@lru_cache(maxsize=128)
def _plain_texture(paint: partial[Surface], variant: int) -> Texture:
    surface = paint(variant)
    return Texture(surface.rgb, surface.alpha)


def _hedge(look: int, height_m: float, width_m: float) -> Surface:
    return paint_hedge(np.random.default_rng(look), height_m, width_m)


def _fence(look: int, height_m: float, width_m: float) -> Surface:
    height, width = max(8, round(height_m * 32)), max(8, round(width_m * 32))
    colour: Rgb = ((52, 54, 56), (236, 234, 226), (126, 96, 68), (60, 76, 66))[look % 4]
    rgb, alpha = plain(height, width, colour), np.zeros((height, width), np.uint8)
    gap, bar = ((6, 2), (8, 5), (7, 6), (6, 2))[look % 4]
    for x in range(0, width, gap):
        alpha[2 * (x // gap % 2) :, x : x + bar] = 255
    alpha[5:8] = alpha[-7:-4] = 255
    rgb[5:8] = rgb[-7:-4] = shade(colour, 0.85)
    return Surface(rgb, alpha)


def _end_wall(look: int, width_m: float) -> Surface:
    rng = np.random.default_rng(look)
    height, width = 7 * 20, max(8, round(width_m * 20))
    colour: Rgb = ((150, 136, 120), (132, 86, 70), (176, 168, 152))[look % 3]
    rgb = plain(height, width, colour)
    rgb[::4] = shade(colour, 0.88)
    for x in range(12, width - 30, 44):
        for y in (20, 62):
            box(rgb, x, y, x + 20, y + 28, (60, 68, 78))
            box(rgb, x - 2, y + 28, x + 22, y + 31, shade(colour, 1.2))
    door = float(rng.uniform(0.2, 0.6)) * width
    box(rgb, door, height - 52, door + 50, height, (84, 78, 72))
    return Surface(rgb)


def _sign(variant: int) -> Surface:
    """Paint a traffic sign on its pole, 0.7 m x 2.9 m."""
    rgb, alpha = plain(145, 35, (128, 130, 132)), np.zeros((145, 35), np.uint8)
    box(rgb, 15, 20, 19, 145, (120, 122, 124))
    alpha[20:, 16:19] = 255
    kind = variant % 5
    if kind in (0, 1):
        rim, inside = ((196, 28, 30), (244, 242, 236)) if kind == 0 else ((30, 76, 160), (30, 76, 160))
        cv2.circle(alpha, (17, 18), 16, 255, -1)
        cv2.circle(rgb, (17, 18), 16, rim, -1, cv2.LINE_AA)
        cv2.circle(rgb, (17, 18), 11, inside, -1, cv2.LINE_AA)
        text = ("30", "50", "P", "<")[variant % 4]
        cv2.putText(
            rgb,
            text,
            (7 if len(text) == 2 else 11, 23),
            cv2.FONT_HERSHEY_DUPLEX,
            0.45,
            (20, 20, 22) if kind == 0 else (250, 250, 250),
            1,
            cv2.LINE_AA,
        )
    elif kind == 2:
        polygon(alpha, [(17, 1), (34, 32), (0, 32)], 255)
        polygon(rgb, [(17, 1), (34, 32), (0, 32)], (200, 30, 30))
        polygon(rgb, [(17, 10), (27, 28), (7, 28)], (246, 244, 236))
    elif kind == 3:
        alpha[2:34, 1:34] = 255
        rgb[2:34, 1:34] = (28, 82, 166)
        cv2.putText(rgb, "P", (8, 28), cv2.FONT_HERSHEY_DUPLEX, 0.9, (250, 250, 250), 2, cv2.LINE_AA)
    else:
        alpha[4:20, 0:35] = 255
        rgb[4:20, 0:35] = (34, 104, 70)
        rgb[10:13, 4:31] = (240, 240, 236)
    return Surface(rgb, alpha)


def _bin(variant: int) -> Surface:
    colour: Rgb = ((54, 84, 62), (60, 62, 66), (170, 92, 34), (48, 66, 96))[variant % 4]
    rgb, alpha = plain(38, 20, colour), np.full((38, 20), 255, np.uint8)
    box(rgb, 0, 0, 20, 6, shade(colour, 0.6))
    box(rgb, 0, 0, 5, 38, shade(colour, 0.8))
    return Surface(rgb, alpha)


def _bollard(variant: int) -> Surface:
    colour: Rgb = ((50, 52, 54), (150, 34, 30), (196, 192, 184))[variant % 3]
    rgb = plain(38, 8, colour)
    rgb[4:9] = (232, 230, 222)
    return Surface(rgb)


def _pole(tone: int) -> Surface:
    return Surface(plain(16, 8, (tone // 3, tone // 3 + 2, tone // 3 + 3)))


def _lamp_head(glowing: int) -> Surface:
    rgb, alpha = plain(20, 44, (70, 74, 76)), np.zeros((20, 44), np.uint8)
    cv2.ellipse(alpha, (22, 12), (21, 11), 0, 180, 360, 255, -1)
    alpha[12:18, 4:40] = 255
    rgb[10:] = (255, 236, 190) if glowing else (210, 214, 214)
    return Surface(rgb, alpha)


def _shelter(_variant: int) -> Surface:
    rgb, alpha = plain(70, 96, (72, 92, 100)), np.zeros((70, 96), np.uint8)
    alpha[:, ::2] = 130
    alpha[::2, 1::2] = 130
    for x in (0, 31, 62, 92):
        box(rgb, x, 0, x + 4, 70, (54, 56, 58))
        alpha[:, x : x + 4] = 255
    alpha[:4] = alpha[-24:-19] = 255
    rgb[-24:-19] = (120, 92, 66)
    return Surface(rgb, alpha)


def _poster(variant: int) -> Surface:
    rng = np.random.default_rng(variant)
    first, second = ((int(a), int(b), int(c)) for a, b, c in rng.integers(40, 235, (2, 3)))
    rgb = plain(70, 30, (54, 56, 58))
    box(rgb, 2, 4, 28, 64, first)
    cv2.circle(rgb, (15, 26), int(rng.integers(6, 11)), second, -1, cv2.LINE_AA)
    box(rgb, 6, 46, 24, 50, second)
    return Surface(rgb)
