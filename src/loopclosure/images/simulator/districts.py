"""What stands along the street: districts with their own buildings, as real quarters have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from loopclosure.images.simulator.surface import Rgb, mixed, shade

Material = Literal["brick", "plaster", "stone", "panel", "siding"]
GroundFloor = Literal["shop", "home", "lobby", "garage"]
Roof = Literal["flat", "pitched"]


@dataclass(frozen=True)
class District:
    """The habits of one quarter: what its buildings are made of and how they look."""

    walls: dict[Material, tuple[Rgb, ...]]
    storeys: tuple[int, int]
    storey_m: tuple[float, float]
    width_m: tuple[float, float]
    shops: float
    pitched: float
    gaps: float
    gardens: float
    trees: float
    old: float
    glass: float = 0.0


DISTRICTS: tuple[District, ...] = (
    District(  # terraces of brick
        {"brick": ((142, 72, 54), (120, 62, 50), (168, 98, 70), (176, 140, 98), (110, 82, 70), (150, 112, 84))},
        (2, 4), (2.9, 3.3), (5.5, 8.5), 0.3, 0.85, 0.06, 0.25, 0.5, 0.6,
    ),
    District(  # the old town, in coloured plaster
        {
            "plaster": (
                (222, 186, 122), (200, 130, 100), (226, 214, 188), (168, 184, 170), (214, 164, 142), (182, 196, 208),
                (236, 226, 204), (190, 158, 104), (208, 200, 150), (176, 104, 84),
            ),
            "stone": ((186, 172, 148), (164, 154, 138)),
        },
        (3, 5), (3.0, 3.6), (6.0, 10.5), 0.65, 0.7, 0.04, 0.0, 0.25, 1.0,
    ),
    District(  # business: stone, concrete, glass
        {
            "stone": ((196, 186, 166), (150, 146, 140), (210, 204, 192)),
            "panel": ((170, 170, 168), (140, 132, 124), (198, 192, 180), (118, 122, 126)),
            "brick": ((104, 66, 54), (84, 78, 76)),
        },
        (3, 6), (3.2, 3.7), (10.0, 17.0), 0.55, 0.08, 0.07, 0.0, 0.45, 0.2, 0.4,
    ),
    District(  # houses with gardens
        {
            "siding": ((226, 224, 214), (166, 186, 196), (208, 196, 158), (134, 152, 132), (178, 92, 78)),
            "plaster": ((234, 228, 214), (216, 196, 160), (196, 208, 204)),
            "brick": ((158, 92, 68), (182, 132, 98)),
        },
        (1, 3), (2.7, 3.1), (8.0, 12.0), 0.05, 0.95, 0.12, 0.8, 0.9, 0.35,
    ),
)  # fmt: skip

_TRIMS: tuple[Rgb, ...] = (
    (226, 220, 206),
    (200, 188, 164),
    (176, 170, 162),
    (238, 236, 230),
    (150, 128, 104),
    (96, 92, 90),
)
_FRAMES: tuple[Rgb, ...] = ((240, 240, 236), (232, 228, 218), (70, 56, 46), (48, 52, 56), (52, 84, 70), (120, 48, 42))
_SHUTTERS: tuple[Rgb, ...] = (
    (62, 96, 74),
    (74, 98, 122),
    (120, 66, 48),
    (104, 112, 110),
    (150, 150, 140),
    (48, 58, 78),
)
_ROOFS: tuple[Rgb, ...] = ((150, 78, 56), (124, 64, 50), (84, 86, 92), (104, 96, 90), (70, 72, 78), (166, 98, 70))


@dataclass(frozen=True)
class Building:
    """One building as it was built: sizes in metres, colours, and what its windows look like."""

    width_m: float
    storeys_m: tuple[float, ...]
    material: Material
    wall: Rgb
    trim: Rgb
    frame: Rgb
    roof: Roof
    roof_colour: Rgb
    roof_rise_m: float
    ground_floor: GroundFloor
    glass: bool
    bay_m: float
    window_m: tuple[float, float]
    panes: tuple[int, int]
    shutters: Rgb | None
    surround: bool
    arched: bool
    pediment: bool
    balconies: int
    string_course: bool
    quoins: bool
    flower_boxes: bool
    cornice_m: float
    ivy: bool
    chimney: float

    @property
    def height_m(self) -> float:
        """From the ground to the eaves."""
        return sum(self.storeys_m)


def design(district: District, rng: np.random.Generator, width_m: float) -> Building:
    """Draw one building of a district; `width_m` is the length of its front."""

    def chance(share: float) -> bool:
        return bool(rng.random() < share)

    def one(choices: tuple[Rgb, ...]) -> Rgb:
        return choices[int(rng.integers(len(choices)))]

    materials = tuple(district.walls)
    material = materials[int(rng.integers(len(materials)))]
    wall = mixed(one(district.walls[material]), one(district.walls[material]), rng.uniform(0, 0.5))
    wall = shade(wall, rng.uniform(0.86, 1.1))
    shop = chance(district.shops)
    storeys = int(rng.integers(district.storeys[0], district.storeys[1] + 1))
    storey_m = float(rng.uniform(*district.storey_m))
    first = max(storey_m, rng.uniform(3.3, 4.0)) if shop else storey_m + rng.uniform(0.0, 0.3)
    old = chance(district.old)
    glass = chance(district.glass)
    ground: GroundFloor = "shop" if shop else "home"
    if not shop and district.glass > 0:
        ground = "lobby" if chance(0.7) else "garage"
    elif not shop and chance(0.12) and width_m > 6:
        ground = "garage"
    trim = one(_TRIMS)
    if abs(sum(trim) - sum(wall)) < 60:
        trim = mixed(wall, (246, 242, 232), 0.6)
    return Building(
        width_m=width_m,
        storeys_m=(float(first), *(float(storey_m * rng.uniform(0.97, 1.0)) for _ in range(storeys - 1))),
        material=material,
        wall=mixed((96, 124, 138), wall, 0.3) if glass else wall,
        trim=trim,
        frame=one(_FRAMES),
        roof="pitched" if chance(district.pitched) else "flat",
        roof_colour=shade(one(_ROOFS), rng.uniform(0.85, 1.1)),
        roof_rise_m=float(rng.uniform(1.8, 3.4)),
        ground_floor=ground,
        glass=glass,
        bay_m=float(rng.uniform(1.5, 2.6) if glass else rng.uniform(2.1, 3.3)),
        window_m=(float(rng.uniform(0.8, 1.1) if old else rng.uniform(1.1, 2.0)), float(rng.uniform(1.35, 1.95))),
        panes=(int(rng.integers(2, 4)), int(rng.integers(2, 5))) if old else (int(rng.integers(1, 3)), 1),
        shutters=one(_SHUTTERS) if old and chance(0.35) else None,
        surround=chance(0.6),
        arched=old and chance(0.25),
        pediment=old and chance(0.25),
        balconies=int(rng.integers(1, 4)) if storeys >= 3 and chance(0.35) else 0,
        string_course=chance(0.45),
        quoins=old and chance(0.3),
        flower_boxes=chance(0.3),
        cornice_m=float(rng.uniform(0.15, 0.6)),
        ivy=chance(0.1),
        chimney=float(rng.uniform(0.15, 0.85)) if chance(0.6) else -1.0,
    )
