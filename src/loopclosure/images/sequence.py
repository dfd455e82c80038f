"""Many images in order: a folder, a text file of paths, a video."""

from __future__ import annotations

import copy
import logging
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import index
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import cv2

from loopclosure.errors import ConfigError, ImageError
from loopclosure.images.decode import EXTENSIONS, MIN_SIDE, Image, read_image

VIDEO_EXTENSIONS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ogv", ".webm", ".wmv")
LIST_EXTENSIONS = (".txt", ".lst")
MAX_LIST_BYTES = 64 << 20

OnError = Literal["stop", "skip"]
F = TypeVar("F")

_log = logging.getLogger(__name__)


class ImageSequence:
    """The frames of a folder, a text file of paths or a video, in order.

    A folder is read in natural order (``2.jpg`` before ``10.jpg``), without hidden files, other files and sub-folders.
    A text file names one image a line, relative to its own folder; empty lines and lines that start with ``#`` are
    passed over. Iterating yields uint8 (h, w, 3) RGB arrays, any number of times.

    Parameters
    ----------
    source : path
        The folder or file.
    on_error : {"stop", "skip"}
        What an unreadable image does: raise, or yield None, so that its row is kept.
    max_megapixels : float
        A larger image is unreadable; it is refused before it is decoded.

    Attributes
    ----------
    source : pathlib.Path
        As given.
    names : list of str
        The file name, the line of the text file, or ``frame 000012`` of a video.

    Raises
    ------
    ImageError
        If the source is missing, holds no images, or is of a kind that cannot be read; while iterating, for an
        unreadable image when `on_error` is ``stop``.

    Notes
    -----
    The number of frames that a video file announces is often only its duration times its rate. `len` and `names` give
    that number until the video was iterated to its end, and then the frames that were found. Up to one second less
    than announced is taken for such an estimate. A video that ends earlier was cut short: an ImageError, or with
    ``skip`` a logged warning. Where nothing is announced, the frames are counted when the sequence is made.
    """

    def __init__(
        self, source: str | os.PathLike[str], *, on_error: OnError = "stop", max_megapixels: float = 64.0
    ) -> None:
        if on_error not in ("stop", "skip"):
            raise ConfigError(f"on_error = {on_error!r}: wanted 'stop' or 'skip'")
        self.source = Path(source)
        self._frames = _open(self.source, on_error == "skip", max_megapixels)
        self._start = 0

    def reduced(self, height: int, width: int) -> ImageSequence:
        """Return the same frames for a reader who shrinks them to `height` x `width` pixels or more.

        JPEG files are then decoded at a fraction of their size where that is enough, which is several times faster.
        """
        other = copy.copy(self)
        other._frames = self._frames.reduced((height, width))
        return other

    def after(self, count: int) -> ImageSequence:
        """Return the frames without the first `count`; those of a video are passed over, not decoded."""
        other = copy.copy(self)
        other._start += count
        return other

    @property
    def is_video(self) -> bool:
        """Whether frames come one after the other, so that a jump is costly and the length may be an estimate."""
        return isinstance(self._frames, _Video)

    @property
    def names(self) -> list[str]:
        """One name a frame."""
        return self._frames.names[self._start :]

    def __len__(self) -> int:
        """Return the number of frames; of a video see the notes."""
        return max(0, len(self._frames.names) - self._start)

    def __iter__(self) -> Iterator[Image | None]:
        """Start at the first frame."""
        return self._frames.iterate(self._start)

    def __getitem__(self, position: int) -> Image | None:
        """Return frame `position`; None if it is unreadable and `on_error` is ``skip``."""
        return self._frames.read(self._start + range(len(self))[index(position)])

    def __repr__(self) -> str:
        """Name the source and its length."""
        return f"<ImageSequence {self.source}, {len(self)} frames>"


def frames_of(
    source: str | os.PathLike[str] | F, *, on_error: OnError = "stop", max_megapixels: float = 64.0
) -> ImageSequence | F:
    """Return the `ImageSequence` of a path; anything else already holds frames and is returned as it is."""
    if isinstance(source, (str, os.PathLike)):
        return ImageSequence(source, on_error=on_error, max_megapixels=max_megapixels)
    return source


class _Frames(Protocol):
    names: list[str]

    def iterate(self, start: int) -> Iterator[Image | None]: ...

    def read(self, where: int) -> Image | None: ...

    def reduced(self, at_least: tuple[int, int]) -> _Frames: ...


class _Files:
    def __init__(
        self,
        files: Sequence[Path],
        names: list[str],
        skip: bool,
        max_megapixels: float,
        at_least: tuple[int, int] | None = None,
    ) -> None:
        self.names = names
        self._files, self._skip, self._max_megapixels, self._at_least = files, skip, max_megapixels, at_least

    def iterate(self, start: int) -> Iterator[Image | None]:
        return map(self.read, range(start, len(self._files)))

    def read(self, where: int) -> Image | None:
        try:
            return read_image(self._files[where], max_megapixels=self._max_megapixels, at_least=self._at_least)
        except ImageError as error:
            if not self._skip:
                raise
            _log.warning("frame %d is skipped: %s", where, error)
            return None

    def reduced(self, at_least: tuple[int, int]) -> _Files:
        return _Files(self._files, self.names, self._skip, self._max_megapixels, at_least)


