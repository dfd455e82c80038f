"""Pictures: what stands where, and that it can be read."""

from __future__ import annotations

import io
import subprocess
import sys
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from PIL import Image

from loopclosure.errors import TruthError
from loopclosure.evaluation import Reports, average_precision
from loopclosure.evaluation import precision_recall as sweep
from loopclosure.report import Pair, kl_spectrum, png, precision_recall, similarity_matrix, trajectory
from loopclosure.report.style import MARKS

LOOPS = [Pair(25, 5, 0.9, True, True), Pair(30, 3, 0.8, True, False), Pair(33, 13, 0.8, True)]


def value_at(axes, query, match):
    """What the picture says at a place given in frames."""
    x, y = axes.transData.transform((match, query))
    (picture,) = axes.images
    return picture.get_cursor_data(SimpleNamespace(x=x, y=y))


def pixels(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())


def random_curve(seed, total=100):
    rng = np.random.default_rng(seed)
    score = rng.random(80).round(2)
    return sweep(Reports(score, rng.random(80) < score, np.arange(80), np.ones(total, int)))


def test_each_cell_stands_at_its_frames():
    matrix = np.random.default_rng(0).random((7, 11)).astype(np.float32)
    figure = similarity_matrix(matrix)
    figure.canvas.draw()
    found = [[value_at(figure.axes[0], query, match) for match in range(11)] for query in range(7)]
    np.testing.assert_allclose(np.array(found, float), matrix)


