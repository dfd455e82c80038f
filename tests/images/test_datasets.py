"""Every data set on a made-up copy of its layout, downloads from a server in this process, hostile archives."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import stat
import sys
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.io import loadmat, savemat

from loopclosure.cli import datasets as _registered  # noqa: F401  (the command)
from loopclosure.cli import main
from loopclosure.errors import ConfigError, ImageError, LoopClosureError, TruthError
from loopclosure.evaluation import load_truth
from loopclosure.images.datasets import (
    DATASETS,
    Part,
    check_dataset,
    datasets_folder,
    fetch_dataset,
    open_dataset,
)
from loopclosure.images.datasets.download import download
from loopclosure.images.datasets.pairs import pairs_by_position
from loopclosure.images.datasets.unpack import unpack

CONTENT = np.random.default_rng(0).bytes(1 << 20)
DIGEST = hashlib.sha256(CONTENT).hexdigest()
OXFORD = {"new-college": ("NewCollege", 2146), "city-centre": ("CityCentre", 2474)}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    return tmp_path / "cache"


def picture(level: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("L", (16, 16), level).save(buffer, "PNG")  # the content of an image decides, not its ending
    return buffer.getvalue()


def fill(folder: Path, names: list[str]) -> Path:
    """Make a folder of tiny images whose grey level is their position modulo 251."""
    pictures = [picture(level) for level in range(251)]
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        (folder / name).write_bytes(pictures[i % 251])
    return folder


def levels(images) -> list[int]:
    return [int(images[i][0, 0, 0]) for i in range(min(len(images), 6))]


def truth_of(opened):
    return load_truth(opened.truth_path, frames=opened.frames, **opened.truth_settings)


def pairs_of(truth) -> set[tuple[int, int]]:
    return set(zip(*(axis.tolist() for axis in truth.pairs.nonzero()), strict=True))


@pytest.fixture(scope="module")
def stock(tmp_path_factory) -> dict[str, Path]:
    """Images of the two large sets, made once: a copy of thousands of files a test would take the disk its time."""
    return {
        name: fill(tmp_path_factory.mktemp(stem), [f"{i:04d}.jpg" for i in range(1, images + 1)])
        for name, (stem, images) in OXFORD.items()
    }


def make_oxford(folder: Path, name: str, stock: dict[str, Path]) -> Path:
    stem, images = OXFORD[name]
    folder.mkdir(exist_ok=True)
    (folder / "Images").symlink_to(stock[name])
    matrix = np.zeros((images, images), bool)
    matrix[1000, 10] = matrix[1002, 12] = matrix[1001, 11] = True  # two left pairs, one right pair
    matrix[1003, 12] = True  # a right image of a place on the left: in no single view
    savemat(folder / f"{stem}GroundTruth.mat", {"truth": matrix}, do_compression=True)
    return folder


def make_kitti(folder: Path, sequence: str, camera: str = "image_0", top: str = "") -> Path:
    frames = DATASETS["kitti"].frames[sequence]
    fill(folder / top / "sequences" / sequence / camera, [f"{i:06d}.png" for i in range(frames)])
    angle = np.linspace(0, 4 * np.pi, frames)  # two rounds
    poses = np.tile(np.eye(3, 4).ravel(), (frames, 1))
    poses[:, 3], poses[:, 11] = 30 * np.cos(angle), 30 * np.sin(angle)
    (folder / top / "poses").mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / top / "poses" / f"{sequence}.txt", poses)
    return folder


def make_gardens_point(folder: Path) -> Path:
    for walk in DATASETS["gardens-point"].sequences:
        fill(folder / walk, [f"Image{i:03d}.jpg" for i in range(200)])
    return folder


def make_drive(folder: Path, latitudes: np.ndarray) -> Path:
    """Make one traverse of St Lucia: a video and a position a frame."""
    folder.mkdir(parents=True)
    video = cv2.VideoWriter(str(folder / "webcam_video.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 15, (32, 32))
    for i in range(len(latitudes)):
        video.write(np.full((32, 32, 3), 4 * i, np.uint8))
    video.release()
    (folder / "fGPS.txt").write_text("".join(f"{latitude:.20f},153.0023\n" for latitude in latitudes))
    return folder


# The table


@pytest.mark.parametrize("name", [name for name in DATASETS if name != "my-folder"])
def test_every_record_says_where_it_comes_from_and_under_which_terms(name):
    record = DATASETS[name]
    assert record.name == name
    assert record.title
    assert record.extent
    assert record.page.startswith("http")
    assert record.licence
    assert record.citation
    assert set(record.frames) <= set(record.sequences)
    assert record.reference is None or record.reference in record.sequences
    for part in record.parts:
        assert part.url.startswith("http")
        assert part.url.endswith(Path(part.file).name)
        assert set(part.sequences) <= set(record.sequences)
    given = {part.gives for part in record.parts}
    assert not given or given == ({"images", "truth"} if record.truth.files else {"images"})


def test_hash_of_new_college_is_that_of_the_published_list(data_folder):
    with open(data_folder / "ground_truth" / "NewCollege_sha256.csv", newline="") as file:
        rows = sorted((row["file"], row["sha256"]) for row in csv.DictReader(file))
    assert len(rows) == DATASETS["new-college"].frames["NewCollege"]
    lines = "".join(f"{name} {digest}\n" for name, digest in rows)
    assert hashlib.sha256(lines.encode()).hexdigest() == DATASETS["new-college"].images_sha256


def test_unknown_names_are_answered_with_the_nearest(tmp_path):
    with pytest.raises(ConfigError, match=r"'kity'.*did you mean 'kitti'"):
        open_dataset("kity")
    with pytest.raises(ConfigError, match=r"no sequence '11'.*it has 00, 01"):
        open_dataset("kitti", tmp_path, sequence="11")
    with pytest.raises(ConfigError, match=r"no view 'middle'.*left, right, all"):
        open_dataset("new-college", tmp_path, view="middle")
    with pytest.raises(ConfigError, match="is one stream"):
        open_dataset("kitti", tmp_path, reference="01")
    with pytest.raises(ConfigError, match="wanted two traverses"):
        open_dataset("nordland", tmp_path, sequence="summer")
    with pytest.raises(ConfigError, match="needs a folder"):
        open_dataset("my-folder")


# Layouts


@pytest.mark.parametrize("name", OXFORD)
def test_left_right_and_all_of_an_interleaved_stereo_set(name, tmp_path, stock):
    make_oxford(tmp_path, name, stock)
    half = OXFORD[name][1] // 2
    left, right, both = (open_dataset(name, tmp_path, view=view) for view in (None, "right", "all"))
    assert (left.view, len(left.images), len(right.images), len(both.images)) == ("left", half, half, 2 * half)
    assert levels(left.images) == [0, 2, 4, 6, 8, 10]
    assert levels(right.images) == [1, 3, 5, 7, 9, 11]
    assert levels(both.images) == [0, 1, 2, 3, 4, 5]
    assert pairs_of(truth_of(left)) == {(500, 5), (501, 6)}
    assert pairs_of(truth_of(right)) == {(500, 5)}
    assert len(pairs_of(truth_of(both))) == 4
    assert left.reference is None
    assert left.images.source.is_relative_to(datasets_folder())  # a list that `detect` takes as well


@pytest.mark.parametrize("name", OXFORD)
def test_missing_parts_of_an_interleaved_set_name_file_address_and_folder(name, tmp_path, stock):
    stem, _ = OXFORD[name]
    with pytest.raises(ImageError) as no_images:
        open_dataset(name, tmp_path)
    for word in (str(tmp_path), "Images.zip", f"Data/{stem}/Images.zip", f"loopclosure datasets fetch {name}"):
        assert word in str(no_images.value)
    make_oxford(tmp_path, name, stock)
    (tmp_path / f"{stem}GroundTruth.mat").unlink()
    with pytest.raises(TruthError) as no_truth:
        open_dataset(name, tmp_path)
    for word in (str(tmp_path), f"get {stem}GroundTruth.mat from http://", f"masks/{stem}GroundTruth.mat"):
        assert word in str(no_truth.value)
    (tmp_path / "Images").unlink()
    fill(tmp_path / "Images", ["0001.jpg", "0002.jpg"])
    with pytest.raises(ImageError, match=rf"holds 2 images, wanted the {OXFORD[name][1]} of"):
        open_dataset(name, tmp_path)


@pytest.mark.parametrize("top", ["", "dataset"])
def test_kitti_reads_poses_by_radius_and_prefers_colour(tmp_path, top):
    make_kitti(tmp_path, "04", "image_0", top)
    grey = open_dataset("kitti", tmp_path, sequence="04")
    assert grey.images.source.name == "image_0"
    make_kitti(tmp_path, "04", "image_2", top)
    opened = open_dataset("kitti", tmp_path, sequence="04")
    assert opened.images.source.name == "image_2"
    assert len(opened.images) == 271
    truth = truth_of(opened)
    angle = np.linspace(0, 4 * np.pi, 271)
    place = 30 * np.column_stack([np.cos(angle), np.sin(angle)])
    near = {(i, j) for i in range(271) for j in range(i - 99) if np.hypot(*(place[i] - place[j])) <= 4}
    assert near
    assert pairs_of(truth) == near
    with pytest.raises(ImageError, match=r"no images of 04.*image_3, .*image_1"):
        open_dataset("kitti", tmp_path, sequence="04", view="right")


def test_missing_parts_of_kitti(tmp_path):
    with pytest.raises(ImageError, match=r"images of 05.*get data_odometry_gray.zip from https://.*unpack it into"):
        open_dataset("kitti", tmp_path, sequence="05")
    make_kitti(tmp_path, "04")
    (tmp_path / "poses" / "04.txt").unlink()
    with pytest.raises(TruthError, match=r"truth of 04.*data_odometry_poses.zip"):
        open_dataset("kitti", tmp_path, sequence="04")
    (tmp_path / "sequences" / "04" / "image_0" / "000100.png").unlink()
    with pytest.raises(ImageError, match="holds 270 images, wanted the 271"):
        open_dataset("kitti", tmp_path, sequence="04")


def test_gardens_point_matches_equal_numbers(tmp_path):
    make_gardens_point(tmp_path)
    opened = open_dataset("gardens-point", tmp_path, sequence="night_right", reference="day_right")
    assert opened.frames == (200, 200)
    assert opened.images.source == tmp_path / "night_right"
    assert opened.reference.source == tmp_path / "day_right"
    assert pairs_of(truth_of(opened)) == {(i, i) for i in range(200)}
    assert opened.tolerance == 2
    assert open_dataset("gardens-point", tmp_path).reference.source.name == "day_left"
    (tmp_path / "day_left" / "Image199.jpg").unlink()
    with pytest.raises(ImageError, match="holds 199 images, wanted the 200"):
        open_dataset("gardens-point", tmp_path)


def test_nordland_opens_folders_and_videos_of_equal_length(tmp_path):
    fill(tmp_path / "summer", [f"{i}.png" for i in range(12)])
    fill(tmp_path / "winter" / "winter", [f"{i}.png" for i in range(12)])
    opened = open_dataset("nordland", tmp_path)
    assert opened.sequence == "winter"
    assert pairs_of(truth_of(opened)) == {(i, i) for i in range(12)}
    assert opened.tolerance == 10
    video = make_drive(tmp_path / "made", np.zeros(12)) / "webcam_video.avi"
    video.rename(tmp_path / "nordlandsbanen.fall.sync.mp4")
    assert open_dataset("nordland", tmp_path, sequence="fall").frames == (12, 12)
    (tmp_path / "summer" / "3.png").unlink()
    with pytest.raises(TruthError, match="12 and 11 frames, wanted equally many"):
        open_dataset("nordland", tmp_path)
    with pytest.raises(
        ImageError, match=r"images of spring.*get spring.tar.gz from https://\S+ and unpack it into \S+spring"
    ):
        open_dataset("nordland", tmp_path, sequence="spring")


def test_st_lucia_pairs_frames_by_their_positions(tmp_path):
    # One ten-thousandth of a degree of latitude is 11.1 m: within 25 m are the next two on either side.
    north = 27.5 + 1e-4 * np.arange(30)
    make_drive(tmp_path / "100909_0845", north)
    make_drive(tmp_path / "180809_1545", north[::-1])
    opened = open_dataset("st-lucia", tmp_path)
    assert opened.frames == (30, 30)
    wanted = {(i, j) for i in range(30) for j in range(30) if abs((29 - i) - j) <= 2}
    assert pairs_of(truth_of(opened)) == wanted
    with pytest.raises(ImageError, match=r"images of 190809_0845.*get it from https://.*put it into"):
        open_dataset("st-lucia", tmp_path, sequence="190809_0845")
    (tmp_path / "100909_0845" / "fGPS.txt").unlink()
    with pytest.raises(TruthError, match=r"truth of 100909_0845.*looked for 100909_0845/fGPS.txt"):
        open_dataset("st-lucia", tmp_path)


def haversine_m(a, b):
    (north_a, east_a), (north_b, east_b) = np.radians(a), np.radians(b)
    h = np.sin((north_b - north_a) / 2) ** 2
    h += np.cos(north_a) * np.cos(north_b) * np.sin((east_b - east_a) / 2) ** 2
    return 2 * 6_371_008.8 * np.arcsin(np.sqrt(h))


def test_positions_agree_with_great_circles(tmp_path):
    rng = np.random.default_rng(1)
    places = [np.array([27.5, 153.0]) + rng.uniform(-0.003, 0.003, (60, 2)) for _ in range(2)]
    files = [tmp_path / "a.txt", tmp_path / "b.txt"]
    for file, degrees in zip(files, places, strict=True):
        np.savetxt(file, degrees, fmt="%.17g", delimiter=",")
    distance = np.array([[haversine_m(a, b) for b in places[1]] for a in places[0]])
    assert not (np.abs(distance - 100) < 0.02).any()  # none so near the limit that the plane could decide
    lines = pairs_by_position(*files, frames=(60, 60), radius_m=100.0).splitlines()
    assert lines[0] == "query,match"
    assert {tuple(map(int, line.split(","))) for line in lines[1:]} == set(
        zip(*np.nonzero(distance <= 100), strict=True)
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no list of latitude"),
        ("27.5\n", "no list of latitude"),
        ("27.5,153\n" * 5, "has 5 positions for 100 frames"),
        ("95,153\n" * 100, "in degrees"),
        ("nan,153\n" * 100, "in degrees"),
        ("north,east\n" * 100, "wanted latitude,longitude"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*input contained no data:UserWarning")
def test_wrong_positions_are_refused(tmp_path, text, message):
    file = tmp_path / "fGPS.txt"
    file.write_text(text)
    with pytest.raises(TruthError, match=message):
        pairs_by_position(file, file, frames=(100, 100), radius_m=5.0)


def test_a_folder_of_ones_own(tmp_path):
    fill(tmp_path / "images", [f"{i}.png" for i in range(30)])
    plain = open_dataset("my-folder", tmp_path, download=True)  # nothing to download is no reason to fail
    assert plain.truth_path is None
    assert plain.frames == (30, None)
    (tmp_path / "poses.csv").write_text("frame,x,y\n" + "".join(f"{i},{i % 15},0\n" for i in range(30)))
    opened = open_dataset("my-folder", tmp_path, truth_settings={"radius_m": 0.5, "exclude_recent": 10})
    assert pairs_of(truth_of(opened)) == {(i + 15, i) for i in range(15)}
    (tmp_path / "other.csv").write_text("query,match\n20,3\n")
    other = open_dataset("my-folder", tmp_path, truth=tmp_path / "other.csv")
    assert pairs_of(truth_of(other)) == {(20, 3)}
    with pytest.raises(ImageError, match=r"there are no images in \S+ \(looked for images, \.\)"):
        open_dataset("my-folder", tmp_path / "absent")


def test_two_traverses_of_ones_own(tmp_path):
    for name in ("evening", "morning"):
        fill(tmp_path / name, [f"{i}.png" for i in range(5)])
    (tmp_path / "truth.csv").write_text("query,match\n4,0\n0,4\n")
    opened = open_dataset("my-folder", tmp_path, sequence="evening", reference="morning")
    assert opened.reference.source == tmp_path / "morning"
    assert pairs_of(truth_of(opened)) == {(4, 0), (0, 4)}


@pytest.mark.parametrize(
    ("view", "camera"), [("left", slice(0, None, 2)), ("right", slice(1, None, 2)), ("all", slice(None))]
)
def test_real_truth_of_new_college(data_folder, tmp_path, view, camera, stock):
    source = data_folder / "ground_truth" / "NewCollegeGroundTruth.mat"
    make_oxford(tmp_path, "new-college", stock)
    (tmp_path / source.name).write_bytes(source.read_bytes())
    matrix = loadmat(source)["truth"].astype(bool)[camera, camera]
    wanted = set(zip(*(axis.tolist() for axis in np.nonzero(matrix)), strict=True))
    assert len(wanted) > 3000
    assert pairs_of(truth_of(open_dataset("new-college", tmp_path, view=view))) == wanted


def test_real_truth_in_other_forms(data_folder, tmp_path, stock):
    matrices = data_folder / "ground_truth"
    make_oxford(tmp_path / "college", "new-college", stock)
    stitched = truth_of(open_dataset("new-college", tmp_path / "college", truth=matrices / "NewCollege_stitched.mat"))
    assert (stitched.pairs.nnz, int((stitched.matches_per_query() > 0).sum())) == (9318, 537)
    make_oxford(tmp_path / "city", "city-centre", stock)
    city = open_dataset("city-centre", tmp_path / "city", truth=matrices / "city_GT_final.mat")
    assert truth_of(city).pairs.shape == (1237, 1237)  # a matrix for pairs of images needs no view
    make_kitti(tmp_path / "kitti", "06")
    drive = open_dataset("kitti", tmp_path / "kitti", sequence="06", truth=matrices / "kitti06GroundTruth.mat")
    assert truth_of(drive).pairs.shape == (1101, 1101)
    wrong = open_dataset("kitti", tmp_path / "kitti", sequence="06", truth=matrices / "groundTruth_KITTI_05.mat")
    with pytest.raises(TruthError, match="2761 x 2761"):
        truth_of(wrong)


def test_real_walks(data_folder):
    opened = open_dataset("gardens-point", data_folder / "gardens_point")
    assert opened.frames == (200, 200)
    assert truth_of(opened).pairs.nnz == 200
    assert all(found.ok for found in check_dataset("gardens-point", data_folder / "gardens_point"))


# Downloads


class Server(ThreadingHTTPServer):
    """Serves `files`; writes down which byte each answer began with."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.begins: list[int] = []
        self.ranges = True
        self.validator = '"first"'
        self.cut_after: int | None = None

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server_port}/{name}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        content = self.server.files.get(self.path.lstrip("/"))
        if content is None:
            self.send_error(404)
            return
        begin = int(self.headers.get("Range", "bytes=0-")[6:-1])
        if not self.server.ranges or self.headers.get("If-Range") != self.server.validator:
            begin = 0
        self.server.begins.append(begin)
        if begin >= len(content) > 0:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.end_headers()
            return
        self.send_response(206 if begin else 200)
        if begin:
            self.send_header("Content-Range", f"bytes {begin}-{len(content) - 1}/{len(content)}")
        if self.server.validator:
            self.send_header("ETag", self.server.validator)
        self.send_header("Content-Length", str(len(content) - begin))
        self.end_headers()
        self.wfile.write(content[begin:][: self.server.cut_after])

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as running:
        running.files["a.bin"] = CONTENT
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def fetch_bytes(server: Server, folder: Path, **more) -> bytes:
    return download(server.url("a.bin"), folder / "a.bin", limit_bytes=1 << 24, **more).read_bytes()


