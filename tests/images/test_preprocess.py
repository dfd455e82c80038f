"""The input of a network against plain-loop readings of the same arithmetic."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image

from loopclosure.errors import ConfigError, ImageError
from loopclosure.images import Preprocessing

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
ROUNDING = 0.501 / 255 / min(STD)  # pixels are rounded to 8 bits once


def noise(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def plain(means):
    """Normalise values of 0..255, one number at a time."""
    height, width, _ = means.shape
    out = np.empty((3, height, width))
    for channel in range(3):
        for row in range(height):
            for column in range(width):
                out[channel, row, column] = (means[row, column, channel] / 255 - MEAN[channel]) / STD[channel]
    return out


def covered(old, new):
    """Share of each old pixel in each new one, (new, old), each row of sum 1."""
    shares = np.zeros((new, old))
    for i in range(new):
        for j in range(old):
            left, right = max(i * old / new, j), min((i + 1) * old / new, j + 1)
            shares[i, j] = max(0.0, right - left) * new / old
    return shares


def interpolated(old, new):
    """Linear weights between the centres of old pixels, (new, old)."""
    weights = np.zeros((new, old))
    for i in range(new):
        centre = min(max((i + 0.5) * old / new - 0.5, 0), old - 1)
        low = min(int(centre), old - 1)
        high = min(low + 1, old - 1)
        weights[i, low] += 1 - (centre - low)
        weights[i, high] += centre - low
    return weights


def resampled(image, height, width):
    rows = (covered if height < image.shape[0] else interpolated)(image.shape[0], height)
    columns = (covered if width < image.shape[1] else interpolated)(image.shape[1], width)
    return np.einsum("ih,hwc,jw->ijc", rows, image, columns)


def test_the_same_size_is_not_resampled():
    image = noise(24, 32)
    out = Preprocessing(24, 32, MEAN, STD)(image)
    assert out.shape == (3, 24, 32)
    assert out.dtype == np.float32
    assert out.flags.c_contiguous
    np.testing.assert_allclose(out, plain(image), atol=1e-6)


def test_whole_factors_are_box_means():
    image = noise(48, 96)
    boxes = np.asarray(Image.fromarray(image).resize((24, 16), Image.Resampling.BOX))
    np.testing.assert_allclose(Preprocessing(16, 24, MEAN, STD)(image), plain(boxes), atol=2 * ROUNDING)
    means = image.reshape(16, 3, 24, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(Preprocessing(16, 24, MEAN, STD)(image), plain(means), atol=ROUNDING)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ((54, 96), (22, 23)),  # both shrink
        ((20, 24), (40, 60)),  # both grow
        ((60, 20), (17, 50)),  # one each way
        ((20, 60), (50, 17)),
        ((20, 60), (20, 17)),  # one stays
        ((60, 20), (60, 33)),
    ],
)
def test_every_axis_is_averaged_or_interpolated(old, new):
    image = noise(*old)
    out = Preprocessing(*new, MEAN, STD)(image)
    # two passes round twice, and OpenCV interpolates with weights of 11 bits
    np.testing.assert_allclose(out, plain(resampled(image, *new)), atol=2.2 * ROUNDING)


@pytest.mark.parametrize("other", [8, 64, 200])
def test_fine_stripes_average_out(other):
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 200
    zero, one = (0.0,) * 3, (1.0,) * 3
    np.testing.assert_allclose(Preprocessing(other, 8, zero, one)(stripes), 100 / 255, atol=1e-6)
    np.testing.assert_allclose(Preprocessing(8, other, zero, one)(stripes.transpose(1, 0, 2)), 100 / 255, atol=1e-6)


def test_a_batch_is_its_images_one_by_one():
    images = [noise(30, 40), noise(60, 50), noise(16, 16)]
    prepare = Preprocessing(20, 24, MEAN, STD)
    batch = prepare.batch(images)
    assert batch.shape == (3, 3, 20, 24)
    for image, row in zip(images, batch, strict=True):
        np.testing.assert_array_equal(row, prepare(image))
    np.testing.assert_array_equal(prepare.batch(np.stack(images[:1] * 2))[1], batch[0])


def test_an_empty_batch():
    out = Preprocessing(20, 24, MEAN, STD).batch([])
    assert out.shape == (0, 3, 20, 24)
    assert out.dtype == np.float32


def test_channels_keep_their_order():
    image = np.zeros((20, 20, 3), np.uint8)
    image[:, :, 0] = 255
    out = Preprocessing(4, 4, (0.0, 0.25, 0.5), (1.0, 0.5, 0.25))(image)
    np.testing.assert_allclose(out[:, 0, 0], [1.0, -0.5, -2.0], atol=1e-6)


def test_the_image_is_not_changed_and_may_be_a_view():
    image = noise(40, 40)
    before = image.copy()
    prepare = Preprocessing(40, 40, MEAN, STD)
    mirrored = prepare(image[:, ::-1])
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(mirrored, prepare(image)[:, :, ::-1])


def test_small_crops_are_legal_here():
    assert Preprocessing(8, 8, MEAN, STD)(noise(1, 3)).shape == (3, 8, 8)


@pytest.mark.parametrize(
    "image", [np.zeros((20, 20), np.uint8), np.zeros((20, 20, 3), np.float32), np.zeros((0, 20, 3), np.uint8)]
)
def test_other_arrays_are_refused(image):
    with pytest.raises(ImageError, match="wanted"):
        Preprocessing(8, 8, MEAN, STD)(image)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"height": 0}, "20x0"),
        ({"mean": (0.5, 0.5)}, "mean"),
        ({"mean": (0.5, 0.5, float("nan"))}, "mean"),
        ({"std": (0.2, 0.2, 0.0)}, "above 0"),
        ({"std": (0.2,) * 4}, "std"),
    ],
)
def test_wrong_settings(change, word):
    with pytest.raises(ConfigError, match=word):
        Preprocessing(**{"height": 20, "width": 20, "mean": MEAN, "std": STD, **change})


def test_it_is_a_value():
    prepare = Preprocessing(20, 24, list(MEAN), list(STD))
    assert prepare == Preprocessing(20, 24, MEAN, STD)
    assert hash(prepare) == hash(Preprocessing(20, 24, MEAN, STD))
    with pytest.raises(dataclasses.FrozenInstanceError):
        prepare.height = 10