@pytest.mark.parametrize("frames", [(801, 500), (1700, 1699), (30, 2000)])
def test_a_cell_of_several_frames_stands_at_all_of_them(frames):
    step = -(-max(frames) // 800)
    shape = tuple(-(-side // step) for side in frames)
    matrix = np.random.default_rng(0).random(shape).astype(np.float32)
    figure = similarity_matrix(matrix, frames=frames)
    figure.canvas.draw()
    for query, match in [(0, 0), (frames[0] - 1, frames[1] - 1), (0, frames[1] - 1), (17, 23), (29, 499)]:
        assert value_at(figure.axes[0], query, match) == pytest.approx(matrix[query // step, match // step])


def test_the_drawn_pixel_has_the_colour_of_its_score():
    matrix = np.zeros((20, 30))
    matrix[4, 22] = 1
    figure = similarity_matrix(matrix)
    drawn = pixels(figure)
    x, y = figure.axes[0].transData.transform((22, 4)).astype(int)
    brightest = (np.array(matplotlib.colormaps["cividis"](1.0)) * 255).round()
    np.testing.assert_allclose(drawn[len(drawn) - 1 - y, x], brightest, atol=2)


def test_distance_is_one_minus_score():
    matrix = np.random.default_rng(0).random((5, 5))
    figure = similarity_matrix(matrix, distance=True)
    figure.canvas.draw()
    assert value_at(figure.axes[0], 3, 1) == pytest.approx(1 - matrix[3, 1])
    assert "distance" in figure.axes[-1].get_ylabel()


def test_truth_stands_beside_the_scores_at_the_same_place(make_truth):
    pairs = {(25, 5), (39, 0), (38, 38 - 20)}
    figure = similarity_matrix(np.zeros((40, 40)), truth=make_truth(sorted(pairs), (40, None)), loops=LOOPS)
    figure.canvas.draw()
    scores, truth = figure.axes[:2]
    assert (truth.get_xlim(), truth.get_ylim()) == (scores.get_xlim(), scores.get_ylim())
    marked = {(q, m) for q in range(40) for m in range(40) if value_at(truth, q, m) == 2}
    assert marked == pairs


def test_loops_are_drawn_over_both_panels_and_marks_differ_in_shape(drive_truth):
    figure = similarity_matrix(np.zeros((40, 40)), truth=drive_truth, loops=LOOPS)
    for axes in figure.axes[:2]:
        drawn = [tuple(place) for marks in axes.collections for place in marks.get_offsets()]
        assert sorted(drawn) == sorted((loop.match, loop.query) for loop in LOOPS)
    assert len({mark.marker for mark in MARKS.values()}) == len(MARKS)
    labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert {"right loop", "wrong loop", "true match"} <= labels


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (2, 2), (3, 500), (500, 3)])
@pytest.mark.parametrize("fill", [np.nan, 0.5])
def test_matrices_of_any_shape_can_be_drawn(shape, fill):
    pixels(similarity_matrix(np.full(shape, fill, np.float32)))


def test_axes_say_what_they_show_and_in_which_unit(drive_truth):
    matrix = similarity_matrix(np.zeros((40, 40)), truth=drive_truth, loops=LOOPS)
    for axes in matrix.axes[:2]:
        assert "(frame)" in axes.get_xlabel()
        assert "(frame)" in axes.get_ylabel()
    assert "score" in matrix.axes[-1].get_ylabel()
    (curve,) = precision_recall({"a": random_curve(0)}).axes
    assert (curve.get_xlabel(), curve.get_ylabel()) == ("recall", "precision")
    (path,) = trajectory(np.zeros((40, 2)), LOOPS).axes
    assert (path.get_xlabel(), path.get_ylabel()) == ("x (m)", "y (m)")
    values, share = kl_spectrum(np.ones(3)).axes
    assert "variance" in values.get_ylabel()
    assert "(%)" in share.get_ylabel()
    assert all("component" in axes.get_xlabel() for axes in (values, share))


def line_named(axes, name):
    return next(line for line in axes.lines if line.get_label().startswith(name))


@pytest.mark.parametrize("seed", range(5))
def test_the_area_under_the_steps_is_average_precision(seed):
    curve = random_curve(seed)
    line = line_named(precision_recall({"kl": curve}).axes[0], "kl")
    assert line.get_drawstyle() == "steps-pre"
    recall, precision = line.get_data()
    area = sum((recall[i] - recall[i - 1]) * precision[i] for i in range(1, len(recall)))
    assert area == pytest.approx(average_precision(curve))


def test_recall_at_full_precision_is_marked():
    score, right = np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, True, False, True])
    (axes,) = precision_recall({"kl": sweep(Reports(score, right, np.arange(4), np.ones(10, int)))}).axes
    assert ([0.2], [1.0]) in [tuple(list(values) for values in line.get_data()) for line in axes.lines]


def test_lines_of_equal_f1_have_that_f1():
    (axes,) = precision_recall({}).axes
    levels = []
    for line in axes.lines:
        recall, precision = line.get_data()
        f1 = 2 * recall * precision / (recall + precision)
        assert np.ptp(f1) < 1e-9
        levels.append(round(f1[0], 6))
    assert [text.get_text() for text in axes.texts] == [f"F1 {level:g}" for level in levels]


def test_curves_differ_in_more_than_colour():
    (axes,) = precision_recall({f"m{i}": random_curve(i) for i in range(12)}, highlight="m3").axes
    lines = [line_named(axes, f"m{i} ") for i in range(12)]
    assert (
        len(
            {
                (
                    line.get_linestyle(),
                    line._unscaled_dash_pattern[1] and tuple(line._unscaled_dash_pattern[1]),
                    line.get_marker(),
                )
                for line in lines
            }
        )
        == 12
    )
    assert max(lines, key=lambda line: line.get_linewidth()) is lines[3]


def test_curves_without_points_and_names_with_formulas_are_drawn():
    nothing = sweep(Reports(np.empty(0), np.empty(0, bool), np.empty(0, int), np.ones(3, int)))
    figure = precision_recall({"none": nothing, r"a $\frac{$ b": random_curve(0)})
    pixels(figure)
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert "undefined" in texts[0]
    assert r"a $\frac{$ b" in texts[1]


def test_the_spectrum_shows_eq_15_and_what_is_kept():
    energies = np.array([5.0, 3.0, 1.0, 1.0, 0.0])
    figure = kl_spectrum(energies, kept=2)
    values, share = figure.axes
    np.testing.assert_allclose(share.lines[0].get_data(), [[1, 2, 3, 4, 5], [50, 80, 90, 100, 100]])
    np.testing.assert_allclose(values.lines[0].get_data(), [[1, 2, 3, 4], [5, 3, 1, 1]])
    assert values.get_yscale() == "log"
    assert all(2 in axes.lines[1].get_xdata() for axes in figure.axes)
    assert "2 of 5 components\n80.0 % of the energy" in [text.get_text() for text in share.texts]


@pytest.mark.parametrize("energies", [np.empty(0), np.zeros(4), np.ones(1)])
def test_a_spectrum_without_signal_is_drawn(energies):
    pixels(kl_spectrum(energies, kept=1))


def test_the_path_is_to_scale_and_loops_join_its_frames(drive_truth):
    poses = np.random.default_rng(0).normal(size=(40, 2)) * 50
    figure = trajectory(poses, LOOPS, drive_truth)
    pixels(figure)
    (axes,) = figure.axes
    assert axes.get_aspect() == 1
    drawn = [collection for collection in axes.collections if isinstance(collection, LineCollection)]
    segments = {tuple(segment.ravel()) for collection in drawn for segment in collection.get_segments()}
    assert segments == {(*poses[loop.query], *poses[loop.match]) for loop in LOOPS}
    dashes = {str(collection.get_linestyle()) for collection in drawn}
    assert len(dashes) == 2  # a wrong loop is dashed


def test_loops_end_on_the_other_traverse():
    here, there = np.zeros((40, 2)), np.ones((20, 2))
    figure = trajectory(here, LOOPS[:1], reference_xy_m=there)
    (lines,) = [item for item in figure.axes[0].collections if isinstance(item, LineCollection)]
    np.testing.assert_array_equal(lines.get_segments()[0], [[0, 0], [1, 1]])


def test_frames_without_pose_leave_a_gap():
    poses = np.arange(80.0).reshape(40, 2)
    poses[[0, 25]] = np.nan
    pixels(trajectory(poses, LOOPS))


@pytest.mark.parametrize("poses", [np.zeros((10, 2)), np.zeros((40, 3)), np.zeros(40)])
def test_poses_of_other_frames_are_refused(poses):
    with pytest.raises(TruthError, match="poses"):
        trajectory(poses, LOOPS)


def test_truth_of_other_frames_is_refused(drive_truth):
    with pytest.raises(TruthError, match="41 poses"):
        trajectory(np.zeros((41, 2)), LOOPS, drive_truth)


def test_no_poses_and_no_loops_are_a_legal_picture():
    pixels(trajectory(np.empty((0, 2)), []))


def test_png_is_a_png():
    with Image.open(io.BytesIO(png(kl_spectrum(np.ones(3))))) as picture:
        assert picture.format == "PNG"
        assert min(picture.size) > 300


def test_drawing_changes_nothing_global():
    code = (
        "import sys, matplotlib; before = matplotlib.rcParams.copy()\n"
        "import numpy as np, loopclosure.report as report\n"
        "report.png(report.similarity_matrix(np.ones((3, 3))))\n"
        "assert matplotlib.rcParams.copy() == before\n"
        "assert not {'matplotlib.pyplot', 'torch'} & set(sys.modules), 'imported'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
