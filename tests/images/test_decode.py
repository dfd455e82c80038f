"""Image files and arrays at the door, against pixels that the tests wrote themselves."""

from __future__ import annotations

import struct
import subprocess
import sys
import tracemalloc
import warnings
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from loopclosure.errors import ImageError
from loopclosure.images import check_image, read_image

BLACK = np.zeros((20, 30, 3), np.uint8)


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def refused(path, *parts, **options):
    with pytest.raises(ImageError) as caught:
        read_image(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    for part in (path.name, *parts):
        assert part in message
    return message


@pytest.mark.parametrize("name", ["a.png", "a.PNG", "a.bmp", "a.tif", "a.TIFF", "a.webp"])
def test_lossless_formats_give_the_pixels(tmp_path, pixels, name):
    Image.fromarray(pixels).save(tmp_path / name, lossless=True)
    image = read_image(tmp_path / name)
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert image.flags.writeable


@pytest.mark.parametrize("name", ["a.jpg", "a.JPEG"])
def test_jpeg_is_rgb(tmp_path, name):
    Image.new("RGB", (40, 24), (200, 100, 20)).save(tmp_path / name, quality=95)
    image = read_image(str(tmp_path / name))
    assert image.shape == (24, 40, 3)
    assert np.abs(image.astype(int) - (200, 100, 20)).max() <= 3


def test_the_content_decides_not_the_name(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.jpg", format="PNG")
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), pixels)


def test_grey_is_repeated(tmp_path, pixels):
    Image.fromarray(pixels[:, :, 0]).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.repeat(pixels[:, :, :1], 3, axis=2))


def test_one_bit_is_black_and_white(tmp_path, pixels):
    bits = pixels[:, :, 0] > 127
    Image.fromarray(bits).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 1], bits * np.uint8(255))


@pytest.mark.parametrize("channels", [2, 4])
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_transparent_pixels_lie_over_black(tmp_path, pixels, channels, name):
    alpha = np.random.default_rng(1).integers(0, 256, (20, 30, 1), dtype=np.uint8)
    alpha[0], alpha[1] = 0, 255
    colour = pixels[:, :, : channels - 1]
    Image.fromarray(np.dstack([colour, alpha])).save(tmp_path / name)
    image = read_image(tmp_path / name).astype(float)
    wanted = np.broadcast_to(colour * (alpha / 255.0), pixels.shape)
    assert np.abs(image - wanted).max() <= 1
    np.testing.assert_array_equal(image[0], 0)
    np.testing.assert_array_equal(image[1], np.broadcast_to(colour, pixels.shape)[1])


def test_palette(tmp_path, pixels):
    few = pixels // 128 * 255
    picture = Image.fromarray(few).convert("P", palette=Image.Palette.ADAPTIVE, colors=8)
    picture.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), few)


def test_palette_with_a_transparent_colour(tmp_path):
    picture = Image.new("P", (30, 20), 1)
    picture.putpalette([10, 20, 30, 40, 50, 60])
    picture.paste(0, (0, 0, 15, 20))
    picture.save(tmp_path / "a.png", transparency=0)
    image = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(image[:, :15], BLACK[:, :15])
    np.testing.assert_array_equal(image[:, 15:], BLACK[:, 15:] + np.array([40, 50, 60], np.uint8))


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_scaled_not_clipped(tmp_path, name, channels):
    wide = np.random.default_rng(0).integers(0, 65536, (20, 30, channels), dtype=np.uint16)
    wide[0], wide[1] = 0, 65535
    wide[:, :, 3:] = 65535
    assert cv2.imwrite(str(tmp_path / name), wide)  # in OpenCV's order: blue, green, red, alpha
    wanted = np.broadcast_to(wide[:, :, :3] // 256, (20, 30, 3))[:, :, ::-1]
    np.testing.assert_array_equal(read_image(tmp_path / name), wanted)


@pytest.mark.parametrize("factor", [256, 257])
def test_eight_bits_survive_both_ways_of_widening(tmp_path, pixels, factor):
    wide = pixels[:, :, 0].astype(np.uint16) * factor
    cv2.imwrite(str(tmp_path / "a.png"), wide)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 0], pixels[:, :, 0])


def test_big_endian_sixteen_bit_tiff(tmp_path):
    wide = np.random.default_rng(0).integers(0, 65536, (20, 30), dtype=np.uint16)
    write_tiff(tmp_path / "a.tif", ">", wide.astype(">u2").tobytes(), 30, 20, bits=16)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[:, :, 2], wide // 256)


