"""Folding, views, exclusion and tolerance of truth against plain double loops, and facts of published files."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat

from loopclosure.errors import ConfigError, TruthError
from loopclosure.evaluation import load_truth
from loopclosure.evaluation.truth import NEVER

quick = settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
seeds = st.integers(0, 2**32 - 1)


def save(tmp_path, matrix):
    np.save(tmp_path / "truth.npy", matrix)
    return tmp_path / "truth.npy"


def lower_triangle(rng, n, density=0.3):
    matrix = np.tril(rng.random((n, n)) < density, -1)
    matrix[n - 1, 0] = True
    return matrix


@quick
@given(seeds, st.integers(4, 13), st.integers(0, 5), st.sampled_from(["lower", "upper", "symmetric"]))
def test_lower_upper_and_symmetric_are_one_truth(tmp_path, seed, n, exclude, drawn_as):
    lower = lower_triangle(np.random.default_rng(seed), n)
    matrix = {"lower": lower, "upper": lower.T, "symmetric": lower | lower.T | np.eye(n, dtype=bool)}[drawn_as]
    truth = load_truth(save(tmp_path, matrix), frames=(n, None), exclude_recent=exclude)
    wanted = np.zeros((n, n), dtype=bool)
    for query in range(n):
        for match in range(query):
            wanted[query, match] = lower[query, match] and query - match >= exclude
    np.testing.assert_array_equal(truth.pairs.toarray(), wanted)
    assert truth.one_stream
    assert truth.matches_per_query().tolist() == wanted.sum(axis=1).tolist()


@quick
@given(seeds, st.integers(1, 9), st.integers(1, 9))
def test_two_traverses_are_neither_folded_nor_banded(tmp_path, seed, n, m):
    matrix = np.random.default_rng(seed).random((n, m)) < 0.5
    matrix[0, 0] = True
    truth = load_truth(save(tmp_path, matrix), frames=(n, m))
    np.testing.assert_array_equal(truth.pairs.toarray(), matrix)
    assert (truth.n_queries, truth.n_references, truth.one_stream) == (n, m, False)
    assert truth.allows(np.arange(n)[:, None], np.arange(m)).all()


@quick
@given(seeds, st.integers(4, 13), st.sampled_from(["left", "right"]), st.booleans())
def test_a_view_is_every_second_row_and_column(tmp_path, seed, n, view, one_stream):
    matrix = lower_triangle(np.random.default_rng(seed), n)
    first = {"left": 0, "right": 1}[view]
    part = matrix[first::2, first::2]
    references = None if one_stream else len(part)
    truth = load_truth(save(tmp_path, matrix), frames=(len(part), references), view=view)
    np.testing.assert_array_equal(truth.pairs.toarray(), part)
    pairs = tmp_path / "truth.csv"
    pairs.write_text("query,match\n" + "".join(f"{i},{j}\n" for i, j in np.argwhere(matrix)))
    listed = load_truth(pairs, frames=(len(part), references), view=view)
    np.testing.assert_array_equal(listed.pairs.toarray(), part)


@quick
@given(seeds, st.integers(2, 9), st.integers(2, 9))
def test_frames_off_is_the_distance_to_the_nearest_true_match(tmp_path, seed, n, m):
    rng = np.random.default_rng(seed)
    matrix = rng.random((n, m)) < 0.15
    matrix[n - 1, m - 1] = True
    truth = load_truth(save(tmp_path, matrix), frames=(n, m))
    query, match = (axis.ravel() for axis in np.indices((n, m)))
    wanted = [
        min((abs(int(k) - j) for k in np.flatnonzero(matrix[i])), default=NEVER)
        for i, j in zip(query.tolist(), match.tolist(), strict=True)
    ]
    assert truth.frames_off(query, match).tolist() == wanted
    assert truth.frames_off(query[:0], match[:0]).tolist() == []


@quick
@given(seeds, st.integers(4, 10))
def test_ignored_cells_are_folded_too_and_true_cells_win(tmp_path, seed, n):
    rng = np.random.default_rng(seed)
    lower = lower_triangle(rng, n)
    grey = rng.random((n, n)) < 0.3
    truth = load_truth(save(tmp_path, np.where(lower, 255, np.where(grey, 99, 0)).astype(np.uint8)), exclude_recent=2)
    for query in range(n):
        for match in range(n):
            pair = query - match >= 2
            ignored = pair and not lower[query, match] and (grey[query, match] or grey[match, query])
            assert truth.ignored[query, match] == ignored
            assert truth.is_ignored(np.array([query]), np.array([match]))[0] == ignored
            assert truth.pairs[query, match] == (pair and lower[query, match])


@quick
@given(seeds, st.integers(2, 15), st.integers(0, 6), st.integers(1, 6), st.sampled_from([2, 3]), st.booleans())
def test_poses_within_the_radius_are_one_place(tmp_path, seed, n, exclude, radius, dimensions, half):
    rng = np.random.default_rng(seed)
    poses = rng.integers(0, 8, (n, dimensions))  # whole metres, so that distances equal to the radius are met
    lost = rng.random(n) < 0.2
    text = [[("nan" if lost[i] else str(value)) for value in pose] for i, pose in enumerate(poses)]
    path = tmp_path / "poses.csv"
    rows = "".join(f"{i},{','.join(row)}\n" for i, row in enumerate(text))
    path.write_text(("frame,x,y,z\n" if dimensions == 3 else "frame,x,y\n") + rows)
    view = "right" if half else "all"
    kept = np.arange(n)[1::2] if half else np.arange(n)
    truth = load_truth(path, radius_m=radius, exclude_recent=exclude, nan_poses="ignore", view=view)
    for q, query in enumerate(kept):
        for m, match in enumerate(kept):
            pair = q - m >= max(1, exclude)
            unknown = lost[query] or lost[match]
            near = ((poses[query] - poses[match]) ** 2).sum() <= radius**2
            assert truth.pairs[q, m] == (pair and near and not unknown)
            assert truth.ignored[q, m] == (pair and unknown)


def test_a_truth_carries_what_the_protocol_prints(tmp_path):
    path = save(tmp_path, np.eye(6, k=-3, dtype=bool))
    truth = load_truth(path, view="left", exclude_recent=1)
    assert truth.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (truth.form, truth.view, truth.exclude_recent, truth.radius_m) == (".npy", "left", 1, None)


def test_the_band_may_swallow_all_pairs(tmp_path):
    truth = load_truth(save(tmp_path, np.eye(6, k=-3, dtype=bool)), exclude_recent=4)
    assert truth.pairs.nnz == 0
    assert truth.frames_off(np.array([5]), np.array([1])).tolist() == [NEVER]


@pytest.mark.parametrize(
    ("wanted", "cause"),
    [
        ((8, None), "was it made for other images"),
        ((12, 12), "--view left or right"),
        ((48, 48), "for one camera, and the results for both"),
        ((24, 20), "was it made"),
    ],
)
def test_a_square_truth_of_another_size(tmp_path, wanted, cause):
    matrix = np.eye(24, k=-3, dtype=bool)
    with pytest.raises(
        TruthError, match=rf"is 24 x 24 \(queries x references\), the results are {wanted[0]} x .*{cause}"
    ):
        load_truth(save(tmp_path, matrix), frames=wanted)


def test_a_truth_of_two_traverses_that_lies_the_wrong_way_or_is_taken_for_one_stream(tmp_path):
    matrix = np.ones((4, 6), dtype=bool)
    with pytest.raises(TruthError, match=r"is 4 x 6 .*the results are 6 x 4: is it transposed\?"):
        load_truth(save(tmp_path, matrix), frames=(6, 4))
    for frames in ((5, None), None):
        with pytest.raises(TruthError, match="is it the truth of two traverses"):
            load_truth(save(tmp_path, matrix), frames=frames)
    neither = np.zeros((4, 4), dtype=bool)
    neither[3, 0] = neither[0, 2] = True
    with pytest.raises(TruthError, match=r"neither triangular nor symmetric \(1 pairs below the diagonal, 1 above\)"):
        load_truth(save(tmp_path, neither))


@pytest.mark.parametrize(
    ("given_settings", "message"),
    [
        ({"view": "middle"}, "view is 'middle'"),
        ({"exclude_recent": -1}, "exclude_recent is -1"),
        ({"exclude_recent": 3, "frames": (6, 6)}, "no exclusion band between two traverses"),
        ({"nan_poses": "drop"}, "nan_poses is 'drop'"),
        ({"radius_m": 5.0}, "a radius was given, but .* holds no poses"),
        ({"key": "truth"}, "a key was given, but .* is no .mat"),
    ],
)
def test_settings_without_meaning(tmp_path, given_settings, message):
    with pytest.raises(ConfigError, match=message):
        load_truth(save(tmp_path, np.eye(6, k=-3, dtype=bool)), **given_settings)


# Published files


@pytest.mark.parametrize(
    ("name", "key", "frames", "rows", "pairs"),
    [
        ("NewCollegeGroundTruth.mat", "truth", 2146, 853, 14832),
        ("NewCollege_stitched.mat", "truth", 1073, 537, 9318),
        ("city_GT_final.mat", "GT", 1237, 551, 8321),
        ("groundTruth_KITTI00.mat", "groundTruthMatrixKITTI00_ICRA18", 4541, 788, 31922),
        ("groundTruth_KITTI_05.mat", "groundTruthMatrixKITTI05_ICRA18", 2761, 415, 10558),
        ("kitti06GroundTruth.mat", "truth", 1101, 272, 3287),
    ],
)
def test_published_matrices_hold_what_scipy_reads_from_them(data_folder, name, key, frames, rows, pairs):
    path = data_folder / "ground_truth" / name
    truth = load_truth(path, frames=(frames, None))
    original = loadmat(path)[key] > 0
    assert not np.triu(original).any()
    np.testing.assert_array_equal(truth.pairs.toarray(), original)
    assert (truth.n_queries, int((truth.matches_per_query() > 0).sum()), truth.pairs.nnz) == (frames, rows, pairs)


def test_one_camera_of_new_college(data_folder):
    path = data_folder / "ground_truth" / "NewCollegeGroundTruth.mat"
    original = loadmat(path)["truth"] > 0
    for view, first in (("left", 0), ("right", 1)):
        truth = load_truth(path, view=view, frames=(1073, None))
        np.testing.assert_array_equal(truth.pairs.toarray(), original[first::2, first::2])
    with pytest.raises(TruthError, match=r"2146 x 2146 .*results are 1073 x 1073: .*--view left or right"):
        load_truth(path, frames=(1073, None))


def test_pair_list_of_gardens_point(data_folder):
    truth = load_truth(data_folder / "gardens_point" / "truth.csv", frames=(200, 200))
    apart = np.subtract.outer(np.arange(200), np.arange(200))
    np.testing.assert_array_equal(truth.pairs.toarray(), abs(apart) <= 2)


def test_positions_of_new_college(data_folder):
    path = data_folder / "ground_truth" / "NewCollege_coordinates.txt"
    with pytest.raises(TruthError, match=r"162 of 2146 frames are not finite \(frames 1984, 1985, 1986 \.\.\.\)"):
        load_truth(path, radius_m=5)
    truth = load_truth(path, radius_m=5, exclude_recent=100, nan_poses="ignore", frames=(2146, None))
    lines = [line.split() for line in path.read_text().splitlines()]
    x, y = (np.array([float(line[axis]) for line in lines]) for axis in (1, 2))
    near = np.subtract.outer(x, x) ** 2 + np.subtract.outer(y, y) ** 2 <= 25
    wanted = near & (np.subtract.outer(np.arange(2146), np.arange(2146)) >= 100)
    np.testing.assert_array_equal(truth.pairs.toarray(), wanted)
    assert (truth.ignored.sum(axis=1) > 0).sum() == 162
