"""Every form of truth file, written by other libraries; and every way in which such a file can be bad."""

from __future__ import annotations

import os
import pickle
import random
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat
from scipy.sparse import csc_matrix

from loopclosure.errors import LoopClosureError, TruthError
from loopclosure.evaluation import load_truth

PAIRS = {(3, 0), (4, 1), (5, 1), (5, 2)}
MATRIX = np.zeros((6, 6), dtype=np.uint8)
for _pair in PAIRS:
    MATRIX[_pair] = 1


def pairs_of(truth):
    return {(int(i), int(j)) for i, j in zip(*truth.pairs.nonzero(), strict=True)}


def write(path, content):
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content)
    return path


# Matrices


@pytest.mark.parametrize("dtype", ["?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_files_of_every_type(tmp_path, dtype, compressed):
    savemat(tmp_path / "t.mat", {"truth": MATRIX.astype(dtype)}, do_compression=compressed)
    assert pairs_of(load_truth(tmp_path / "t.mat")) == PAIRS


@pytest.mark.parametrize("dtype", [bool, np.float64])
@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_files_with_a_sparse_matrix(tmp_path, dtype, compressed):
    savemat(tmp_path / "t.mat", {"truth": csc_matrix(MATRIX.astype(dtype))}, do_compression=compressed)
    assert pairs_of(load_truth(tmp_path / "t.mat")) == PAIRS


def test_matlab_files_where_the_matrix_is_not_square_keep_their_orientation(tmp_path):
    savemat(tmp_path / "t.mat", {"truth": MATRIX[:, :4]})
    assert pairs_of(load_truth(tmp_path / "t.mat", frames=(6, 4))) == PAIRS


def test_the_only_matrix_is_found_among_other_things(tmp_path):
    others = {"note": "drive", "speed": 3.0, "times": np.arange(6.0), "cell": {"a": MATRIX}, "cube": np.ones((2, 2, 2))}
    savemat(tmp_path / "t.mat", {**others, "z": MATRIX * 1j, "gt": MATRIX}, do_compression=True)
    assert pairs_of(load_truth(tmp_path / "t.mat")) == PAIRS


def test_two_matrices_are_named_and_one_can_be_chosen(tmp_path):
    savemat(tmp_path / "t.mat", {"left": MATRIX, "right": MATRIX.T})
    with pytest.raises(TruthError, match=r"holds 2 matrices \(left, right\): choose one with --key"):
        load_truth(tmp_path / "t.mat")
    assert pairs_of(load_truth(tmp_path / "t.mat", key="right", frames=(6, 6))) == {(j, i) for i, j in PAIRS}
    with pytest.raises(TruthError, match=r"holds no matrix 'rihgt', did you mean 'right'\?"):
        load_truth(tmp_path / "t.mat", key="rihgt")


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "1"])
def test_images_of_every_grey_mode(tmp_path, mode):
    Image.fromarray(MATRIX * 255).convert(mode).save(tmp_path / "t.png")
    assert pairs_of(load_truth(tmp_path / "t.png")) == PAIRS


def test_a_grey_value_in_an_image_means_ignore(tmp_path):
    grey = MATRIX * 255
    grey[4, 0] = 128
    Image.fromarray(grey).save(tmp_path / "t.png")
    truth = load_truth(tmp_path / "t.png")
    assert pairs_of(truth) == PAIRS
    assert list(zip(*truth.ignored.nonzero(), strict=True)) == [(4, 0)]


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((6, 6)), "holds no loop"),
        (np.zeros((0, 6), dtype=np.uint8), "t.npy"),
        (np.ones(6), "array of 1 dimensions"),
        (np.ones((2, 2, 2)), "array of 3 dimensions"),
        (np.random.default_rng(0).random((6, 6)), "36 values other than 0.*matrix of distances"),
        (np.tril(np.full((6, 6), -1)), "holds 1 values other than 0, such as -1"),
        (np.where(MATRIX, np.nan, 0), "such as nan"),
        (np.where(MATRIX, 77, 0), "holds no loop, wanted cells of 1, or 255"),
        (MATRIX * 1j, "cells of type complex128"),
        (MATRIX.astype("U1"), "cells of type <U1"),
        (np.broadcast_to(np.uint8(0), (1, 20_001)), "at most 20000 a side"),
    ],
)
def test_bad_npy_matrices(tmp_path, matrix, message):
    np.save(tmp_path / "t.npy", matrix)
    check_one_line(tmp_path / "t.npy", message)


