"""Thumbnails against plain loops and against the outputs of OpenSeqSLAM."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.fft import dctn

from loopclosure.errors import ConfigError, ImageError
from loopclosure.features.thumbnails import grey_thumbnail, low_frequencies, normalise_patches, thumbnails


def plain_patches(grey: np.ndarray, side: int) -> np.ndarray:
    out = np.zeros(grey.shape)
    for top in range(0, grey.shape[0], side):
        for left in range(0, grey.shape[1], side):
            values = [float(grey[y, x]) for y in range(top, top + side) for x in range(left, left + side)]
            mean = sum(values) / len(values)
            std = math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1))
            for i, value in enumerate(values):
                out[top + i // side, left + i % side] = (value - mean) / std if std else 0
    return out


@pytest.mark.parametrize("side", [2, 4, 8])
def test_patches_equal_a_plain_reading_of_the_formula(side):
    grey = np.random.default_rng(0).integers(0, 256, (3, 8, 16), dtype=np.uint8)
    grey[1, :side, :side] = 7
    expected = np.stack([plain_patches(image, side) for image in grey])
    np.testing.assert_allclose(normalise_patches(grey, side), expected, atol=1e-6)


def test_quantised_patches_round_halves_away_from_zero_around_127():
    # Mean 4, deviation 2: values lie at -1.5, -0.5, 0.5 and 1.5 deviations.
    grey = np.array([[[1, 3, 5, 7], [1, 7, 3, 5], [4, 4, 4, 4], [1, 7, 3, 5]]], np.uint8)
    scale = np.sqrt(((grey[0] - 4.0) ** 2).sum() / 15)
    assert scale == 2
    expected = [[125, 126, 128, 129], [125, 129, 126, 128], [127] * 4, [125, 129, 126, 128]]
    assert normalise_patches(grey, 4, quantise=True)[0].tolist() == expected


def test_a_flat_patch_is_zero_in_both_modes():
    grey = np.full((1, 8, 16), 200, np.uint8)
    grey[0, 0, 0] = 10
    assert not normalise_patches(grey, 8)[0, :, 8:].any()
    quantised = normalise_patches(grey, 8, quantise=True)
    assert not quantised[0, :, 8:].any()
    assert quantised[0, 0, 0] == 127 - 8  # the one dark pixel lies 63 / 8 deviations below the mean


def test_brightness_and_contrast_change_nothing():
    image = np.random.default_rng(1).integers(0, 100, (32, 64, 3), dtype=np.uint8)
    image = np.repeat(np.repeat(image, 4, axis=0), 4, axis=1)
    plain, brighter = thumbnails([image, 2 * image + 30])
    assert np.abs(plain - brighter).mean() < 0.05  # what is left is the rounding of grey values


def test_images_of_all_sizes_give_thumbnails_of_one_size_whatever_the_others_are():
    rng = np.random.default_rng(2)
    images = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in [(40, 70), (1, 1), (5, 300)]]
    both = thumbnails(images, width=24, height=16, patch=4)
    assert both.shape == (3, 16, 24)
    assert both.dtype == np.float32
    for image, thumbnail in zip(images, both, strict=True):
        np.testing.assert_array_equal(thumbnails([image], width=24, height=16, patch=4)[0], thumbnail)


@pytest.mark.parametrize(("quantise", "dtype"), [(True, np.uint8), (False, np.float32)])
def test_no_images_give_no_thumbnails(quantise, dtype):
    nothing = thumbnails([], quantise=quantise)
    assert nothing.shape == (0, 32, 64)
    assert nothing.dtype == dtype


def test_a_reduced_image_keeps_the_mean_of_its_areas():
    image = np.zeros((80, 160, 3), np.uint8)
    image[:, 80:] = 200
    grey = grey_thumbnail(image, width=16, height=8)
    assert grey.shape == (8, 16)
    assert grey[:, :6].max() <= 1  # a Lanczos filter rings at the edge
    assert grey[:, 10:].min() >= 199


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)],
)
def test_what_is_no_rgb_image_is_refused(image):
    with pytest.raises(ImageError, match="wanted uint8"):
        thumbnails([image])


@pytest.mark.parametrize("patch", [0, 1, 7, 64])
def test_thumbnails_that_cannot_be_cut_into_patches_are_refused(patch):
    with pytest.raises(ConfigError, match="patches"):
        thumbnails([], patch=patch)


@pytest.mark.parametrize(
    ("name", "folder", "pair", "side"),
    [
        ("day_left", "gardens_point/day_left", "day_left__day_right", "ref"),
        ("day_right", "gardens_point/day_right", "day_left__day_right", "query"),
        ("corridor_ref", "corridor/ref", "corridor_ref__corridor_query", "ref"),
        ("corridor_query", "corridor/query", "corridor_ref__corridor_query", "query"),
    ],
)
def test_photographs_become_what_openseqslam_was_given_and_what_it_made_of_it(
    data_folder: Path, name, folder, pair, side
):
    with np.load(data_folder / "reference/seqslam_input_64x32.npz") as file:
        given = file[name]
    with np.load(data_folder / f"reference/seqslam_{pair}.npz") as file:
        made = file[f"{side}_patchnorm"].T.reshape(-1, 64, 32).swapaxes(1, 2)
    np.testing.assert_array_equal(normalise_patches(given, quantise=True), made)
    paths = sorted((data_folder / folder).glob("*.jpg"))
    assert len(paths) == len(given)
    for path, grey in list(zip(paths, given, strict=True))[::20]:
        ours = grey_thumbnail(np.asarray(Image.open(path).convert("RGB")))
        # JPEG decoders differ by a level or two here and there.
        assert np.abs(ours.astype(int) - grey).mean() < 0.25


def test_low_frequencies_are_coefficients_of_the_cosine_transform():
    stack = np.random.default_rng(0).normal(size=(2, 8, 12)).astype(np.float32)
    low = [(u, v) for u in range(4) for v in range(4) if 0 < u + v <= 3]
    wanted = []
    for thumbnail in stack:
        corners = [(top, left) for top in (0, 4) for left in (0, 4, 8)]
        blocks = [dctn(thumbnail[top : top + 4, left : left + 4], norm="ortho") for top, left in corners]
        wanted.append([block[u, v] for block in blocks for u, v in low])
    np.testing.assert_allclose(low_frequencies(stack), wanted, atol=1e-5)
    assert low_frequencies(stack[:0]).shape == (0, 54)
