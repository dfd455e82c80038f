"""Feature maps on disk: each image passes the network once, for all layers at once, however often it is asked for.

Maps lie in blocks of frames, one file a layer. The name of a file is the digest of everything that made it - network,
weights, input size, layer, and the content of the images - so that nothing stale can be read, and a change of one image
costs one block. A file appears when it is whole: an interruption costs the block in the making.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopclosure import __version__
from loopclosure.config import Features
from loopclosure.errors import ConfigError, ImageError, ResultsError
from loopclosure.images.ahead import read_ahead
from loopclosure.images.sequence import LIST_EXTENSIONS, ImageSequence
from loopclosure.runs import RunProgress
from loopclosure.weights import file_sha256, locate, weights_for

if TYPE_CHECKING:
    from loopclosure.features.backbones import Backbone

BLOCK = 32
"""Frames in a file."""
_BATCH = 8


def digest(value: Any) -> str:
    """Return a short name for anything that JSON can hold, the same for the same value.

    Examples
    --------
    >>> digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    True
    """
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


def image_paths(images: ImageSequence) -> list[Path]:
    """Return the file of each frame, absolute.

    Raises
    ------
    ConfigError
        For a video, whose frames are no files.
    """
    if images.source.is_dir():
        return [(images.source / name).absolute() for name in images.names]
    if images.source.suffix.lower() in LIST_EXTENSIONS:
        return [(images.source.parent / name).absolute() for name in images.names]
    raise ConfigError(f"{images.source} is a video, wanted a folder of images or a text file of paths")


class MapCache:
    """The feature maps of a sequence.

    Parameters
    ----------
    folder : path
        Where the blocks lie; made if it is absent.
    images : ImageSequence
        Files, not a video.
    features : Features
        Network, weights and input size; its layer is not looked at.
    layers : tuple of str
        Taps of the network.

    Attributes
    ----------
    identity : dict
        All that made the maps, but the images.
    weights_sha256 : str or None
        Of the file of weights; None for random ones.
    hashes : list of str
        SHA-256 of each image file.
    computed : int
        Frames that passed the network since this object was made.

    Raises
    ------
    ConfigError, WeightsError
        If the network, a layer or the weights cannot be used.
    """

    def __init__(self, folder: Path, images: ImageSequence, features: Features, layers: tuple[str, ...]) -> None:
        self.folder = folder
        self.images = images
        self.layers = layers
        self.computed = 0
        self._features = features
        record = weights_for(features.backbone, features.weights)
        self.weights_sha256 = None if record.random else file_sha256(locate(record))
        self.identity = {
            "backbone": features.backbone,
            "weights": record.name,
            "weights_sha256": self.weights_sha256,
            "input": [features.height, features.width],
            "mean_std": [record.mean, record.std],
            "loopclosure": __version__,
        }
        self.hashes = [file_sha256(path) for path in image_paths(images)]

    def __len__(self) -> int:
        return len(self.hashes)

    @cached_property
    def backbone(self) -> Backbone:
        """The network, tapped at all layers; it is built when it is first needed."""
        from loopclosure.features.backbones import Backbone

        made = self._features
        return Backbone(made.backbone, self.layers, weights=made.weights, height=made.height, width=made.width)

    def fill(self, progress: RunProgress | None = None) -> None:
        """Compute the blocks that are missing, all layers in one pass.

        Raises
        ------
        ResultsError
            If they would not fit onto the disk.
        ImageError
            If an image cannot be read.
        """
        starts = [start for start in range(0, len(self), BLOCK) if self._missing(start)]
        if not starts:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        self._check_space(sum(len(self._frames(start)) for start in starts))
        wanted = [frame for start in starts for frame in self._frames(start)]
        pictures = read_ahead(self.images[frame] for frame in wanted)
        for start in starts:
            block = []
            for frame in self._frames(start):
                picture = next(pictures)
                if picture is None:
                    raise ImageError(f"frame {frame} of {self.images.source} cannot be read; leave it out")
                block.append(picture)
            self._write(start, block)
            self.computed += len(block)
            if progress:
                progress("feature maps", start + len(block), len(self))

    def blocks(self, layer: str) -> Iterator[np.ndarray]:
        """Iterate over the maps of a layer, float32 (at most `BLOCK`, h, w, c)."""
        for start in range(0, len(self), BLOCK):
            yield np.array(self._read(start, layer))

    def take(self, layer: str, frames: Sequence[int]) -> np.ndarray:
        """Return the maps of some frames, in rising order: float32 (n, h, w, c)."""
        parts = []
        for start in range(0, len(self), BLOCK):
            inside = [frame - start for frame in frames if start <= frame < start + BLOCK]
            if inside:
                parts.append(self._read(start, layer)[inside])
        return np.concatenate(parts)

    def frame_bytes(self, layer: str) -> int:
        """Return the bytes of one map."""
        return self._read(0, layer)[0].nbytes

    def _frames(self, start: int) -> range:
        return range(start, min(start + BLOCK, len(self)))

    def _path(self, start: int, layer: str) -> Path:
        made_by = {**self.identity, "layer": layer, "images": [self.hashes[frame] for frame in self._frames(start)]}
        return self.folder / f"{layer}-{digest(made_by)}.npy"

    def _missing(self, start: int) -> bool:
        return not all(self._path(start, layer).is_file() for layer in self.layers)

    def _write(self, start: int, pictures: list[np.ndarray]) -> None:
        batches = [self.backbone.maps(pictures[i : i + _BATCH]) for i in range(0, len(pictures), _BATCH)]
        for layer in self.layers:
            path = self._path(start, layer)
            part = path.with_name(f"{path.name}.part")
            with part.open("wb") as file:
                np.save(file, np.concatenate([batch[layer] for batch in batches]))
            os.replace(part, path)

    def _read(self, start: int, layer: str) -> np.ndarray:
        path = self._path(start, layer)
        try:
            maps = np.load(path, mmap_mode="r")
        except (OSError, EOFError, ValueError) as error:
            raise ResultsError(f"{path} is damaged ({error}); delete it, and it is made anew") from None
        return maps

    def _check_space(self, frames: int) -> None:
        needed = frames * sum(4 * int(np.prod(shape)) for shape in self.backbone.shapes.values())
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise ResultsError(
                f"the feature maps need {needed / 1e9:.1f} GB in {self.folder}, {free / 1e9:.1f} GB are free; "
                "write elsewhere, or name fewer layers"
            )