class Trap:
    sprung = False

    def __reduce__(self):
        return setattr, (Trap, "sprung", True)


def test_pickles_are_refused_and_not_executed(tmp_path):
    np.save(tmp_path / "object.npy", np.array([[Trap(), 0]], dtype=object), allow_pickle=True)
    write(tmp_path / "plain.npy", pickle.dumps(Trap()))
    for name in ("object.npy", "plain.npy"):
        check_one_line(tmp_path / name, "no readable .npy matrix")
    assert not Trap.sprung


def test_an_npy_header_that_promises_more_than_the_file_holds(tmp_path):
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (20000, 20000), }"
    header += b" " * (117 - len(header)) + b"\n"
    write(tmp_path / "t.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + b"\x01" * 100)
    check_one_line(tmp_path / "t.npy", "no readable .npy matrix")


def test_an_npz_with_the_wrong_name(tmp_path):
    np.savez(tmp_path / "t.npz", a=MATRIX, b=MATRIX)
    (tmp_path / "t.npz").rename(tmp_path / "t.npy")
    check_one_line(tmp_path / "t.npy", "several arrays")


def matlab(elements, mark=b"IM"):
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01" + mark + elements


def matlab_matrix(shape, data):
    head = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<IIii", 5, 8, *shape) + struct.pack("<II8s", 1, 5, b"truth")
    body = head + struct.pack("<II", 2, len(data)) + data
    return struct.pack("<II", 14, len(body)) + body


def test_a_big_endian_matlab_file(tmp_path):
    head = struct.pack(">IIII", 6, 8, 12, 0) + struct.pack(">IIii", 5, 8, 6, 6) + struct.pack(">HH4s", 2, 1, b"gt")
    body = head + struct.pack(">II", 5, 144) + MATRIX.T.astype(">i4").tobytes()
    write(tmp_path / "t.mat", matlab(struct.pack(">II", 14, len(body)) + body, mark=b"MI"))
    assert pairs_of(load_truth(tmp_path / "t.mat")) == PAIRS


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no header of version 5, 6 or 7"),
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512),
            r"MATLAB 7.3 \(HDF5\).*save it again in MATLAB, save\(..., '-v7'\)",
        ),
        (b"\x89HDF\r\n\x1a\n".ljust(512), "HDF5"),
        (matlab(b""), "holds no 2-D matrix"),
        (matlab(matlab_matrix((6, 6), b"\x01" * 5)), "no readable MATLAB file: .*reshape"),
        (matlab(matlab_matrix((6, 6), bytes(36))), "holds no loop"),
        (matlab(matlab_matrix((30_000, 30_000), b"\x01")), "matrix of 30000 x 30000 .*at most 20000 a side"),
        (matlab(matlab_matrix((-6, 6), b"\x01")), "empty matrix"),
        (matlab(struct.pack("<II", 15, 10) + b"not packed"), "no readable MATLAB file"),
    ],
)
def test_bad_matlab_files(tmp_path, content, message):
    check_one_line(write(tmp_path / "t.mat", content), message)