class _Video:
    def __init__(self, file: Path, skip: bool, max_megapixels: float) -> None:
        self._file, self._skip = file, skip
        with self._capture() as capture:
            width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            if width * height > max_megapixels * 1e6 or min(width, height) < MIN_SIDE:
                raise ImageError(
                    f"{file} has frames of {width}x{height} pixels, wanted at least {MIN_SIDE} on each side "
                    f"and at most {max_megapixels:g} megapixels (images.max_megapixels)"
                )
            if not capture.grab():
                raise ImageError(f"no frame of {file} can be decoded; is it cut short or its codec unknown here?")
            announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if not 0 < announced <= file.stat().st_size:  # a frame takes at least a byte
                announced = 1
                while capture.grab():
                    announced += 1
            self.names = _frame_names(announced)
            self._slack = min(max(1.0, capture.get(cv2.CAP_PROP_FPS)), 60.0)

    def iterate(self, start: int) -> Iterator[Image | None]:
        with self._capture() as capture:
            found = sum(capture.grab() for _ in range(start))
            while (frame := capture.read()[1]) is not None:
                found += 1
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        missing = len(self.names) - found
        if missing > self._slack:
            message = f"{self._file} ends after {found} of {len(self.names)} frames; was it cut short?"
            if not self._skip:
                raise ImageError(message)
            _log.warning(message)
        self.names = _frame_names(found)

    def read(self, where: int) -> Image | None:
        with self._capture() as capture:
            # Some containers cannot seek or land elsewhere; then the frames before are passed one by one.
            if not capture.set(cv2.CAP_PROP_POS_FRAMES, where) or capture.get(cv2.CAP_PROP_POS_FRAMES) != where:
                capture.open(os.fspath(self._file))
                for _ in range(where):
                    capture.grab()
            frame = capture.read()[1]
        if frame is not None:
            return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        if not self._skip:
            raise ImageError(f"{self._file}: frame {where} cannot be decoded; is the video cut short?")
        return None

    def reduced(self, at_least: tuple[int, int]) -> _Video:  # noqa: ARG002  (a decoder of videos knows one size)
        return self

    @contextmanager
    def _capture(self) -> Iterator[cv2.VideoCapture]:
        capture = cv2.VideoCapture(os.fspath(self._file))
        try:
            if not capture.isOpened():
                raise ImageError(f"{self._file} cannot be opened as a video; is it cut short or no video at all?")
            yield capture
        finally:
            capture.release()


def _frame_names(count: int) -> list[str]:
    return [f"frame {position:06d}" for position in range(count)]


def _open(source: Path, skip: bool, max_megapixels: float) -> _Frames:
    suffix = source.suffix.lower()
    if os.path.isdir(source):  # unlike Path.is_dir, False for what cannot be a name at all
        files = _in_folder(source)
        return _Files(files, [file.name for file in files], skip, max_megapixels)
    if not os.path.isfile(source):
        raise ImageError(f"there is no folder, text file or video {source}")
    if suffix in LIST_EXTENSIONS:
        return _Files(*_in_list(source, skip), skip, max_megapixels)
    if suffix in VIDEO_EXTENSIONS:
        return _Video(source, skip, max_megapixels)
    if suffix in EXTENSIONS:
        raise ImageError(f"{source} is a single image, wanted a sequence; give its folder {source.parent}")
    raise ImageError(
        f"{source} has an unknown ending, wanted a folder of images, a text file of paths "
        f"({' '.join(LIST_EXTENSIONS)}) or a video ({' '.join(VIDEO_EXTENSIONS)})"
    )


def _in_folder(folder: Path) -> list[Path]:
    try:
        visible = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise ImageError(f"cannot list the folder {folder}: {error.strerror or error}") from None
    files = [entry for entry in visible if entry.suffix.lower() in EXTENSIONS and entry.is_file()]
    if files:
        return sorted(files, key=lambda file: natural_key(file.name))
    if visible and all(entry.is_dir() for entry in visible):
        names = ", ".join(sorted(entry.name for entry in visible)[:3])
        raise ImageError(f"{folder} holds only folders ({names} ...), which are not searched; give one of them")
    raise ImageError(f"{folder} holds no images (looked for {' '.join(EXTENSIONS)})")


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key by which numbers inside names count as numbers, and case does not count.

    Examples
    --------
    >>> sorted(["b10.jpg", "B2.jpg", "a.jpg"], key=natural_key)
    ['a.jpg', 'B2.jpg', 'b10.jpg']
    """
    parts = re.split(r"(\d+)", name.casefold())
    return [int(part) if part.isdecimal() else part for part in parts], name


def _in_list(file: Path, skip: bool) -> tuple[list[Path], list[str]]:
    try:
        if file.stat().st_size > MAX_LIST_BYTES:
            raise ImageError(f"{file} is larger than {MAX_LIST_BYTES} bytes: it is no list of paths")
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise ImageError(f"cannot read the list {file}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ImageError(f"{file} is not UTF-8 text, wanted one image path a line") from None
    paths, names = [], []
    for number, line in enumerate(lines, start=1):
        name = line.strip()
        if not name or name.startswith("#"):
            continue
        path = file.parent / name
        if not skip and not os.path.isfile(path):
            raise ImageError(f"{file}, line {number}: there is no image file {str(path)[:300]}")
        paths.append(path)
        names.append(name)
    if not paths:
        raise ImageError(f"{file} names no images, wanted one path a line")
    return paths, names
