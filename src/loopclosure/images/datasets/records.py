"""The table of data sets: facts only. What nobody states is called so; no address stands here that was not found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from loopclosure.errors import ConfigError, did_you_mean

NOT_STATED = "not stated"


@dataclass(frozen=True, kw_only=True)
class Part:
    """A file that can be downloaded.

    Attributes
    ----------
    file : str
        Where it lands in the folder of the data set; an archive is unpacked beside itself.
    url : str
        Its address.
    gives : {'images', 'truth'}
        What is missing without it.
    limit_gb : float
        Neither the file nor what it unpacks to may be larger, 10**9 bytes.
    sha256 : str or None
        Hexadecimal digest, where it is known.
    sequences : tuple of str
        The sequences that it belongs to; empty means all.
    """

    file: str
    url: str
    gives: Literal["images", "truth"]
    limit_gb: float
    sha256: str | None = None
    sequences: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TruthRule:
    """How it is known which frames show one place.

    Attributes
    ----------
    kind : {'file', 'same number', 'positions'}
        A file that is read as it is; frames of two traverses with the same number; or frames of two traverses whose
        GPS positions, one ``latitude,longitude`` a line and frame, are near each other.
    files : tuple of str
        Where the truth, or the positions, may lie; ``{sequence}`` stands for the sequence.
    settings : mapping
        Further arguments of `loopclosure.evaluation.load_truth`.
    radius_m : float
        For positions: frames within this distance show one place, metres.
    tolerance : int
        Frames by which a match may be off, where the data set has a custom.
    required : bool
        Whether the data set is incomplete without it.
    """

    kind: Literal["file", "same number", "positions"] = "file"
    files: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    radius_m: float = 0.0
    tolerance: int = 0
    required: bool = True


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """What is known of one data set.

    Attributes
    ----------
    name, title : str
        What the user types; what it is called.
    page : str
        Where it is published.
    licence, citation : str
        Its terms, as far as they are stated; the paper, with its DOI where there is one.
    extent : str
        How much it is, in words.
    images : tuple of str
        Where the images, or the video, of a sequence may lie: patterns in the folder, the first that fits counts;
        ``{sequence}`` and ``{camera}`` stand for their names.
    truth : TruthRule
        How truth is made.
    sequences : tuple of str
        Known sequences, the default first; empty means any name, and none is needed.
    reference : str or None
        Default reference traverse; None where each sequence is one stream.
    cameras : mapping of str to tuple of str
        View -> what may stand for ``{camera}``; the first view is the default.
    interleaved : bool
        Whether left and right images lie in one folder by turns, left first.
    frames : mapping of str to int
        Sequence -> number of image files in its folder, where it is fixed.
    images_sha256 : str or None
        SHA-256 of the lines ``name sha256`` of all images, in order.
    parts : tuple of Part
        What can be downloaded; empty means: by hand, from `page`.
    """

    name: str
    title: str
    page: str
    licence: str
    citation: str
    extent: str
    images: tuple[str, ...]
    truth: TruthRule
    sequences: tuple[str, ...] = ()
    reference: str | None = None
    cameras: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"all": ("",)})
    interleaved: bool = False
    frames: Mapping[str, int] = field(default_factory=dict)
    images_sha256: str | None = None
    parts: tuple[Part, ...] = ()


def dataset_named(name: str) -> Dataset:
    """Return a record of `DATASETS`.

    Raises
    ------
    ConfigError
        For an unknown name, with the nearest known one.

    Examples
    --------
    >>> dataset_named("kitti").licence
    'CC BY-NC-SA 3.0'
    """
    if name not in DATASETS:
        raise ConfigError(f"unknown data set '{name}'{did_you_mean(name, DATASETS)}; known: {', '.join(DATASETS)}")
    return DATASETS[name]


def _oxford(name: str, title: str, stem: str, images: int, images_sha256: str | None = None) -> Dataset:
    """Return one of the two sets of the FAB-MAP paper, which differ in little but their names."""
    root = f"http://www.robots.ox.ac.uk/~mobile/IJRR_2008_Dataset/Data/{stem}"
    matrix = f"{stem}GroundTruth.mat"
    return Dataset(
        name=name,
        title=title,
        page="http://www.ijrr.org/ijrr_2008/volume27-issue6/090961/3_data.htm",
        licence=NOT_STATED,
        citation="Cummins & Newman 2008, IJRR 27(6), doi:10.1177/0278364908090961",
        extent=f"{images} images: {images // 2} left and right by turns",
        images=("Images", "images", "."),
        truth=TruthRule(files=(matrix, f"masks/{matrix}"), settings={"key": "truth"}),
        sequences=(stem,),
        cameras={"left": ("",), "right": ("",), "all": ("",)},
        interleaved=True,
        frames={stem: images},
        images_sha256=images_sha256,
        parts=(
            Part(file=matrix, url=f"{root}/masks/{matrix}", gives="truth", limit_gb=0.1),
            Part(file="Images.zip", url=f"{root}/Images.zip", gives="images", limit_gb=4),
        ),
    )


_KITTI_FRAMES = (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201)
_KITTI_URL = "https://s3.eu-central-1.amazonaws.com/avg-kitti"
_KITTI = Dataset(
    name="kitti",
    title="KITTI odometry",
    page="https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
    licence="CC BY-NC-SA 3.0",
    citation="Geiger, Lenz & Urtasun 2012, CVPR, doi:10.1109/CVPR.2012.6248074",
    extent="11 drives with poses, 271 to 4661 frames at 10 Hz",
    images=("sequences/{sequence}/{camera}", "dataset/sequences/{sequence}/{camera}"),
    # Four metres and ten seconds are our choice; the protocol that is printed with every result names both.
    truth=TruthRule(
        files=("poses/{sequence}.txt", "dataset/poses/{sequence}.txt"),
        settings={"radius_m": 4.0, "exclude_recent": 100},
    ),
    sequences=tuple(f"{i:02d}" for i in range(len(_KITTI_FRAMES))),
    cameras={"left": ("image_2", "image_0"), "right": ("image_3", "image_1")},  # colour before grey
    frames={f"{i:02d}": frames for i, frames in enumerate(_KITTI_FRAMES)},
    parts=(
        Part(file="data_odometry_poses.zip", url=f"{_KITTI_URL}/data_odometry_poses.zip", gives="truth", limit_gb=0.1),
        Part(file="data_odometry_gray.zip", url=f"{_KITTI_URL}/data_odometry_gray.zip", gives="images", limit_gb=60),
    ),
)

_GARDENS_POINT = Dataset(
    name="gardens-point",
    title="Gardens Point Walking",
    page="https://zenodo.org/record/4590133",
    licence=NOT_STATED,
    citation="Glover 2014, doi:10.5281/zenodo.4590133",
    extent="3 walks of 200 frames: left by day, right by day, right by night",
    images=("{sequence}", "*/{sequence}"),
    truth=TruthRule(kind="same number", tolerance=2),
    sequences=("day_right", "night_right", "day_left"),
    reference="day_left",
    frames={"day_right": 200, "night_right": 200, "day_left": 200},
    parts=(
        Part(
            file="GardensPoint_Walking.zip",
            url="https://www.tu-chemnitz.de/etit/proaut/datasets/GardensPoint_Walking.zip",
            gives="images",
            limit_gb=4,
        ),
    ),
)

_SEASONS = ("winter", "spring", "fall", "summer")
_NORDLAND = Dataset(
    name="nordland",
    title="Nordland",
    page="https://nrkbeta.no/2013/01/15/nordlandsbanen-minute-by-minute-season-by-season/",
    licence="Creative Commons (which one: not stated; the copy that is fetched says CC BY-NC-SA 4.0)",
    citation="Norwegian Broadcasting Corporation 2013",
    extent="one railway line in 4 seasons, about 10 hours each",
    images=("{sequence}", "{sequence}/{sequence}", "*{sequence}*.mp4"),
    truth=TruthRule(kind="same number", tolerance=10),
    sequences=_SEASONS,
    reference="summer",
    parts=tuple(
        Part(
            file=f"{season}/{season}.tar.gz",
            url=f"https://huggingface.co/datasets/Somayeh-h/Nordland/resolve/main/data/{season}.tar.gz",
            gives="images",
            limit_gb=40,
            sequences=(season,),
        )
        for season in _SEASONS
    ),
)

_ST_LUCIA = Dataset(
    name="st-lucia",
    title="St Lucia, multiple times of day",
    page="https://github.com/arrenglover/openfabmap/wiki/Datasets",
    licence=NOT_STATED,
    citation="Glover, Maddern, Milford & Wyeth 2010, ICRA",
    extent="10 drives through one suburb, each a video and a GPS position a frame",
    images=("{sequence}/webcam_video.avi", "{sequence}/frames", "{sequence}"),
    truth=TruthRule(kind="positions", files=("{sequence}/fGPS.txt",), radius_m=25.0),
    sequences=(
        "180809_1545", "100909_0845", "100909_1000", "100909_1210", "100909_1410",
        "110909_1545", "190809_0845", "190809_1410", "210809_1000", "210809_1210",
    ),
    reference="100909_0845",
)  # fmt: skip

_OWN = Dataset(
    name="my-folder",
    title="a folder of your own",
    page="",
    licence="yours",
    citation="",
    extent="any",
    images=("{sequence}/images", "{sequence}"),
    truth=TruthRule(
        files=tuple(
            f"{place}{file}"
            for place in ("{sequence}/", "")
            for file in ("truth.csv", "truth.mat", "truth.npy", "truth.png", "poses.csv", "poses.txt")
        ),
        required=False,
    ),
)

DATASETS: dict[str, Dataset] = {
    dataset.name: dataset
    for dataset in (
        _oxford(
            "new-college",
            "New College (FAB-MAP 2008)",
            "NewCollege",
            2146,
            "0fb3198829d44cef252b56e888a2673a105509bb53d184257218a4c13a3fa118",
        ),
        _oxford("city-centre", "City Centre (FAB-MAP 2008)", "CityCentre", 2474),
        _KITTI,
        _GARDENS_POINT,
        _NORDLAND,
        _ST_LUCIA,
        _OWN,
    )
}
"""Every known data set by the name that users type."""
