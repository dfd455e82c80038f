"""The missing parts of a data set, from where they are published into its folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from loopclosure.errors import LoopClosureError
from loopclosure.images.datasets.download import download
from loopclosure.images.datasets.layout import Progress, home_of, missing_parts, sequence_named
from loopclosure.images.datasets.records import Part, dataset_named
from loopclosure.images.datasets.unpack import ARCHIVES, unpack


def fetch_dataset(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    *,
    sequences: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Download and unpack what is missing of a data set; return its folder.

    An interrupted download goes on where it stopped. An archive that was downloaded is deleted once it is unpacked;
    one that lay there already is unpacked and kept.

    Parameters
    ----------
    name : str
        A name of `DATASETS`.
    folder : path, optional
        Where it goes; default in the cache.
    sequences : iterable of str, optional
        Which ones are wanted; default all.
    progress : callable, optional
        Told ``(what, done, total)`` bytes.

    Raises
    ------
    LoopClosureError
        If the data set has no address that can be downloaded, or a part of it cannot be had.
    """
    dataset = dataset_named(name)
    home = home_of(dataset, folder)
    if not dataset.parts:
        where = f"; get it from {dataset.page} and put it into {home}" if dataset.page else ""
        raise LoopClosureError(f"{dataset.title} cannot be downloaded by a program{where}")
    wanted = [sequence_named(dataset, sequence) for sequence in sequences or dataset.sequences]
    for part in missing_parts(dataset, home, wanted):
        _fetch_part(part, home, progress)
    return home


def _fetch_part(part: Part, home: Path, progress: Progress | None) -> None:
    path, limit_bytes = home / part.file, int(part.limit_gb * 1e9)

    def told(verb: str) -> Callable[[int, int], None] | None:
        return partial(progress, f"{verb} {path.name}") if progress else None

    arrived = not path.is_file()
    if arrived:
        download(part.url, path, limit_bytes=limit_bytes, sha256=part.sha256, progress=told("downloading"))
    if path.name.endswith(ARCHIVES):
        unpack(path, path.parent, limit_bytes=limit_bytes, progress=told("unpacking"))
        if arrived:
            path.unlink()
