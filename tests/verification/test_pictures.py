"""Pictures that are kept of views, and bytes that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from textures import texture

from loopclosure.errors import ModelError
from loopclosure.verification.pictures import pack_picture, unpack_picture

SIDE = 400


@pytest.mark.parametrize(("width", "height"), [(800, 600), (400, 800)])
def test_a_picture_comes_back_grey_and_small(width, height):
    image = texture(0, height=height, width=width)
    packed = pack_picture(image, 400)
    back = unpack_picture(packed, 400)
    factor = max(width, height) // 400
    grey = image @ [0.299, 0.587, 0.114]
    small = grey.reshape(height // factor, factor, width // factor, factor).mean(axis=(1, 3))
    assert back.shape == (*small.shape, 3)
    assert back.dtype == np.uint8
    assert (back == back[..., :1]).all()
    assert np.abs(back[..., 0] - small).mean() < 2
    assert len(packed) < 0.5 * small.size


def test_a_small_image_is_not_enlarged_and_a_thin_one_does_not_vanish():
    assert unpack_picture(pack_picture(texture(1, height=60, width=80), SIDE), SIDE).shape == (60, 80, 3)
    assert unpack_picture(pack_picture(np.zeros((2, 3000, 3), np.uint8), SIDE), SIDE).shape == (1, SIDE, 3)
    assert unpack_picture(pack_picture(np.zeros((1, 1, 3), np.uint8), SIDE), SIDE).shape == (1, 1, 3)


def resized_header(packed, width, height):
    """The same bytes, but the frame header says another size."""
    start = packed.index(b"\xff\xc0") + 5
    return packed[:start] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + packed[start + 4 :]


def png():
    return cv2.imencode(".png", texture(2))[1].tobytes()


GOOD = pack_picture(texture(2), SIDE)


@pytest.mark.parametrize(
    "packed",
    [b"", b"\xff\xd8", b"no picture at all", png(), GOOD[:10], GOOD[:300], GOOD[: len(GOOD) // 2], GOOD[:-40]],
)
def test_what_is_no_jpeg_is_refused(packed):
    with pytest.raises(ModelError, match=r"no JPEG.*damaged"):
        unpack_picture(packed, SIDE)


@pytest.mark.parametrize(
    "packed",
    [resized_header(GOOD, 401, 300), resized_header(GOOD, 65500, 65500), pack_picture(texture(2, width=500), 500)],
)
def test_a_larger_picture_is_refused(packed):
    with pytest.raises(ModelError, match=r"wanted at most 400.*damaged"):
        unpack_picture(packed, SIDE)


def test_spoilt_bytes_give_a_picture_of_the_size_or_are_refused():
    rng = np.random.default_rng(0)
    good = pack_picture(texture(3, height=45, width=60), SIDE)
    refused = 0
    for _ in range(500):
        spoilt = np.frombuffer(good, np.uint8).copy()
        spoilt[rng.integers(0, len(good), 4)] = rng.integers(0, 256, 4)
        try:
            assert max(unpack_picture(spoilt.tobytes(), SIDE).shape) <= SIDE
        except ModelError:
            refused += 1
    assert 0 < refused < 500
