"""Decoding at a fraction of the size: when it happens, what it changes, and that nothing else changes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Picture

from loopclosure.images import ImageSequence, Preprocessing, read_image
from loopclosure.images.ahead import in_batches


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    coarse = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    Picture.fromarray(cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)).save(
        tmp_path / "a.jpg", quality=95
    )
    return tmp_path / "a.jpg"


@pytest.mark.parametrize(
    ("at_least", "shape"),
    [
        ((224, 224), (240, 320, 3)),
        ((240, 240), (240, 320, 3)),
        ((241, 64), (480, 640, 3)),
        ((64, 241), (480, 640, 3)),
        ((60, 60), (60, 80, 3)),
        ((32, 32), (60, 80, 3)),
        ((1000, 1000), (480, 640, 3)),
    ],
)
def test_no_smaller_than_asked(photograph: Path, at_least: tuple[int, int], shape: tuple[int, ...]) -> None:
    assert read_image(photograph, at_least=at_least).shape == shape


def test_what_a_network_sees_hardly_changes(photograph: Path) -> None:
    prepare = Preprocessing(224, 224, mean=(0, 0, 0), std=(1 / 255,) * 3)
    whole, reduced = prepare(read_image(photograph)), prepare(read_image(photograph, at_least=(224, 224)))
    assert 0 < np.sqrt(np.mean((whole - reduced) ** 2)) < 2  # of 255 grey levels


def test_turned_images_are_large_enough(photograph: Path) -> None:
    with Picture.open(photograph) as picture:
        exif = picture.getexif()
        exif[0x0112] = 6
        picture.save(photograph.with_name("turned.jpg"), exif=exif)
    assert read_image(photograph.with_name("turned.jpg"), at_least=(320, 200)).shape == (640, 480, 3)


def test_other_formats_are_read_whole(photograph: Path) -> None:
    pixels = read_image(photograph)
    Picture.fromarray(pixels).save(photograph.with_suffix(".png"))
    np.testing.assert_array_equal(read_image(photograph.with_suffix(".png"), at_least=(60, 60)), pixels)


def test_a_sequence_reduced_and_shortened(photograph: Path) -> None:
    photograph.with_name("b.jpg").write_bytes(photograph.read_bytes())
    whole = ImageSequence(photograph.parent)
    reduced = whole.reduced(224, 224)
    assert [image.shape[:2] for image in reduced if image is not None] == [(240, 320)] * 2
    assert whole[0].shape[:2] == (480, 640)
    rest = reduced.after(1)
    assert (len(rest), rest.names, rest[0].shape[:2], rest[-1].shape[:2]) == (1, ["b.jpg"], (240, 320), (240, 320))
    assert len(list(rest)) == 1
    assert (len(whole), len(whole.after(2)), list(whole.after(5))) == (2, 0, [])
    with pytest.raises(IndexError):
        rest[1]


def test_a_video_goes_on_behind_its_first_frames(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for level in range(0, 250, 25):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    video = ImageSequence(tmp_path / "v.avi")
    rest = video.after(4)
    assert len(rest) == 6
    np.testing.assert_array_equal(np.stack(list(rest)), np.stack(list(video))[4:])
    np.testing.assert_array_equal(rest[0], video[4])


@pytest.mark.parametrize(("count", "wanted"), [(0, []), (2, [[0, 1]]), (3, [[0, 1], [2]])])
def test_batches(count: int, wanted: list[list[int]]) -> None:
    assert list(in_batches(range(count), 2)) == wanted


def test_what_came_before_an_error_is_not_lost() -> None:
    def items():
        yield 1
        raise ValueError("here")

    batches = in_batches(items(), 8)
    assert next(batches) == [1]
    with pytest.raises(ValueError, match="here"):
        next(batches)
