"""What is kept of a view until its local features are wanted: a small grey JPEG, a third of what these would take."""

from __future__ import annotations

import io

import cv2
import numpy as np
from PIL.JpegImagePlugin import JpegImageFile

from loopclosure.errors import ModelError

_QUALITY = 90


def pack_picture(image: np.ndarray, side: int) -> bytes:
    """Return an image as a grey JPEG whose longer side is at most `side` pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w, 3)
        RGB.
    side : int
        Pixels.

    Examples
    --------
    >>> unpack_picture(pack_picture(np.full((480, 640, 3), 200, np.uint8), 400), 400).shape
    (300, 400, 3)
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = side / max(grey.shape)
    if scale < 1:
        size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def unpack_picture(packed: bytes, side: int) -> np.ndarray:
    """Return the picture as RGB, ndarray of uint8 (h, w, 3).

    Raises
    ------
    ModelError
        If the bytes are no JPEG, or of a larger picture.
    """
    try:
        picture = JpegImageFile(io.BytesIO(packed))
        if max(picture.size) > side:
            raise ModelError(f"a kept view of {picture.size} pixels, wanted at most {side}: is the file damaged?")
        return np.asarray(picture.convert("RGB"))
    except (OSError, SyntaxError) as error:
        raise ModelError(f"a kept view is no JPEG ({error}): is the file damaged?") from error
