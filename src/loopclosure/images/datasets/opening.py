"""A data set as images and truth, ready for a detector and an evaluation."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopclosure.errors import ConfigError, did_you_mean
from loopclosure.images.datasets.fetch import fetch_dataset
from loopclosure.images.datasets.layout import (
    Progress,
    datasets_folder,
    find_images,
    find_truth,
    home_of,
    sequence_named,
)
from loopclosure.images.datasets.pairs import pairs_by_number, pairs_by_position
from loopclosure.images.datasets.records import Dataset, dataset_named
from loopclosure.images.sequence import ImageSequence

_FIRST = {"left": 0, "right": 1}


@dataclass(frozen=True)
class OpenedDataset:
    """Images and truth of one sequence, or of one traverse against another.

    Attributes
    ----------
    dataset : Dataset
        What is known of it.
    sequence, view : str
        What was opened.
    images : ImageSequence
        The queries; ``images.source`` can be given to every command that takes a SOURCE.
    reference : ImageSequence or None
        The reference traverse; None in one stream.
    truth_path : pathlib.Path or None
        A file for `loopclosure.evaluation.load_truth`; None where the user's own folder has none.
    truth_settings : dict
        The further arguments that it needs.
    tolerance : int
        Frames by which a match may be off, where the data set has a custom.
    """

    dataset: Dataset
    sequence: str
    view: str
    images: ImageSequence
    reference: ImageSequence | None
    truth_path: Path | None
    truth_settings: dict[str, Any]
    tolerance: int

    @property
    def frames(self) -> tuple[int, int | None]:
        """Number of queries, and of references (None in one stream): what `load_truth` calls ``frames``."""
        return len(self.images), None if self.reference is None else len(self.reference)


def open_dataset(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    *,
    sequence: str | None = None,
    reference: str | None = None,
    view: str | None = None,
    truth: str | os.PathLike[str] | None = None,
    truth_settings: Mapping[str, Any] | None = None,
    download: bool = False,
    progress: Progress | None = None,
) -> OpenedDataset:
    """Open a data set in a folder.

    Parameters
    ----------
    name : str
        A name of `DATASETS`.
    folder : path, optional
        Where it lies; default in the cache.
    sequence, reference : str, optional
        Which drive, and for sets of several traverses, against which one; default as the record says. In a folder of
        your own these are sub-folders.
    view : str, optional
        Camera of a stereo set; default the first of the record's, which is ``left``.
    truth : path, optional
        Another truth than the data set's own, read with `truth_settings` alone.
    truth_settings : mapping, optional
        Arguments of `load_truth` that replace or add to those of the record, such as ``radius_m``.
    download : bool
        Whether missing parts are fetched.
    progress : callable, optional
        Told ``(what, done, total)`` while they are.

    Returns
    -------
    OpenedDataset

    Raises
    ------
    ConfigError
        For an unknown name, sequence or view.
    ImageError, TruthError
        For a missing or incomplete part: says which file, from where, into which folder.
    """
    dataset = dataset_named(name)
    home = home_of(dataset, folder)
    sequence = sequence_named(dataset, sequence)
    against = _reference(dataset, sequence, reference)
    view = _view(dataset, view)
    if download and dataset.parts:
        fetch_dataset(name, home, sequences=filter(None, (sequence, against)), progress=progress)
    images = _one_camera(dataset, ImageSequence(find_images(dataset, home, sequence, view)), view)
    others = None if against is None else ImageSequence(find_images(dataset, home, against, view))
    settings: dict[str, Any] = {}
    if truth is not None:
        truth_path: Path | None = Path(truth).expanduser()
    elif others is not None and against is not None and dataset.truth.kind != "file":
        pairs = _pairs(dataset, home, (sequence, against), (len(images), len(others)))
        truth_path = _kept(f"{dataset.name}-{sequence}-{against}", ".csv", pairs)
    else:
        truth_path = find_truth(dataset, home, sequence)
        settings = dict(dataset.truth.settings) | ({"view": view} if dataset.interleaved else {})
    settings |= truth_settings or {}
    return OpenedDataset(dataset, sequence, view, images, others, truth_path, settings, dataset.truth.tolerance)


def _reference(dataset: Dataset, sequence: str, reference: str | None) -> str | None:
    if reference is None:
        reference = dataset.reference
    elif dataset.sequences and dataset.reference is None:
        raise ConfigError(f"each sequence of {dataset.title} is one stream, but the reference '{reference}' was given")
    if reference is None:
        return None
    if sequence_named(dataset, reference) == sequence:
        raise ConfigError(f"'{sequence}' was given as sequence and as reference, wanted two traverses")
    return reference


def _view(dataset: Dataset, view: str | None) -> str:
    if view is None:
        return next(iter(dataset.cameras))
    if view not in dataset.cameras:
        raise ConfigError(
            f"{dataset.title} has no view '{view}'{did_you_mean(view, dataset.cameras)}; "
            f"it has {', '.join(dataset.cameras)}"
        )
    return view


def _one_camera(dataset: Dataset, images: ImageSequence, view: str) -> ImageSequence:
    if not dataset.interleaved or view not in _FIRST:
        return images
    folder = images.source.absolute()
    lines = [f"{folder / name}\n" for name in images.names[_FIRST[view] :: 2]]
    return ImageSequence(_kept(f"{dataset.name}-{view}", ".txt", "".join(lines)))


def _pairs(dataset: Dataset, home: Path, traverses: tuple[str, str], frames: tuple[int, int]) -> str:
    if dataset.truth.kind == "same number":
        return pairs_by_number(*frames)
    files = [file for name in traverses if (file := find_truth(dataset, home, name))]
    return pairs_by_position(*files, frames=frames, radius_m=dataset.truth.radius_m)


def _kept(stem: str, ending: str, text: str) -> Path:
    """Write a small file into the cache, named by its content so that it never has to change."""
    content = os.fsencode(text)
    path = datasets_folder("made") / f"{stem}-{hashlib.sha256(content).hexdigest()[:16]}{ending}"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.{os.getpid()}.part")
        part.write_bytes(content)
        os.replace(part, path)
    return path