def test_a_download_reports_and_leaves_only_the_file(server, tmp_path):
    told = []
    assert fetch_bytes(server, tmp_path / "new", sha256=DIGEST, progress=lambda *bytes_: told.append(bytes_)) == CONTENT
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.bin"]


def test_a_connection_that_breaks_is_taken_up_again(server, tmp_path):
    server.cut_after = 300_000
    assert fetch_bytes(server, tmp_path, sha256=DIGEST) == CONTENT
    assert len(server.begins) >= 4
    assert server.begins == sorted(set(server.begins))  # every answer began behind the one before


def test_an_interrupted_program_goes_on_where_it_stopped(server, tmp_path):
    def stop(arrived: int, total: int) -> None:
        if arrived > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch_bytes(server, tmp_path, progress=stop)
    assert not (tmp_path / "a.bin").exists()
    assert fetch_bytes(server, tmp_path, sha256=DIGEST) == CONTENT
    assert server.begins[1] > len(CONTENT) // 2


@pytest.mark.parametrize("change", ["another version", "no ranges", "no validator"])
def test_what_cannot_be_continued_is_begun_anew(server, tmp_path, change):
    if change == "no validator":
        server.validator = ""
    server.cut_after = 300_000
    server.ranges = False
    with pytest.raises(LoopClosureError, match=r"cannot download a.bin from http://\S+ .* bytes are kept"):
        fetch_bytes(server, tmp_path)
    server.cut_after = None
    server.ranges = change != "no ranges"
    if change == "another version":
        server.files["a.bin"], server.validator = CONTENT[::-1], '"second"'
    assert fetch_bytes(server, tmp_path) == server.files["a.bin"]


