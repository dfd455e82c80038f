"""Folders, lists and videos that the tests wrote themselves, and reading ahead of the consumer."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from loopclosure.errors import ConfigError, ImageError
from loopclosure.images import ImageSequence, frames_of, read_ahead
from loopclosure.images.sequence import natural_key


def write(path, value, size=(30, 20)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, 0, 0)).save(path)


def values(frames):
    return [None if frame is None else int(frame[0, 0, 0]) for frame in frames]


def refused(source, *parts, **options):
    with pytest.raises(ImageError) as caught:
        list(ImageSequence(source, **options))
    assert "\n" not in str(caught.value)
    for part in parts:
        assert str(part) in str(caught.value)


# Folders


def test_folder_in_natural_order(tmp_path):
    for value, name in enumerate(["1.png", "2.PNG", "3.bmp", "10.png", "100.tif"]):
        write(tmp_path / name, value, size=(30 + value, 20 + value))
    for other in (".hidden.png", "._2.png", "notes.txt", "Thumbs.db"):
        (tmp_path / other).write_text("no image")
    write(tmp_path / "sub" / "4.png", 99)
    (tmp_path / "5.png").mkdir()
    sequence = ImageSequence(tmp_path)
    assert sequence.names == ["1.png", "2.PNG", "3.bmp", "10.png", "100.tif"]
    assert len(sequence) == 5
    assert sequence.source == tmp_path
    assert values(sequence) == values(sequence) == [0, 1, 2, 3, 4]
    assert [frame.shape for frame in sequence] == [(20 + i, 30 + i, 3) for i in range(5)]


def test_random_access(tmp_path):
    for value in range(4):
        write(tmp_path / f"{value}.png", value)
    sequence = ImageSequence(str(tmp_path))
    assert values([sequence[2], sequence[0], sequence[-1], sequence[np.int64(1)]]) == [2, 0, 3, 1]
    for position in (4, -5):
        with pytest.raises(IndexError):
            sequence[position]
    with pytest.raises(TypeError):
        sequence[1:3]


def test_a_folder_with_one_image_is_legal(tmp_path):
    write(tmp_path / "a.png", 7)
    assert values(ImageSequence(tmp_path)) == [7]


def test_folders_without_images(tmp_path):
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "empty", "no images", ".jpg", ".webp")
    write(tmp_path / "nested" / "left" / "a.png", 0)
    refused(tmp_path / "nested", "only folders", "left")
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "notes.txt").write_text("a")
    refused(tmp_path / "text", "no images")


@given(st.lists(st.tuples(st.sampled_from(["", "a", "B"]), st.integers(0, 2000), st.integers(0, 4)), unique=True))
def test_numbers_sort_as_numbers_whatever_their_case_and_zeros(parts):
    names = {f"{text}{number:0{width}d}.jpg": (text.lower(), number) for text, number, width in parts}
    assert [names[name] for name in sorted(names, key=natural_key)] == sorted(names.values())


@given(st.lists(st.text(max_size=8), unique=True), st.randoms(use_true_random=False))
def test_natural_order_does_not_depend_on_the_order_found(names, random):
    shuffled = random.sample(names, len(names))
    assert sorted(names, key=natural_key) == sorted(shuffled, key=natural_key)


# Unreadable frames


def test_an_unreadable_frame_stops(tmp_path):
    write(tmp_path / "1.png", 1)
    (tmp_path / "2.png").write_text("text")
    frames = iter(ImageSequence(tmp_path))
    assert values([next(frames)]) == [1]
    with pytest.raises(ImageError, match=r"2\.png is no JPEG"):
        next(frames)


def test_an_unreadable_frame_keeps_its_row(tmp_path):
    write(tmp_path / "1.png", 1)
    (tmp_path / "2.png").write_text("text")
    write(tmp_path / "3.png", 3)
    write(tmp_path / "4.png", 4, size=(1, 1))
    write(tmp_path / "5.png", 5, size=(100, 100))
    sequence = ImageSequence(tmp_path, on_error="skip", max_megapixels=0.005)
    assert values(sequence) == [1, None, 3, None, None]
    assert sequence[1] is None
    assert len(sequence) == len(sequence.names) == 5


def test_unknown_policy(tmp_path):
    with pytest.raises(ConfigError, match="'stop' or 'skip'"):
        ImageSequence(tmp_path, on_error="ignore")


# Sources that are none


def test_wrong_sources(tmp_path):
    refused(tmp_path / "nowhere", "there is no", "nowhere")
    refused(tmp_path / ("a" * 5000), "there is no")
    write(tmp_path / "images" / "a.png", 0)
    refused(tmp_path / "images" / "a.png", "single image", "give its folder", tmp_path / "images")
    (tmp_path / "a.csv").write_text("a,b\n")
    refused(tmp_path / "a.csv", "unknown ending", ".txt", ".mp4")


# Lists


def test_list_of_paths(tmp_path):
    write(tmp_path / "a" / "10.png", 10)
    write(tmp_path / "a" / "2 b#.png", 2)
    lines = ["\ufeff# a comment", "", "a/10.png  ", "  a/2 b#.png", f"{tmp_path}/a/10.png"]
    (tmp_path / "list.txt").write_bytes("\r\n".join(lines).encode())
    sequence = ImageSequence(tmp_path / "list.txt")
    assert values(sequence) == [10, 2, 10]
    assert sequence.names == ["a/10.png", "a/2 b#.png", f"{tmp_path}/a/10.png"]


def test_list_with_a_missing_file(tmp_path):
    write(tmp_path / "a.png", 1)
    file = tmp_path / "list.txt"
    file.write_text("# head\na.png\n\nb.png\n")
    refused(file, "list.txt, line 4", "b.png")
    assert values(ImageSequence(file, on_error="skip")) == [1, None]
    file.write_text("a\0b\n" + "c" * 100_000)
    refused(file, "line 1")
    assert values(ImageSequence(file, on_error="skip")) == [None, None]


def test_lists_that_are_none(tmp_path):
    file = tmp_path / "list.txt"
    file.write_text("\n# nothing\n")
    refused(file, "names no images")
    file.write_bytes(b"\xff\xfe\x00binary")
    refused(file, "not UTF-8")
    with file.open("wb") as stream:
        stream.truncate(65 << 20)  # sparse
    refused(file, "larger than")


# Videos


def write_video(path, count=30, size=(64, 48), codec="MJPG", rate=5):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, size)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV writes no {codec} into {path.suffix}")
    for value in range(count):
        frame = np.zeros((size[1], size[0], 3), np.uint8)
        frame[:, :, 2] = value * 8  # red, in OpenCV's order
        writer.write(frame)
    writer.release()
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.avi", "MJPG"), ("a.AVI", "MJPG"), ("a.mkv", "MJPG"), ("a.mp4", "mp4v"), ("a.mov", "mp4v")]
)
def test_video(tmp_path, name, codec):
    sequence = ImageSequence(write_video(tmp_path / name, codec=codec))
    assert len(sequence) == 30
    assert sequence.names[12] == "frame 000012"
    frames = list(sequence)
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 for frame in frames)
    means = np.array([frame.mean(axis=(0, 1)) for frame in frames])
    assert np.abs(means[:, 0] - np.arange(30) * 8).max() < 6
    assert means[:, 1:].max() < 6
    assert len(list(sequence)) == len(sequence) == 30
    for position in (17, 3, 29, 0, -2):
        np.testing.assert_array_equal(sequence[position], frames[position])


def announce(path, count):
    """Change the number of frames in the main header and the stream header of an AVI file."""
    data = bytearray(path.read_bytes())
    for chunk, offset in ((b"avih", 24), (b"strh", 40)):
        start = data.index(chunk) + offset
        data[start : start + 4] = count.to_bytes(4, "little")
    path.write_bytes(data)


def cut(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    return path


def test_a_video_that_is_cut_short(tmp_path):
    path = cut(write_video(tmp_path / "a.avi"), 0.5)
    refused(path, "of 30 frames", "cut short?")
    sequence = ImageSequence(path, on_error="skip")
    found = len(list(sequence))
    assert 0 < found < 25
    assert len(sequence) == len(sequence.names) == found
    assert len(list(sequence)) == found


def test_a_frame_behind_the_end_of_the_video(tmp_path):
    path = cut(write_video(tmp_path / "a.avi"), 0.5)
    with pytest.raises(ImageError, match="frame 29 cannot be decoded"):
        ImageSequence(path)[29]
    assert ImageSequence(path, on_error="skip")[29] is None


@pytest.mark.parametrize("announced", [10, 30, 34, 35])
def test_the_frames_found_correct_the_announcement(tmp_path, announced):
    path = write_video(tmp_path / "a.avi", rate=5)
    announce(path, announced)
    sequence = ImageSequence(path)
    assert len(sequence) == announced
    assert len(list(sequence)) == 30
    assert len(sequence) == len(sequence.names) == 30


def test_more_than_a_second_less_than_announced_is_an_error(tmp_path):
    path = write_video(tmp_path / "a.avi", rate=5)
    announce(path, 36)
    refused(path, "ends after 30 of 36 frames")


@pytest.mark.parametrize("announced", [0, 2**31 - 1, 2**32 - 1])
def test_frames_are_counted_where_nothing_credible_is_announced(tmp_path, announced):
    path = write_video(tmp_path / "a.avi")
    announce(path, announced)
    sequence = ImageSequence(path)
    assert len(sequence) == 30
    assert len(list(sequence)) == 30


def test_a_container_that_cannot_seek(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.avi")
    frames = list(ImageSequence(path))
    capture = cv2.VideoCapture

    class Fixed:  # OpenCV's own class does not bear to be derived from
        def __init__(self, *arguments):
            self._capture = capture(*arguments)

        def __getattr__(self, name):
            return getattr(self._capture, name)

        def set(self, key, value):
            return False

    monkeypatch.setattr(cv2, "VideoCapture", Fixed)
    sequence = ImageSequence(path)
    for position in (20, 0, 29):
        np.testing.assert_array_equal(sequence[position], frames[position])


def test_videos_that_are_none(tmp_path):
    (tmp_path / "a.mp4").write_text("text")
    refused(tmp_path / "a.mp4", "a.mp4", "cannot be opened as a video")
    (tmp_path / "b.avi").touch()
    refused(tmp_path / "b.avi", "cannot be opened as a video")
    refused(cut(write_video(tmp_path / "c.mp4", codec="mp4v"), 0.5), "cut short")


def test_size_of_a_video(tmp_path):
    path = write_video(tmp_path / "a.avi")
    refused(path, "64x48", "megapixels", max_megapixels=0.003)
    assert len(ImageSequence(path, max_megapixels=0.004)) == 30


def test_frames_of(tmp_path):
    write(tmp_path / "1.png", 1)
    (tmp_path / "2.png").touch()
    assert values(frames_of(tmp_path, on_error="skip")) == [1, None]
    arrays = [np.zeros((20, 30, 3), np.uint8)]
    assert frames_of(arrays) is arrays


# Reading ahead


def reading_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("read_ahead")]


@pytest.mark.parametrize("depth", [1, 2, 8, 100])
def test_order_and_content_are_kept(depth):
    assert list(read_ahead(iter(range(50)), depth)) == list(range(50))
    assert not reading_threads()


def test_none_and_empty():
    assert list(read_ahead([None, 1, None])) == [None, 1, None]
    assert list(read_ahead([])) == []


def test_it_runs_ahead_by_depth_and_no_further():
    taken = []
    at_depth = threading.Event()

    def source():
        for item in itertools.count():
            taken.append(item)
            if item == 4:
                at_depth.set()
            yield item

    frames = read_ahead(source(), depth=4)
    assert taken == []
    assert next(frames) == 0
    assert at_depth.wait(10)  # items 1 to 4 are made while the consumer holds item 0
    time.sleep(0.05)
    assert taken == [0, 1, 2, 3, 4]
    frames.close()


def test_the_source_runs_in_another_thread():
    names = list(read_ahead(threading.current_thread().name for _ in range(3)))
    assert all(name.startswith("read_ahead") for name in names)


def test_an_exception_comes_at_its_place():
    def source():
        yield 1
        yield 2
        raise ImageError("third")

    items = read_ahead(source(), depth=8)
    assert [next(items), next(items)] == [1, 2]
    with pytest.raises(ImageError, match="third"):
        next(items)
    assert list(items) == []
    assert not reading_threads()


def test_closing_early_ends_the_thread_and_the_source():
    ended = threading.Event()

    def source():
        try:
            yield from itertools.count()
        finally:
            ended.set()

    frames = read_ahead(source())
    assert next(frames) == 0
    assert reading_threads()
    frames.close()
    assert not reading_threads()
    del frames
    assert ended.wait(10)


def test_an_error_of_the_consumer_ends_the_thread():
    def consume():
        for _ in read_ahead(itertools.count()):
            raise ValueError("consumer")

    with pytest.raises(ValueError, match="consumer"):
        consume()
    assert not reading_threads()


INTERRUPTED = """
import os, signal, threading, time
from loopclosure.images.ahead import read_ahead

signal.signal(signal.SIGINT, signal.default_int_handler)
waiting = threading.Event()

def source():
    yield 0
    waiting.wait(10)
    time.sleep(0.2)  # until the consumer waits
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.2)
    yield 1

items = read_ahead(source())
assert next(items) == 0
try:
    waiting.set()
    next(items)
except KeyboardInterrupt:
    print([thread.name for thread in threading.enumerate() if thread.name.startswith("read_ahead")])
"""


def test_interrupt_while_waiting():
    """In a process of its own: a signal to this one would also reach what other tests have loaded."""
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_a_folder_read_ahead(tmp_path):
    for value in range(20):
        write(tmp_path / f"{value}.png", value)
    assert values(read_ahead(ImageSequence(tmp_path))) == list(range(20))