def test_twelve_bit_tiff(tmp_path):
    values = np.random.default_rng(0).integers(0, 4096, (20, 30))
    pairs = values.reshape(-1, 2)
    packed = np.stack([pairs[:, 0] >> 4, (pairs[:, 0] & 15) << 4 | pairs[:, 1] >> 8, pairs[:, 1] & 255], axis=1)
    write_tiff(tmp_path / "a.tif", "<", packed.astype(np.uint8).tobytes(), 30, 20, bits=12)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[:, :, 0], values // 16)


def test_cmyk(tmp_path):
    Image.new("RGB", (40, 24), (200, 100, 20)).convert("CMYK").save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - (200, 100, 20)).max() <= 4


@pytest.mark.parametrize(("dtype", "word"), [(np.float32, "floats"), (np.int32, "32-bit")])
def test_numbers_without_a_white_are_refused(tmp_path, dtype, word):
    Image.fromarray(np.ones((20, 30), dtype)).save(tmp_path / "a.tif")
    refused(tmp_path / "a.tif", word, "convert it to 8 or 16 bits")


TURNS = {
    1: lambda shown: shown,
    2: np.fliplr,
    3: lambda shown: np.rot90(shown, 2),
    4: np.flipud,
    5: lambda shown: shown.transpose(1, 0, 2),
    6: lambda shown: np.rot90(shown, -1),
    7: lambda shown: np.rot90(shown, 2).transpose(1, 0, 2),
    8: np.rot90,
}


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.tif", "a.jpg"])
def test_exif_orientation(tmp_path, pixels, orientation, name):
    stored = np.kron(pixels[:3, :4], np.ones((8, 8, 1), np.uint8))  # even blocks, which JPEG keeps
    exif = Image.Exif()
    exif[0x0112] = orientation
    options = {"quality": 100, "subsampling": 0} if name == "a.jpg" else {"lossless": True}
    Image.fromarray(stored).save(tmp_path / name, exif=exif, **options)
    image = read_image(tmp_path / name)
    wanted = TURNS[orientation](stored)
    assert image.shape == wanted.shape
    assert np.abs(image.astype(int) - wanted).max() <= (4 if name == "a.jpg" else 0)
    assert image.flags.c_contiguous


def test_exif_orientation_of_sixteen_bits(tmp_path):
    wide = np.arange(20 * 30, dtype=np.uint16).reshape(20, 30) * 100
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(wide).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 0], np.rot90(wide, -1) // 256)


# What is no image


def test_missing_file(tmp_path):
    refused(tmp_path / "a.jpg", "there is no image file")


def test_names_that_no_file_can_have(tmp_path):
    for name in ("a\0b.jpg", "a" * 5000):
        with pytest.raises(ImageError):
            read_image(tmp_path / name)


def test_folder(tmp_path):
    refused(tmp_path, "is a folder")


def test_empty_file(tmp_path):
    (tmp_path / "a.jpg").touch()
    refused(tmp_path / "a.jpg", "is empty")


def test_text_named_jpg(tmp_path):
    (tmp_path / "a.jpg").write_text("version https://example.org/spec\n")
    refused(tmp_path / "a.jpg", "is no JPEG, PNG, BMP, TIFF or WebP image", "version ")


def test_a_file_larger_than_any_image(tmp_path):
    with (tmp_path / "a.bmp").open("wb") as file:
        file.write(b"BM")
        file.truncate(2 << 30)  # sparse
    refused(tmp_path / "a.bmp", "is it a video?")


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.bmp", "a.tif", "a.webp"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_truncated_file(tmp_path, name, share):
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
    refused(tmp_path / name, "cut short?")


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.bmp", "a.tif", "a.webp"])
def test_damaged_bytes_give_an_image_or_our_error(tmp_path, pixels, name):
    Image.fromarray(pixels).save(tmp_path / name)
    whole = np.frombuffer((tmp_path / name).read_bytes(), np.uint8)
    rng = np.random.default_rng(0)
    failures = 0
    for _ in range(60):
        damaged = whole.copy()
        damaged[rng.integers(4, min(len(whole), 400), 6)] = rng.integers(0, 256, 6)
        (tmp_path / name).write_bytes(damaged.tobytes())
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                check_image(read_image(tmp_path / name, max_megapixels=1))
        except ImageError:
            failures += 1
    assert failures > 0


@pytest.mark.parametrize("size", [(1, 1), (15, 100), (100, 15)])
def test_too_small(tmp_path, size):
    Image.new("RGB", size).save(tmp_path / "a.png")
    refused(tmp_path / "a.png", f"{size[0]}x{size[1]} pixels", "at least 16")


def test_smallest(tmp_path):
    Image.new("RGB", (16, 16)).save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png").shape == (16, 16, 3)