def test_a_whole_part_needs_no_more_bytes(server, tmp_path):
    (tmp_path / "a.bin.part").write_bytes(CONTENT)
    (tmp_path / "a.bin.part.version").write_text(server.validator)
    assert fetch_bytes(server, tmp_path, sha256=DIGEST) == CONTENT
    (tmp_path / "a.bin.part").write_bytes(CONTENT + b"more")
    (tmp_path / "a.bin.part.version").write_text(server.validator)
    assert fetch_bytes(server, tmp_path, sha256=DIGEST) == CONTENT


def test_downloads_that_fail(server, tmp_path):
    with pytest.raises(LoopClosureError, match=r"another file \(its sha256 is"):
        fetch_bytes(server, tmp_path, sha256="0" * 64)
    with pytest.raises(LoopClosureError, match="more than 1000 bytes"):
        download(server.url("a.bin"), tmp_path / "a.bin", limit_bytes=1000)
    with pytest.raises(LoopClosureError, match=rf"b.bin from http://\S+ \(HTTP 404\); put it into {tmp_path}"):
        download(server.url("b.bin"), tmp_path / "b.bin", limit_bytes=1000)
    assert not [file for file in tmp_path.iterdir() if file.suffix in (".bin", ".part")]
    with pytest.raises(LoopClosureError, match="ConnectionError"):
        download("http://127.0.0.1:9/a.bin", tmp_path / "a.bin", limit_bytes=1000)


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def test_fetching_downloads_unpacks_and_opens(server, tmp_path, monkeypatch, stock):
    make_oxford(tmp_path / "source", "new-college", stock)
    source = tmp_path / "source"
    server.files["Images.zip"] = zipped(
        {f"Images/{file.name}": file.read_bytes() for file in (source / "Images").iterdir()}
    )
    server.files["truth.mat"] = (source / "NewCollegeGroundTruth.mat").read_bytes()
    parts = (
        Part(file="NewCollegeGroundTruth.mat", url=server.url("truth.mat"), gives="truth", limit_gb=0.1),
        Part(file="Images.zip", url=server.url("Images.zip"), gives="images", limit_gb=0.1),
    )
    monkeypatch.setitem(DATASETS, "new-college", replace(DATASETS["new-college"], parts=parts))
    told = set()
    opened = open_dataset("new-college", download=True, progress=lambda what, *_: told.add(what))
    home = datasets_folder("new-college")
    assert len(opened.images) == 1073
    assert pairs_of(truth_of(opened)) == {(500, 5), (501, 6)}
    assert told == {"downloading NewCollegeGroundTruth.mat", "downloading Images.zip", "unpacking Images.zip"}
    assert sorted(file.name for file in home.iterdir()) == ["Images", "NewCollegeGroundTruth.mat"]
    asked = len(server.begins)
    fetch_dataset("new-college")
    assert len(server.begins) == asked  # nothing was missing