@pytest.mark.parametrize(
    ("column_starts", "row", "what"),
    [
        ((0, 2, 1), 0, "columns"),
        ((0, 1, 9), 0, "columns"),
        ((1, 1, 1), 0, "columns"),
        ((0, 1, -1), 0, "columns"),
        ((0, 1, 1), 2, "rows"),
        ((0, 0, 1), -1, "rows"),
    ],
)
def test_sparse_matlab_matrices_that_point_outside(tmp_path, column_starts, row, what):
    parts = [struct.pack("<IIII", 6, 8, 5, 1), struct.pack("<IIii", 5, 8, 2, 2), struct.pack("<II8s", 1, 5, b"truth")]
    parts += [struct.pack("<IIii", 5, 4, row, 0), struct.pack("<IIiiii", 5, 12, *column_starts, 0)]
    parts += [struct.pack("<IId", 9, 8, 1.0)]
    body = b"".join(parts)
    content = matlab(struct.pack("<II", 14, len(body)) + body)
    check_one_line(write(tmp_path / "t.mat", content), f"the {what} of its sparse matrix are damaged")


def test_a_matlab_file_that_unpacks_to_far_more_than_it_says_is_not_unpacked(tmp_path, monkeypatch):
    packer = zlib.compressobj(9)
    packed = packer.compress(matlab_matrix((6, 6), MATRIX.T.tobytes()))
    packed += b"".join(packer.compress(bytes(1 << 20)) for _ in range(32)) + packer.flush()
    path = write(tmp_path / "t.mat", matlab(struct.pack("<II", 15, len(packed)) + packed))
    monkeypatch.setattr("loopclosure.evaluation.matfile.MAX_BYTES", 1 << 20)
    tracemalloc.start()
    try:
        assert pairs_of(load_truth(path)) == PAIRS
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: Image.fromarray(MATRIX).save(path), "holds no loop, wanted cells of 255"),
        (lambda path: Image.linear_gradient("L").save(path), "255 values other than 0.*JPEG"),
        (lambda path: Image.new("RGB", (6, 6), (255, 0, 0)).save(path), "is coloured"),
        (lambda path: Image.new("I;16", (6, 6), 700).save(path), "pixels of mode I;16"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n"), "no readable truth image"),
        (lambda path: path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0"), "no readable truth image"),
        (lambda path: Image.new("1", (12_000, 12_000)).save(path), "decompression bomb"),
    ],
)
def test_bad_images(tmp_path, make, message):
    make(tmp_path / "t.png")
    check_one_line(tmp_path / "t.png", message)


# Text


def test_a_list_of_pairs(tmp_path):
    path = write(tmp_path / "t.csv", "\ufeffquery, match\r\n" + "".join(f"{i},{j}\r\n" for i, j in sorted(PAIRS)))
    assert pairs_of(load_truth(path)) == PAIRS
    assert load_truth(path).n_queries == 6
    assert load_truth(path, frames=(9, 4)).pairs.shape == (9, 4)


POSITIONS = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [20, 0.5, 9], [10, 0.5, 0.1], [0, 0.5, 0.0]])


def kitti(rotation):
    rows = [np.concatenate([rotation, position[:, None]], axis=1).ravel() for position in POSITIONS]
    return "\n".join(" ".join(f"{value:.9e}" for value in row) for row in rows)


@pytest.mark.parametrize(
    ("name", "text", "form"),
    [
        (
            "t.csv",
            "frame,x,y,z,yaw\n" + "\n".join(f"{i},{x},{y},{z},0" for i, (x, y, z) in enumerate(POSITIONS)),
            "csv",
        ),
        (
            "t.txt",
            "# t x y z\n" + "\n".join(f"{i / 7} {x} {y} {z} 0 0 0 1" for i, (x, y, z) in enumerate(POSITIONS)),
            "tum",
        ),
        ("t.txt", kitti(np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2)[0]), "kitti"),
        ("t.txt", "\n".join(f"{i + 1:04}.jpg\t{x} {y} {z} " for i, (x, y, z) in enumerate(POSITIONS)), "named"),
    ],
)
def test_poses_of_every_form_are_one_truth(tmp_path, name, text, form):
    truth = load_truth(write(tmp_path / name, text), radius_m=1)
    assert pairs_of(truth) == {(4, 1), (5, 0)}  # frames 2 and 3 are 9 m apart along the third axis
    assert (truth.form, truth.radius_m) == (f"poses {form}", 1.0)


