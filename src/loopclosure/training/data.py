"""Training data from disk: a tree of class folders, a list of pairs, a sequence with poses."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, cast

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import FitError, ImageError, TruthError
from loopclosure.evaluation.tables import Poses, read_text
from loopclosure.images.decode import EXTENSIONS, Image, read_image
from loopclosure.images.sequence import MAX_LIST_BYTES, ImageSequence
from loopclosure.training.places import DIFFERENT, SAME, LabelledPlaces, ListedPlaces, Places, PosedPlaces

PAIR_HEADER = ["first", "second", "same"]


class Images(Protocol):
    """Images by number."""

    def __len__(self) -> int: ...
    def __getitem__(self, number: int, /) -> Image: ...


class TrainingData(NamedTuple):
    """Images, and which of them show one place.

    Attributes
    ----------
    images : Images
        All of them, by number.
    places : Places
        What is known of their pairs.
    summary : str
        What it is, for the model card.
    """

    images: Images
    places: Places
    summary: str


class Photographs:
    """Image files by number."""

    def __init__(self, files: Sequence[Path], *, max_megapixels: float) -> None:
        self._files, self._max_megapixels = files, max_megapixels

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, number: int) -> Image:
        return read_image(self._files[number], max_megapixels=self._max_megapixels)


def open_data(
    source: str | os.PathLike[str], *, poses: str | os.PathLike[str] | None = None, config: Config
) -> TrainingData:
    """Open training data of any form.

    Parameters
    ----------
    source : path
        A tree of class folders (as torchvision's ImageFolder reads it, Places-365 for one), a ``.csv`` file with the
        header ``first,second,same`` and paths relative to its folder, or, with `poses`, a folder of images in order.
    poses : path, optional
        ``frame,x,y[,z]``, TUM or KITTI, one pose a frame.
    config : Config
        Its sections `images`, `sequence` and `training` are used.

    Raises
    ------
    FitError
        If there is nothing to learn from: one class, an empty one, pairs of one kind, no second visit.
    ImageError, TruthError
        If images or poses are missing or cannot be read.
    """
    path = Path(source)
    if poses is not None:
        return _posed(path, Path(poses), config)
    if path.is_dir():
        return _class_tree(path, config)
    if path.suffix.lower() == ".csv":
        return _pair_list(path, config)
    raise FitError(f"{path} is neither a folder of class folders nor a .csv list of pairs; a sequence wants its poses")


def _class_tree(folder: Path, config: Config) -> TrainingData:
    from torchvision.datasets.folder import make_dataset

    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    if len(names) < 2:
        raise FitError(
            f"{folder} holds {len(names)} class folder{'s' * (len(names) != 1)}, wanted at least 2: "
            "pairs of different classes are needed; a sequence wants its poses"
        )
    try:
        rows = make_dataset(folder, {name: label for label, name in enumerate(names)}, extensions=EXTENSIONS)
    except FileNotFoundError as error:
        empty = str(error).partition("classes ")[2].partition(". Supported")[0].rstrip(".")
        raise FitError(f"{folder} holds classes without images: {empty}; fill or remove those folders") from None
    labels = np.array([label for _, label in rows], np.int64)
    counts = np.bincount(labels, minlength=len(names))
    if counts.min() < 4:
        name = names[int(counts.argmin())]
        raise FitError(f"the class {folder / name} holds {counts.min()} images, wanted at least 4")
    images = Photographs([Path(file) for file, _ in rows], max_megapixels=config.images.max_megapixels)
    places = LabelledPlaces(labels, np.arange(len(labels)))
    return TrainingData(images, places, f"{len(labels)} images of {len(names)} classes in {folder.name}")


def _pair_list(file: Path, config: Config) -> TrainingData:
    numbers: dict[Path, int] = {}
    pairs, same = [], []
    for line, row in enumerate(_rows(file), start=2):
        if len(row) != len(PAIR_HEADER) or row[2].strip() not in ("0", "1"):
            raise FitError(f"{file}, line {line}: found {','.join(row)[:200]!r}, wanted first,second,same with 0 or 1")
        for name in row[:2]:
            image = file.parent / name.strip()
            if not os.path.isfile(image):
                raise ImageError(f"{file}, line {line}: there is no image file {str(image)[:300]}")
            numbers.setdefault(image, len(numbers))
        pairs.append([numbers[file.parent / name.strip()] for name in row[:2]])
        same.append(row[2].strip() == "1")
    if min(sum(same), len(same) - sum(same)) < 2:
        raise FitError(
            f"{file} holds {sum(same)} pairs of one place and {len(same) - sum(same)} of two, wanted at least 2 of each"
        )
    images = Photographs(list(numbers), max_megapixels=config.images.max_megapixels)
    places = ListedPlaces(np.array(pairs, np.int64), np.array(same))
    return TrainingData(images, places, f"{len(pairs)} pairs of {len(numbers)} images in {file.name}")


def _rows(file: Path) -> list[list[str]]:
    try:
        if file.stat().st_size > MAX_LIST_BYTES:
            raise FitError(f"{file} is larger than {MAX_LIST_BYTES} bytes: it is no list of pairs")
        rows = list(csv.reader(file.read_text(encoding="utf-8-sig").splitlines()))
    except OSError as error:
        raise FitError(f"cannot read the list of pairs {file}: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise FitError(f"{file} is no CSV text: {error}") from None
    header = [name.strip().lower() for name in rows[0]] if rows else []
    if header != PAIR_HEADER:
        raise FitError(f"{file} has the header {','.join(header)[:80]!r}, wanted {','.join(PAIR_HEADER)}")
    return rows[1:]


def _posed(folder: Path, poses_file: Path, config: Config) -> TrainingData:
    images = ImageSequence(folder, max_megapixels=config.images.max_megapixels)
    if images.is_video:
        raise ImageError(f"{folder} is a video, whose frames cannot be drawn in any order; extract them to a folder")
    if not poses_file.is_file():
        raise TruthError(f"there is no file of poses {poses_file}")
    poses = read_text(poses_file)
    if not isinstance(poses, Poses):
        raise TruthError(f"{poses_file} holds pairs of frames, wanted poses: frame,x,y[,z], TUM or KITTI")
    if len(poses.positions) != len(images):
        raise TruthError(f"{poses_file} holds {len(poses.positions)} poses, {folder} {len(images)} images")
    members = np.flatnonzero(np.isfinite(poses.positions).all(axis=1))
    training = config.training
    places = PosedPlaces(
        poses.positions,
        members,
        positive_m=training.positive_m,
        negative_m=training.negative_m,
        exclude_recent=config.sequence.exclude_recent,
    )
    _check_visits(places, folder, config)
    return TrainingData(cast(Images, images), places, f"{len(members)} frames with poses in {folder.name}")


def _check_visits(places: PosedPlaces, folder: Path, config: Config) -> None:
    training = config.training
    if not len(places.anchors(SAME)):
        raise FitError(
            f"no frame of {folder} has another visit within {training.positive_m:g} m at least "
            f"{config.sequence.exclude_recent} frames away: nothing to learn from (training.positive_m, "
            "sequence.exclude_recent)"
        )
    if not len(places.anchors(DIFFERENT)):
        raise FitError(f"no two frames of {folder} are {training.negative_m:g} m apart (training.negative_m)")
