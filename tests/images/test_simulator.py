"""The simulated drive: exact poses and truth, the same bytes in any order, an honest covered share."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.errors import ConfigError, ImageError
from loopclosure.images.simulator import Drive, SimulationSettings, simulate, true_pairs


def small(**settings: object) -> SimulationSettings:
    return SimulationSettings(**{"frames": 40, "width": 160, "height": 120, **settings})


def positions(drive: Drive) -> np.ndarray:
    return np.array([(drive.pose(k).x_m, drive.pose(k).y_m) for k in range(len(drive))])


def test_same_seed_gives_the_same_bytes_in_any_order() -> None:
    settings = small(covered=0.2)
    forward, backward = Drive(settings), Drive(settings)
    wanted = (3, 11, 27)
    images = {k: forward[k].image for k in wanted}
    for k in reversed(wanted):
        frame = backward[k]
        assert frame.index == k
        assert frame.image.tobytes() == images[k].tobytes()
    assert Drive(small(seed=1))[3].image.tobytes() != Drive(small())[3].image.tobytes()


@pytest.mark.parametrize("size", [(160, 120), (97, 64), (64, 130)])
def test_images_are_rgb_of_the_asked_size(size: tuple[int, int]) -> None:
    frame = Drive(small(width=size[0], height=size[1]))[-1]
    assert frame.index == 39
    assert frame.image.shape == (size[1], size[0], 3)
    assert frame.image.dtype == np.uint8
    assert frame.image.std() > 20


def test_the_drive_is_a_sequence() -> None:
    drive = Drive(small(frames=2))
    assert len(drive) == 2
    assert [frame.index for frame in drive] == [0, 1]
    with pytest.raises(IndexError):
        drive[2]


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize("frames", [41, 600])
def test_second_lap_is_the_first_one_moved_along_its_normal(direction: str, frames: int) -> None:
    drive = Drive(small(frames=frames, lateral_offset_m=1.3, direction=direction))
    lap = (frames + 1) // 2
    at = positions(drive)
    for k in range(frames // 2):
        step = 1e-4
        s = k * drive.spacing_m
        ahead, behind = drive.route.at(s + step)[0], drive.route.at(s - step)[0]
        tangent = (ahead - behind) / np.linalg.norm(ahead - behind)
        normal = np.array([-tangent[1], tangent[0]])
        second = lap + (k if direction == "forward" else lap - 1 - k)
        if second >= frames:
            continue
        moved = at[second] - at[k]
        # The finite difference knows the normal to about 1e-5 where a bend begins; the length is exact.
        np.testing.assert_allclose(moved, 1.3 * normal, atol=1e-4)
        assert abs(np.hypot(*moved) - 1.3) < 1e-9


def test_frames_lie_the_asked_spacing_apart_on_a_closed_street() -> None:
    drive = Drive(small(frames=400, spacing_m=1.5))
    along = np.linspace(0, drive.route.length_m, 200_001)
    points = drive.route.at(along)[0]
    assert np.hypot(*np.diff(points, axis=0).T).sum() == pytest.approx(200 * 1.5, rel=1e-6)
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_street_never_meets_itself(seed: int) -> None:
    route = Drive(small(frames=3000, seed=seed)).route
    s = np.arange(0, route.length_m, 3.0)
    points = route.at(s)[0]
    apart = np.abs(s[:, None] - s[None])
    apart = np.minimum(apart, route.length_m - apart)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    assert distance[apart > 60].min() > 25


def test_camera_looks_along_the_street_and_back_in_reverse() -> None:
    drive = Drive(small(direction="reverse", lateral_offset_m=0))
    for first, second in ((4, 35), (12, 27)):
        a, b = drive.pose(first), drive.pose(second)
        assert (a.x_m, a.y_m) == (b.x_m, b.y_m)
        assert abs(math.remainder(a.yaw_rad - b.yaw_rad - math.pi, math.tau)) < 0.06
        way = drive.route.at(first * drive.spacing_m + 0.1)[0] - (a.x_m, a.y_m)
        assert abs(math.remainder(math.atan2(way[1], way[0]) - a.yaw_rad, math.tau)) < 0.06


@pytest.mark.parametrize(
    "settings",
    [
        small(frames=120),
        small(frames=120, direction="reverse", lateral_offset_m=-1),
        small(frames=90, truth_radius_m=7.5, exclude_recent=5),
        small(frames=90, revisit=False),
    ],
)
def test_truth_is_every_earlier_frame_near_enough(settings: SimulationSettings) -> None:
    drive = Drive(settings)
    radius = settings.truth_radius_m or math.hypot(2.5 * drive.spacing_m, settings.lateral_offset_m)
    wanted = []
    for query in range(len(drive)):
        for match in range(query - settings.exclude_recent + 1):
            a, b = drive.pose(query), drive.pose(match)
            if math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) <= radius:
                wanted.append([query, match])
    assert true_pairs(drive).tolist() == wanted
    assert bool(wanted) == settings.revisit


def test_default_truth_reaches_two_frames() -> None:
    drive = Drive(small(frames=300, lateral_offset_m=2.0))
    matches = {int(m) for q, m in true_pairs(drive) if q == 210}
    assert matches >= {58, 59, 60, 61, 62}
    assert matches <= set(range(56, 65))


@pytest.mark.parametrize("covered", [0.25, 0.4, 0.6])
def test_covered_share_is_near_the_setting(covered: float) -> None:
    drive = Drive(small(frames=24, width=96, height=72, covered=covered))
    assert np.mean([frame.covered for frame in drive]) == pytest.approx(covered, abs=0.05)


def test_covered_share_is_where_moving_things_change_the_picture() -> None:
    # Without cast shadows and by day nothing but the moving things themselves changes a pixel.
    settings = {"shadows": False}
    crowded, empty = Drive(small(covered=0.4, **settings)), Drive(small(covered=0.0, **settings))
    for index in (5, 18, 31):
        frame, bare = crowded[index], empty[index]
        assert bare.covered == 0
        changed = np.abs(frame.image.astype(int) - bare.image).max(axis=2) > 3
        assert frame.covered > 0.02
        assert changed.mean() == pytest.approx(frame.covered, abs=0.03)


def test_revisits_look_alike_and_other_places_do_not() -> None:
    drive = Drive(small(frames=60, lateral_offset_m=0.3, shadows=False, parked_cars=False))
    thumbnails = []
    for frame in drive:
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        # Edges, because the sun stands elsewhere in the second lap.
        detail = cv2.resize(grey - cv2.GaussianBlur(grey, (0, 0), 5), (64, 48), interpolation=cv2.INTER_AREA)
        thumbnails.append(detail / np.linalg.norm(detail))
    flat = np.array(thumbnails).reshape(60, -1)
    best = (flat[30:] @ flat[:30].T).argmax(axis=1)
    assert (np.abs(best - np.arange(30)) <= 1).mean() > 0.9


def test_light_changes_the_brightness() -> None:
    day, dusk, night = (Drive(small(light=name))[7].image.mean() for name in ("day", "dusk", "night"))
    assert day > 1.2 * dusk > 1.5 * night


@pytest.mark.parametrize("name", ["shadows", "parked_cars"])
def test_a_switch_changes_the_picture(name: str) -> None:
    drives = [Drive(small(**{name: value})) for value in (True, False)]
    changed = [np.abs(drives[0][k].image.astype(int) - drives[1][k].image).mean() for k in (2, 4)]
    assert max(changed) > 1


def test_parked_cars_differ_between_the_laps() -> None:
    drive = Drive(small(lateral_offset_m=0, shadows=False, exclude_recent=5))
    bare = Drive(small(lateral_offset_m=0, shadows=False, parked_cars=False))
    cars = [np.abs(drive[k].image.astype(int) - bare[k].image).max(axis=2) > 12 for k in (6, 26)]
    assert min(car.mean() for car in cars) > 0.005
    assert (cars[0] & cars[1]).sum() < 0.8 * max(car.sum() for car in cars)


def test_written_drive_is_the_rendered_one(tmp_path: Path) -> None:
    settings = small(frames=34, covered=0.1)
    done: list[tuple[int, int]] = []
    out = simulate(tmp_path / "a" / "drive", settings, progress=lambda k, n: done.append((k, n)), image_format="png")
    assert out == tmp_path / "a" / "drive"
    assert done == [(k + 1, 34) for k in range(34)]
    assert sorted(p.name for p in out.iterdir()) == ["covered.csv", "images", "poses.csv", "settings.json", "truth.csv"]
    assert [p.name for p in sorted((out / "images").iterdir())] == [f"{k:06d}.png" for k in range(34)]
    drive = Drive(settings)
    frame = drive[17]
    written = cv2.imread(str(out / "images" / "000017.png"))[..., ::-1]
    assert written.tobytes() == frame.image.tobytes()
    rows = list(csv.DictReader((out / "poses.csv").open()))
    assert list(rows[0]) == ["frame", "x", "y", "z", "yaw", "pitch"]
    pose = drive.pose(17)
    found = [float(rows[17][name]) for name in ("frame", "x", "y", "z", "yaw", "pitch")]
    assert found == [17, pose.x_m, pose.y_m, pose.z_m, pose.yaw_rad, pose.pitch_rad]
    covered = list(csv.DictReader((out / "covered.csv").open()))
    assert float(covered[17]["covered"]) == pytest.approx(frame.covered, abs=1e-6)
    truth = [(int(r["query"]), int(r["match"])) for r in csv.DictReader((out / "truth.csv").open())]
    assert truth == [tuple(pair) for pair in true_pairs(drive).tolist()]
    assert SimulationSettings(**json.loads((out / "settings.json").read_text())) == settings


def test_jpeg_is_close_to_the_rendering(tmp_path: Path) -> None:
    out = simulate(tmp_path, small(frames=2))
    read = cv2.imread(str(out / "images" / "000001.jpg"))[..., ::-1]
    assert np.abs(read.astype(int) - Drive(small(frames=2))[1].image).mean() < 6


def test_nothing_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ImageError, match="not an empty folder"):
        simulate(tmp_path, small())
    with pytest.raises(ImageError, match="not an empty folder"):
        simulate(tmp_path / "mine.txt", small())
    with pytest.raises(ImageError, match="'gif' is not known"):
        simulate(tmp_path / "new", small(), image_format="gif")  # type: ignore[arg-type]
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"frames": 1}, "frames = 1: input should be greater than or equal to 2"),
        ({"covered": 0.9}, "covered = 0.9"),
        ({"light": "noon"}, "light = 'noon'"),
        ({"lateral_ofset_m": 1}, "did you mean 'lateral_offset_m'"),
        ({"spacing_m": float("nan")}, "spacing_m"),
    ],
)
def test_a_wrong_setting_is_one_line(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        SimulationSettings(**values)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