def test_poses_without_height_and_with_further_columns(tmp_path):
    rows = "\n".join(f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(POSITIONS))
    truth = load_truth(write(tmp_path / "t.csv", "frame,x,y,yaw\n" + rows), radius_m=1)
    assert pairs_of(truth) == {(3, 2), (4, 1), (5, 0)}


def test_a_drive_without_loops_has_poses_but_no_pairs(tmp_path):
    truth = load_truth(write(tmp_path / "t.csv", "frame,x,y\n0,0,0\n1,10,0\n"), radius_m=1)
    assert truth.pairs.nnz == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# only a comment\n\n", "is empty"),
        ("query,match\n", "holds no pair under its header"),
        ("frame,x,y\n", "holds no pose under its header"),
        ("query,match,score,accepted,inliers,reason\n1,0,0.5,true,,\n", "has the header 'query,match,score"),
        ("a,b\n1,2\n", "has the header 'a,b', wanted query,match or frame,x,y"),
        ("query,match\n3,0\n4,1\n3,0\n", "1 pairs more than once, such as 3,0"),
        ("query,match\n3,-1\n", "holds the pair 3,-1, wanted whole positions"),
        ("query,match\n3,0.5\n", "holds the pair 3,0.5, wanted whole positions"),
        ("query,match\n3,nan\n", "holds the pair 3,nan"),
        ("query,match\n3,1e30\n", "holds the pair 3,1e\\+30"),
        ("query,match\n3,zero\n", "could not convert string 'zero'"),
        ("query,match\n3,0\n4\n", "number of columns changed"),
        ("query,match\n3,0,1\n", "has 3 numbers a row, wanted 2"),
        ("frame,x,y\n0,1,1\n1,1\n", "pose 1: 2 cells under 3 columns"),
        ("frame,x,y\n0,1,1\n2,1,1\n", "row 1 is frame 2, wanted 1: one row a frame, in order, from 0"),
        ("frame,x,y\n1,1,1\n0,1,1\n", "row 0 is frame 1, wanted 0"),
        ("frame,x,y\n0,1,1\n1,,1\n", "could not convert string ''"),
        ("frame,x,y\n0,1,1\n1,nan,1\n2,inf,1\n", r"poses of 2 of 3 frames are not finite \(frames 1, 2\)"),
        ("0 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "row 2 has timestamp 1 after 2, wanted rows in order"),
        ("nan 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "wanted rows in order"),
        ("1.jpg 0 0\n3.jpg 0 0\n", "row 1 has frame 3 after 1, wanted every frame, in order"),
        ("a.jpg 0 0\n", "row 0 is 'a.jpg 0 0', wanted 3 columns"),
        ("1.jpg 0 0\n2.jpg 0\n", "row 1 is '2.jpg 0', wanted 3 columns"),
        ("1 2 3 4 5\n", "has 5 columns, wanted"),
    ],
)
def test_bad_text(tmp_path, text, message):
    check_one_line(write(tmp_path / "t.csv", text), message, radius_m=1.0 if "match" not in text else None)


def test_text_that_is_no_text(tmp_path):
    check_one_line(write(tmp_path / "t.csv", b"\xff\xfe\x00"), "is not text")