def test_only_the_wanted_sequences_are_fetched(server, tmp_path, monkeypatch):
    for season in ("summer", "winter"):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
            for i in range(3):
                info = tarfile.TarInfo(f"{season}/{i}.png")
                info.size = len(picture(i))
                archive.addfile(info, io.BytesIO(picture(i)))
        server.files[f"{season}.tar.gz"] = buffer.getvalue()
    record = DATASETS["nordland"]
    parts = tuple(replace(part, url=server.url(Path(part.file).name)) for part in record.parts)
    monkeypatch.setitem(DATASETS, "nordland", replace(record, parts=parts))
    opened = open_dataset("nordland", tmp_path, download=True)
    assert levels(opened.images) == [0, 1, 2]
    assert opened.frames == (3, 3)
    with pytest.raises(LoopClosureError, match=r"spring\.tar.gz"):
        fetch_dataset("nordland", tmp_path)


def test_an_archive_that_lies_there_is_unpacked_and_kept(tmp_path):
    walks = DATASETS["gardens-point"].sequences
    files = {f"{walk}/Image{i:03d}.jpg": picture(i) for walk in walks for i in range(200)}
    (tmp_path / "GardensPoint_Walking.zip").write_bytes(zipped(files))
    fetch_dataset("gardens-point", tmp_path)
    assert open_dataset("gardens-point", tmp_path).frames == (200, 200)
    assert (tmp_path / "GardensPoint_Walking.zip").is_file()


