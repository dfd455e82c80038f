"""One image file to pixels: the size is known before anything is decoded, every failure is one line.

Sixteen-bit files keep their high byte (65535 is white), transparent pixels are laid over black, the orientation that
a camera wrote (EXIF) is applied, CMYK and palettes become RGB. Of an animation the first picture is read.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Picture
from PIL import ImageOps
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from loopclosure.errors import ImageError

Image = npt.NDArray[np.uint8]
"""Pixels, uint8 (h, w, 3), RGB."""

EXTENSIONS = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
"""Files that a folder is searched for; upper case counts too."""

MIN_SIDE = 16
"""A smaller image holds no place; it is a damaged file or a placeholder."""

MAX_FILE_BYTES = 1 << 30

# The content decides, not the name. `PIL.Image.open` is not used because it warns and raises by a process-wide limit
# that belongs to the application, and because it would offer the bytes to dozens of decoders nobody asked for.
_FORMATS: dict[bytes, type[ImageFile]] = {
    b"\xff\xd8\xff": JpegImageFile,
    b"\x89PNG\r\n\x1a\n": PngImageFile,
    b"BM": BmpImageFile,
    b"II*\0": TiffImageFile,
    b"MM\0*": TiffImageFile,
    b"RIFF": WebPImageFile,
}
_BITS_PER_SAMPLE = 258  # TIFF tag


def read_image(
    path: str | os.PathLike[str], *, max_megapixels: float = 64.0, at_least: tuple[int, int] | None = None
) -> Image:
    """Read one JPEG, PNG, BMP, TIFF or WebP file.

    Parameters
    ----------
    path : path
        The file; its content decides how it is read, not its name.
    max_megapixels : float
        A larger image is refused by its header, before memory is taken for it.
    at_least : tuple of 2 int, optional
        Height and width, pixels, to which the image is going to be shrunk. A JPEG may then be decoded at a half, a
        quarter or an eighth of its size, each pixel the mean of those it stands for, but no smaller than this.

    Returns
    -------
    uint8 (h, w, 3)
        RGB, contiguous, turned as EXIF says.

    Raises
    ------
    ImageError
        If there is no such file, it is no image, is damaged or cut short, is too large or smaller than 16 pixels on
        a side, or holds numbers without a defined white (32-bit integers, floats).
    """
    file = Path(path)
    try:
        _check_file(file)
        with file.open("rb") as stream, _opened(file, stream) as image:
            _check_size(file, image.width, image.height, max_megapixels)
            if at_least is not None and isinstance(image, JpegImageFile):
                image.draft(None, (max(at_least),) * 2)  # a square, because EXIF may turn it
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            return _rgb(file, image)
    except ImageError:
        raise
    except Exception as error:  # decoders meet hostile bytes with every kind of exception
        cause = "may it be read?" if isinstance(error, PermissionError) else "is the file damaged or cut short?"
        raise ImageError(f"{file} cannot be decoded ({str(error) or type(error).__name__}); {cause}") from error


def check_image(array: Any, *, min_side: int = MIN_SIDE) -> Image:
    """Check pixels that come from outside.

    Parameters
    ----------
    array : uint8 (h, w, 3)
        RGB.
    min_side : int
        Least height and width, pixels.

    Returns
    -------
    uint8 (h, w, 3)
        The same pixels, contiguous.

    Raises
    ------
    ImageError
        For anything else; says what was found.

    Examples
    --------
    >>> check_image(np.zeros((48, 64, 3), np.uint8)).shape
    (48, 64, 3)
    >>> check_image(np.zeros((48, 64), np.uint8))
    Traceback (most recent call last):
    loopclosure.errors.ImageError: found uint8 (48, 64), wanted uint8 (h, w, 3) RGB; for grey repeat the channel thrice
    """
    if not isinstance(array, np.ndarray):
        raise ImageError(f"found {type(array).__name__}, wanted a numpy array uint8 (h, w, 3) RGB")
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
        raise ImageError(f"found {array.dtype} {array.shape}, wanted uint8 (h, w, 3) RGB{_likely_cause(array)}")
    height, width, _ = array.shape
    if min(height, width) < min_side:
        raise ImageError(f"the image is {width}x{height} pixels, wanted at least {min_side} on each side")
    return np.ascontiguousarray(array)


def _likely_cause(array: npt.NDArray[Any]) -> str:
    if array.ndim == 2:
        return "; for grey repeat the channel thrice"
    if array.ndim != 3:
        return "; give one image at a time"
    if array.shape[2] == 4:
        return "; drop the alpha channel"
    if array.shape[2] != 3 and array.shape[0] == 3:
        return "; the channels come last"
    if array.dtype.kind == "f":
        return "; are these values of 0..1 to be multiplied by 255?"
    return ""


def _check_file(file: Path) -> None:
    if file.is_dir():
        raise ImageError(f"{file} is a folder, wanted an image file")
    if not file.is_file():
        raise ImageError(f"there is no image file {file}")
    size = file.stat().st_size
    if size == 0:
        raise ImageError(f"{file} is empty (0 bytes); was the disk full or a copy interrupted?")
    if size > MAX_FILE_BYTES:
        raise ImageError(f"{file} has {size} bytes, more than an image needs; is it a video?")


def _opened(file: Path, stream: IO[bytes]) -> ImageFile:
    start = stream.read(8)
    stream.seek(0)
    for magic, decoder in _FORMATS.items():
        if start.startswith(magic):
            return decoder(stream, os.fspath(file))
    raise ImageError(
        f"{file} is no JPEG, PNG, BMP, TIFF or WebP image, whatever its name says (it starts with {start!r})"
    )


def _check_size(file: Path, width: int, height: int, max_megapixels: float) -> None:
    if width * height > max_megapixels * 1e6:
        raise ImageError(
            f"{file} is {width}x{height} = {width * height / 1e6:.1f} megapixels, "
            f"allowed are {max_megapixels:g} (images.max_megapixels)"
        )
    if min(width, height) < MIN_SIDE:
        raise ImageError(f"{file} is {width}x{height} pixels, wanted at least {MIN_SIDE} on each side")


def _rgb(file: Path, image: ImageFile) -> Image:
    """Convert whatever mode the decoder chose to RGB."""
    pixels: Picture.Image = image
    # Pillow before 10.3 opens 16-bit PNG files in the 32-bit mode "I".
    if image.mode.startswith("I;16") or (image.mode == "I" and isinstance(image, PngImageFile)):
        bits = image.tag_v2[_BITS_PER_SAMPLE][0] if isinstance(image, TiffImageFile) else 16
        pixels = Picture.fromarray((np.asarray(image) >> (bits - 8)).astype(np.uint8))
    elif image.mode in ("I", "F"):
        kind = "floats" if image.mode == "F" else "32-bit or signed integers"
        raise ImageError(f"{file} holds {kind}, for which no white is defined; convert it to 8 or 16 bits")
    if pixels.has_transparency_data:
        black = Picture.new("RGBA", pixels.size, (0, 0, 0, 255))
        pixels = Picture.alpha_composite(black, pixels.convert("RGBA"))
    return np.array(pixels if pixels.mode == "RGB" else pixels.convert("RGB"))