@pytest.mark.parametrize("radius_m", [None, 0.0, -1.0, float("nan"), float("inf")])
def test_poses_want_a_radius(tmp_path, radius_m):
    path = write(tmp_path / "t.csv", "frame,x,y\n0,0,0\n")
    with pytest.raises(LoopClosureError, match="wanted metres above 0"):
        load_truth(path, radius_m=radius_m)
    with pytest.raises(TruthError, match="poses of one stream; two traverses want pairs or a matrix"):
        load_truth(path, radius_m=1.0, frames=(1, 1))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ((5, None), r"holds query 5, wanted at most 4: does it count from 1\?"),
        ((3, None), r"holds query 5, wanted at most 2: does it hold both cameras"),
        ((6, 2), r"holds match 2, wanted at most 1: does it count from 1\?"),
        ((2, 9), r"holds query 5, wanted at most 1: was it made for other images"),
    ],
)
def test_pairs_out_of_range(tmp_path, frames, message):
    path = write(tmp_path / "t.csv", "query,match\n" + "".join(f"{i},{j}\n" for i, j in PAIRS))
    with pytest.raises(TruthError, match=message):
        load_truth(path, frames=frames)


def test_files_that_are_not_there_or_of_no_known_type(tmp_path):
    check_one_line(tmp_path / "none.csv", "cannot read the truth .*: No such file")
    check_one_line(tmp_path, "cannot read the truth .*: it is not a file")
    os.mkfifo(tmp_path / "pipe.csv")
    check_one_line(tmp_path / "pipe.csv", "it is not a file")
    check_one_line(write(tmp_path / "t.jpg", b""), "is of type '.jpg'.*a JPEG blurs the three values, save a PNG")
    check_one_line(write(tmp_path / "t.pkl", b""), "is of type '.pkl', wanted one of")


def test_files_above_the_limits(tmp_path, monkeypatch):
    path = write(tmp_path / "t.csv", "query,match\n5,0\n5,1\n")
    monkeypatch.setattr("loopclosure.evaluation.limits.MAX_PAIRS", 1)
    check_one_line(path, "holds 2 pairs, wanted at most 1")
    np.save(tmp_path / "t.npy", MATRIX)
    check_one_line(tmp_path / "t.npy", "holds 4 pairs, wanted at most 1")
    check_one_line(write(tmp_path / "p.csv", "frame,x,y\n0,0,0\n1,0,0\n2,0,0\n"), "holds 3 pairs", radius_m=1.0)
    monkeypatch.setattr("loopclosure.evaluation.tables.MAX_TEXT_BYTES", 5)
    check_one_line(path, "it is no list of pairs or poses")
    monkeypatch.setattr("loopclosure.evaluation.limits.MAX_BYTES", -4095)
    check_one_line(path, "it is no truth")


def test_damaged_files_raise_our_error_or_can_be_read(tmp_path):
    savemat(tmp_path / "a.mat", {"truth": MATRIX}, do_compression=True)
    savemat(tmp_path / "b.mat", {"truth": MATRIX})
    savemat(tmp_path / "c.mat", {"truth": csc_matrix(MATRIX.astype(float))})
    np.save(tmp_path / "d.npy", MATRIX)
    Image.fromarray(MATRIX * 255).save(tmp_path / "e.png")
    write(tmp_path / "f.csv", "query,match\n3,0\n4,1\n")
    write(tmp_path / "g.csv", "frame,x,y\n0,0,0\n1,9,0\n2,0,0\n")
    damage, read, refused = random.Random(0), 0, []  # noqa: S311
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        for _ in range(80):
            content = bytearray(whole)
            for _ in range(damage.randint(1, 3)):
                content[damage.randrange(len(content))] = damage.randrange(256)
            if damage.random() < 0.3:
                del content[damage.randrange(len(content)) :]
            path.write_bytes(content)
            try:
                load_truth(path, radius_m=1.0 if path.name == "g.csv" else None)
                read += 1
            except LoopClosureError as error:
                refused.append(str(error))
    assert read > 20
    assert len(refused) > 20
    assert "\n" not in "".join(refused)


def check_one_line(path, message, **settings):
    with pytest.raises(TruthError, match=message) as caught:
        load_truth(path, **settings)
    assert "\n" not in str(caught.value)