def test_what_no_program_can_fetch_says_so(tmp_path):
    with pytest.raises(LoopClosureError, match=r"St Lucia.*cannot be downloaded.*https://\S+ and put it into"):
        fetch_dataset("st-lucia", tmp_path)
    with pytest.raises(LoopClosureError, match="cannot be downloaded"):
        fetch_dataset("my-folder", tmp_path)


# Archives


def zip_with(info: zipfile.ZipInfo, content: bytes = b"x") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("good.txt", b"good")
        archive.writestr(info, content)
    return buffer.getvalue()


def zip_link() -> bytes:
    info = zipfile.ZipInfo("link")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return zip_with(info, b"/etc/passwd")


def zip_encrypted() -> bytes:
    content = bytearray(zip_with(zipfile.ZipInfo("secret.txt")))
    for magic, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.rindex(magic) + flags] |= 1
    return bytes(content)


def tar_with(kind: bytes, name: str = "link") -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        info = tarfile.TarInfo(name)
        info.type, info.linkname = kind, "/etc/passwd"
        archive.addfile(info)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", zip_with(zipfile.ZipInfo("../outside.txt")), "leads out of the folder"),
        ("a.zip", zip_with(zipfile.ZipInfo("/outside.txt")), "leads out of the folder"),
        ("a.zip", zip_with(zipfile.ZipInfo("C:outside.txt")), "leads out of the folder"),
        ("a.zip", zip_with(zipfile.ZipInfo("a/..\\..\\outside.txt")), "leads out of the folder"),
        ("a.zip", zip_link(), "link or a device"),
        ("a.zip", zip_encrypted(), "is encrypted"),
        ("a.zip", zipped({"bomb": bytes(3_000_000)}), "more than 2000000 bytes"),
        ("a.zip", zip_with(zipfile.ZipInfo("cut.bin"), bytes(5000))[:4000], "cannot be unpacked"),
        ("a.zip", zip_with(zipfile.ZipInfo("flipped"), b"0123456789").replace(b"0123456789", b"0123456780"), "CRC"),
        ("a.tar.gz", tar_with(tarfile.SYMTYPE), "link or a device"),
        ("a.tar.gz", tar_with(tarfile.LNKTYPE), "link or a device"),
        ("a.tar.gz", tar_with(tarfile.FIFOTYPE), "link or a device"),
        ("a.tar.gz", tar_with(tarfile.REGTYPE, "../outside.txt"), "leads out of the folder"),
        ("a.tar.gz", b"no archive", "cannot be unpacked"),
    ],
)
def test_hostile_archives_leave_nothing_behind(tmp_path, name, content, message):
    home = tmp_path / "home"
    home.mkdir()
    (home / name).write_bytes(content)
    with pytest.raises(LoopClosureError, match=message):
        unpack(home / name, home, limit_bytes=2_000_000)
    assert [path.name for path in home.iterdir()] == [name]
    assert not (tmp_path / "outside.txt").exists()