# Size before decoding


def test_a_hundred_megapixels_are_refused_by_the_header_alone(tmp_path):
    header = struct.pack(">IIBBBBB", 10_000, 10_000, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", b"these are no pixels"), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(tmp_path / "a.png", "10000x10000 = 100.0 megapixels", "64")
    refused(tmp_path / "a.png", "cut short?", max_megapixels=100)  # allowed, so that only now it is decoded


def test_two_hundred_megapixels_are_refused_without_a_warning(tmp_path):
    for name in ("a.bmp", "a.jpg"):
        Image.new("L", (40, 40)).save(tmp_path / name)
    bmp = bytearray((tmp_path / "a.bmp").read_bytes())
    bmp[18:26] = struct.pack("<ii", 20_000, 10_000)
    (tmp_path / "a.bmp").write_bytes(bmp)
    jpg = bytearray((tmp_path / "a.jpg").read_bytes())
    start = jpg.index(b"\xff\xc0")
    jpg[start + 5 : start + 9] = struct.pack(">HH", 10_000, 20_000)
    (tmp_path / "a.jpg").write_bytes(jpg)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(tmp_path / "a.bmp", "20000x10000")
        refused(tmp_path / "a.jpg", "20000x10000")


MEASURE = """
import resource, sys
from loopclosure.errors import ImageError
from loopclosure.images import read_image
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_image(sys.argv[1])
except ImageError:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_a_hundred_real_megapixels_take_no_memory(tmp_path):
    pytest.importorskip("resource")
    Image.new("L", (10_000, 10_000)).save(tmp_path / "a.png", compress_level=1)
    run = subprocess.run([sys.executable, "-c", MEASURE, tmp_path / "a.png"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) < 20_000  # kilobytes; one plane of the image alone takes 100,000


def test_the_limit_of_pillow_plays_no_part(tmp_path, pixels, monkeypatch):
    Image.fromarray(pixels).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    assert Image.MAX_IMAGE_PIXELS == 100


def test_max_megapixels(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png", max_megapixels=600e-6).shape == pixels.shape
    refused(tmp_path / "a.png", "30x20", max_megapixels=599e-6)


# Arrays


def test_check_image_returns_the_pixels(pixels):
    assert check_image(pixels) is pixels
    mirrored = check_image(pixels[:, ::-1, ::-1])
    assert mirrored.flags.c_contiguous
    np.testing.assert_array_equal(mirrored, pixels[:, ::-1, ::-1])


@pytest.mark.parametrize(
    ("array", "parts"),
    [
        (np.zeros((20, 30), np.uint8), ["uint8 (20, 30)", "grey"]),
        (np.zeros((20, 30, 3), np.float32), ["float32 (20, 30, 3)", "255"]),
        (np.zeros((20, 30, 3), np.uint16), ["uint16 (20, 30, 3)"]),
        (np.zeros((20, 30, 4), np.uint8), ["uint8 (20, 30, 4)", "alpha"]),
        (np.zeros((3, 20, 30), np.uint8), ["uint8 (3, 20, 30)", "channels come last"]),
        (np.zeros((5, 20, 30, 3), np.uint8), ["uint8 (5, 20, 30, 3)", "one image at a time"]),
        (np.zeros((0, 0, 3), np.uint8), ["0x0"]),
        (np.zeros((20, 15, 3), np.uint8), ["15x20", "at least 16"]),
        ([[0, 0, 0]], ["list"]),
        (None, ["NoneType"]),
        (Image.new("RGB", (30, 20)), ["Image"]),
    ],
)
def test_check_image_says_what_was_found(array, parts):
    with pytest.raises(ImageError) as caught:
        check_image(array)
    for part in (*parts, "wanted"):
        assert part in str(caught.value)


def test_check_image_copies_no_pixels(pixels):
    large = np.zeros((1000, 1000, 3), np.uint8)
    tracemalloc.start()
    check_image(large)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


def test_importing_loads_no_torch():
    code = "import sys, loopclosure.images; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def write_tiff(path, order, data, width, height, *, bits):
    """Write one grey strip with the least tags that TIFF asks for."""
    tags = [(256, width), (257, height), (258, bits), (259, 1), (262, 1), (273, 8), (277, 1), (278, height)]
    entries = [struct.pack(f"{order}HHIHH", tag, 3, 1, value, 0) for tag, value in tags]
    entries.append(struct.pack(f"{order}HHII", 279, 4, 1, len(data)))
    start = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8 + len(data))
    end = struct.pack(f"{order}H", len(entries)) + b"".join(entries) + struct.pack(f"{order}I", 0)
    path.write_bytes(start + data + end)
