"""Where the parts of a data set lie in its folder, and what is wrong with them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from loopclosure.errors import ConfigError, ImageError, LoopClosureError, TruthError, did_you_mean
from loopclosure.images.datasets.records import Dataset, Part, dataset_named
from loopclosure.images.decode import EXTENSIONS
from loopclosure.images.sequence import natural_key
from loopclosure.weights import cache_folder, file_sha256

Progress = Callable[[str, int, int], None]
"""Told what is being worked on, how much of it is done, and how much there is (0 if nobody knows)."""


@dataclass(frozen=True)
class Finding:
    """One part of a data set, as it was found.

    Attributes
    ----------
    part : str
        Which one.
    path : pathlib.Path or None
        Where it lies; None if it is missing.
    state : str
        ``ok``, or what is wrong and what to do.
    """

    part: str
    path: Path | None
    state: str

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return self.state == "ok"


def datasets_folder(name: str | None = None) -> Path:
    """Return where data sets are looked for if no folder is given; ``LOOPCLOSURE_CACHE`` moves it."""
    return cache_folder().parent / "datasets" / (name or "")


def home_of(dataset: Dataset, folder: str | os.PathLike[str] | None) -> Path:
    """Return the folder of a data set: the one that the user gave, or the one in the cache."""
    if folder is None and dataset.name == "my-folder":
        raise ConfigError("the data set 'my-folder' needs a folder: the one that holds your images")
    return Path(folder).expanduser() if folder is not None else datasets_folder(dataset.name)


def sequence_named(dataset: Dataset, sequence: str | None) -> str:
    """Return a sequence of the data set; None is its default."""
    if sequence is None:
        return dataset.sequences[0] if dataset.sequences else ""
    if dataset.sequences and sequence not in dataset.sequences:
        raise ConfigError(
            f"{dataset.title} has no sequence '{sequence}'{did_you_mean(sequence, dataset.sequences)}; "
            f"it has {', '.join(dataset.sequences)}"
        )
    return sequence


def find_images(dataset: Dataset, folder: Path, sequence: str, view: str) -> Path:
    """Return the folder of images, or the video, of a sequence.

    Raises
    ------
    ImageError
        If it is missing, or holds another number of images than the data set has.
    """
    patterns = [_filled(pattern, sequence, camera) for pattern in dataset.images for camera in dataset.cameras[view]]
    path = _first(folder, patterns, _holds_images)
    if path is None:
        raise ImageError(_missing(dataset, folder, sequence, "images", patterns))
    wanted = dataset.frames.get(sequence)
    found = len(image_files(path)) if path.is_dir() else wanted
    if wanted not in (None, found):
        raise ImageError(
            f"{path} holds {found} images, wanted the {wanted} of {dataset.title}: was it unpacked only in part, "
            "or are other images among them?"
        )
    return path


def find_truth(dataset: Dataset, folder: Path, sequence: str) -> Path | None:
    """Return the truth file (or the positions) of a sequence; None where there need be none.

    Raises
    ------
    TruthError
        If it is missing.
    """
    patterns = [_filled(pattern, sequence) for pattern in dataset.truth.files]
    path = _first(folder, patterns, Path.is_file)
    if path is None and patterns and dataset.truth.required:
        raise TruthError(_missing(dataset, folder, sequence, "truth", patterns))
    return path


def missing_parts(dataset: Dataset, folder: Path, sequences: Iterable[str]) -> list[Part]:
    """Return what has to be downloaded before these sequences are complete."""
    wanted = set(sequences)
    return [
        part
        for part in dataset.parts
        if not all(_is_here(dataset, folder, sequence, part) for sequence in wanted & set(part.sequences or wanted))
    ]


def check_dataset(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    *,
    sequences: Iterable[str] | None = None,
    hashes: bool = True,
    progress: Progress | None = None,
) -> list[Finding]:
    """Look at every part of a data set: is it there, is it whole, and are its images the published ones?

    Parameters
    ----------
    name : str
        A name of `DATASETS`.
    folder : path, optional
        Where it lies; default in the cache.
    sequences : iterable of str, optional
        Default all.
    hashes : bool
        Whether images whose hash is known are compared with it, which reads all of them.
    progress : callable, optional
        Told of images that were compared with their known hash.

    Returns
    -------
    list of Finding
        Images and truth of each sequence; the default view of each.
    """
    dataset = dataset_named(name)
    home = home_of(dataset, folder)
    findings = []
    for sequence in [sequence_named(dataset, wanted) for wanted in sequences or dataset.sequences or (None,)]:
        of = f" of {sequence}" if sequence else ""
        view = next(iter(dataset.cameras))
        images = _finding(f"images{of}", partial(find_images, dataset, home, sequence, view))
        if hashes and images.path is not None and dataset.images_sha256:
            images = _compared(images, images.path, dataset.images_sha256, progress)
        findings.append(images)
        if dataset.truth.files:
            findings.append(_finding(f"truth{of}", partial(find_truth, dataset, home, sequence)))
    return findings


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order; hidden files are none."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in EXTENSIONS and not file.name.startswith(".")]
    return sorted(files, key=lambda file: natural_key(file.name))


def _filled(pattern: str, sequence: str, camera: str = "") -> str:
    # An empty name must not turn a pattern into an absolute path.
    return pattern.format(sequence=sequence, camera=camera).strip("/") or "."


def _first(folder: Path, patterns: Iterable[str], fits: Callable[[Path], bool]) -> Path | None:
    for pattern in patterns:
        paths = sorted(folder.glob(pattern)) if "*" in pattern else [folder / pattern]
        for path in paths:
            if fits(path):
                return path
    return None


def _holds_images(path: Path) -> bool:
    return path.is_file() or (path.is_dir() and bool(image_files(path)))


def _is_here(dataset: Dataset, folder: Path, sequence: str, part: Part) -> bool:
    try:
        if part.gives == "truth":
            find_truth(dataset, folder, sequence)
        else:
            find_images(dataset, folder, sequence, next(iter(dataset.cameras)))
    except (ImageError, TruthError):
        return False
    return True


def _missing(dataset: Dataset, folder: Path, sequence: str, what: str, patterns: list[str]) -> str:
    of = f" of {sequence}" if sequence else ""
    found = f"{dataset.title}: there are no {what}{of} in {folder} (looked for {', '.join(patterns)})"
    for part in dataset.parts:
        if part.gives == what and sequence in (part.sequences or (sequence,)):
            place = (folder / part.file).parent
            verb = "put it" if part.file.endswith(".mat") else "unpack it"
            return (
                f"{found}; get {part.file.rpartition('/')[2]} from {part.url} and {verb} into {place}, "
                f"or let `loopclosure datasets fetch {dataset.name}` try"
            )
    if dataset.page:
        return f"{found}; get it from {dataset.page} and put it into {folder}"
    return found


def _finding(part: str, find: Callable[[], Path | None]) -> Finding:
    try:
        path = find()
    except LoopClosureError as error:
        return Finding(part, None, str(error))
    return Finding(part, path, "ok")


def _compared(images: Finding, folder: Path, wanted: str, progress: Progress | None) -> Finding:
    digest = hashlib.sha256()
    files = image_files(folder)
    for done, file in enumerate(files, start=1):
        digest.update(f"{file.name} {file_sha256(file)}\n".encode())
        if progress:
            progress("hashing", done, len(files))
    if digest.hexdigest() == wanted:
        return images
    return Finding(images.part, folder, "these are not the published images: their names or their contents differ")