def test_unpacking_joins_what_is_there(tmp_path):
    (tmp_path / "dataset" / "poses").mkdir(parents=True)
    (tmp_path / "dataset" / "poses" / "00.txt").write_text("kept")
    (tmp_path / "a.zip").write_bytes(zipped({"dataset/sequences/00/0.png": picture(3), "dataset/readme": b""}))
    unpack(tmp_path / "a.zip", tmp_path, limit_bytes=10_000)
    assert (tmp_path / "dataset" / "poses" / "00.txt").read_text() == "kept"
    assert (tmp_path / "dataset" / "sequences" / "00" / "0.png").read_bytes() == picture(3)


# Checks and the command


def test_check_finds_other_images_than_the_published(tmp_path, monkeypatch, stock):
    make_oxford(tmp_path, "new-college", stock)
    images, truth = check_dataset("new-college", tmp_path)
    assert truth.ok
    assert "not the published images" in images.state
    assert check_dataset("new-college", tmp_path, hashes=False)[0].ok
    files = sorted((tmp_path / "Images").iterdir())
    lines = "".join(f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}\n" for file in files)
    right = replace(DATASETS["new-college"], images_sha256=hashlib.sha256(lines.encode()).hexdigest())
    monkeypatch.setitem(DATASETS, "new-college", right)
    assert check_dataset("new-college", tmp_path)[0].ok


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line as a user would; returns exit status, stdout and stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["loopclosure", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return call


def test_the_command_lists_what_there_is(run):
    code, out, _ = run("datasets", "--json")
    assert code == 0
    rows = json.loads(out)
    assert list(rows) == list(DATASETS)
    assert {row["here"] for row in rows.values()} == {"no"}
    make_gardens_point(datasets_folder("gardens-point"))
    make_kitti(datasets_folder("kitti"), "04")
    rows = json.loads(run("datasets", "--json")[1])
    assert (rows["gardens-point"]["here"], rows["kitti"]["here"]) == ("whole", "in part")
    code, out, _ = run("datasets")
    assert code == 0
    for record in DATASETS.values():
        assert record.name in out
        assert record.page in out


def test_the_command_checks_a_copy(run, tmp_path):
    make_kitti(tmp_path, "04")
    code, out, _ = run("datasets", "check", "kitti", "--folder", tmp_path, "--sequence", "04")
    assert code == 0
    assert out.splitlines()[0] == f"images of 04: {tmp_path}/sequences/04/image_0"
    code, out, _ = run("datasets", "check", "kitti", "--folder", tmp_path, "--json")
    found = json.loads(out)
    assert (code, found["whole"]) == (1, False)
    assert [part["part"] for part in found["parts"] if part["state"] == "ok"] == ["images of 04", "truth of 04"]


def test_the_command_fetches(run, server, tmp_path, monkeypatch):
    walks = DATASETS["gardens-point"].sequences
    server.files["walks.zip"] = zipped({f"{walk}/{i}.jpg": picture(i) for walk in walks for i in range(200)})
    part = Part(file="walks.zip", url=server.url("walks.zip"), gives="images", limit_gb=0.1)
    monkeypatch.setitem(DATASETS, "gardens-point", replace(DATASETS["gardens-point"], parts=(part,)))
    code, out, _ = run("datasets", "fetch", "gardens-point", "--folder", tmp_path, "--json")
    assert (code, json.loads(out)) == (0, {"data set": "gardens-point", "folder": str(tmp_path)})
    assert run("datasets", "check", "gardens-point", "--folder", tmp_path)[0] == 0
    code, out, err = run("datasets", "fetch", "st-lucia")
    assert (code, out) == (1, "")
    assert err.startswith("error: St Lucia")
    assert err.count("\n") == 1
