"""A drive on disk: images, poses, truth."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial import cKDTree

from loopclosure.errors import ImageError
from loopclosure.images.simulator.drive import Drive
from loopclosure.images.simulator.settings import SimulationSettings

_JPEG_QUALITY = 95


def simulate(
    out: str | os.PathLike[str],
    settings: SimulationSettings | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
    image_format: Literal["jpg", "png"] = "jpg",
) -> Path:
    """Render a drive into a folder.

    It writes ``images/000000.jpg`` and on, ``poses.csv`` (``frame,x,y,z,yaw,pitch`` of the camera in metres and
    radians), ``truth.csv`` (``query,match``, see `true_pairs`), ``covered.csv`` (``frame,covered``, the share of the
    image that moving people and cars take) and last ``settings.json``.

    Parameters
    ----------
    out : path
        Made if it is absent; must be empty.
    settings : SimulationSettings or None
        None: the defaults.
    progress : callable or None
        Called with the number of frames that are done and of all frames.
    image_format : {"jpg", "png"}

    Returns
    -------
    pathlib.Path
        The folder.

    Raises
    ------
    ImageError
        If `out` holds something already or cannot be written to, or the format is another one.
    """
    if image_format not in ("jpg", "png"):
        raise ImageError(f"image format '{image_format}' is not known; wanted jpg or png")
    settings = settings or SimulationSettings()
    folder = Path(out)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ImageError(f"{folder} is not an empty folder; a drive wants one of its own, name another or remove it")
    drive = Drive(settings)
    covered = []
    try:
        (folder / "images").mkdir(parents=True)
        for frame in drive:
            _write_image(folder / "images" / f"{frame.index:06d}.{image_format}", frame.image)
            covered.append(frame.covered)
            if progress is not None:
                progress(frame.index + 1, len(drive))
        poses = [drive.pose(index) for index in range(len(drive))]
        rows = ((k, p.x_m, p.y_m, p.z_m, p.yaw_rad, p.pitch_rad) for k, p in enumerate(poses))
        _write_csv(folder / "poses.csv", ("frame", "x", "y", "z", "yaw", "pitch"), rows)
        _write_csv(folder / "truth.csv", ("query", "match"), true_pairs(drive).tolist())
        _write_csv(folder / "covered.csv", ("frame", "covered"), ((k, round(c, 6)) for k, c in enumerate(covered)))
        (folder / "settings.json").write_text(settings.model_dump_json(indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ImageError(f"cannot write the drive into {folder}: {error.strerror or error}") from None
    return folder


def true_pairs(drive: Drive) -> np.ndarray:
    """Return the true matches of a drive, (pairs, 2) of query and match, sorted.

    A match is an earlier frame by at least ``exclude_recent`` frames, at most ``truth_radius_m`` away; where that is
    None the radius reaches two frames along the street, whatever the lateral offset.
    """
    settings = drive.settings
    radius = settings.truth_radius_m or float(np.hypot(2.5 * drive.spacing_m, settings.lateral_offset_m))
    poses = [drive.pose(index) for index in range(len(drive))]
    near = cKDTree([(p.x_m, p.y_m) for p in poses]).query_pairs(radius, output_type="ndarray")
    pairs = np.stack([near.max(axis=1, initial=0), near.min(axis=1, initial=len(drive))], axis=1).astype(np.int64)
    pairs = pairs[pairs[:, 0] - pairs[:, 1] >= settings.exclude_recent]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _write_image(path: Path, image: np.ndarray) -> None:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(path.suffix, bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes())


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
