"""SeqSLAM's matching against plain loops, against OpenSeqSLAM's outputs, and on made-up drives."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.thumbnails import normalise_patches, thumbnails
from loopclosure.matching.correlation import CorrelationMap
from loopclosure.matching.differences import difference_matrix, difference_row, enhance_contrast, enhance_row
from loopclosure.matching.velocities import TrajectorySearch, search, uniqueness


def plain_contrast(row: list[float], radius: int) -> list[float]:
    out = []
    for i, value in enumerate(row):
        near = row[max(i - radius, 0) : i + radius + 1]
        mean = sum(near) / len(near)
        std = math.sqrt(sum((v - mean) ** 2 for v in near) / (len(near) - 1)) if len(near) > 1 else 0
        out.append((value - mean) / std if std else 0.0)
    return out


def plain_search(differences: np.ndarray, ds: int, window: int) -> tuple[list[int], list[float]]:
    """OpenSeqSLAM's search for one query at a time, with infinity appended below the last reference."""
    n_queries, n_references = differences.shape
    matches, ratios = [-1] * n_queries, [math.inf] * n_queries
    for query in range(ds // 2, n_queries - ds // 2):
        scores = []
        for start in range(n_references):
            best = math.inf
            for passed in range(round(0.8 * ds), round(1.2 * ds) + 1):
                total = 0.0
                for i in range(ds + 1):
                    reference = start + i * passed // ds
                    inside = reference < n_references
                    total += differences[query - ds // 2 + i, reference] if inside else math.inf
                best = min(best, total)
            scores.append(best)
        least = scores.index(min(scores))
        others = [s for i, s in enumerate(scores) if abs(i - least) > window // 2]
        if math.isfinite(scores[least]):
            matches[query], ratios[query] = least + ds // 2, scores[least] / min(others, default=math.inf)
    return matches, ratios


def plain_score(rows: list[np.ndarray], reference: int, ds: int) -> float:
    """Best mean difference on the way back from `reference` in the last row."""
    best = math.inf
    for passed in range(round(0.8 * ds), round(1.2 * ds) + 1):
        back = [(len(rows) - 1 - i, reference - i * passed // ds) for i in range(ds + 1)]
        inside = all(0 <= column < len(rows[frame]) for frame, column in back)
        best = min(best, sum(rows[frame][column] for frame, column in back) / (ds + 1) if inside else math.inf)
    return -best


class TestDifferences:
    def test_equal_a_plain_sum_over_the_number_of_references(self):
        rng = np.random.default_rng(0)
        queries, references = rng.normal(size=(3, 4, 6)).astype("f4"), rng.normal(size=(70, 4, 6)).astype("f4")
        expected = [[sum(abs(float(x)) for x in (q - r).ravel()) / 70 for r in references] for q in queries]
        np.testing.assert_allclose(difference_matrix(queries, references), expected, rtol=1e-5)

    def test_bytes_do_not_wrap_round(self):
        low, high = np.zeros((1, 1, 2), np.uint8), np.full((1, 1, 2), 255, np.uint8)
        assert difference_matrix(low, high).item() == difference_matrix(high, low).item() == 510
        assert difference_row(low[0], high).item() == difference_row(high[0], low).item() == 510

    @pytest.mark.parametrize("dtype", [np.uint8, np.float32])
    def test_a_row_is_a_row_of_the_matrix(self, dtype):
        rng = np.random.default_rng(3)
        images = (100 * rng.random(size=(130, 8, 16))).astype(dtype)
        matrix = difference_matrix(images[:2], images)
        rows = [difference_row(query, images) for query in images[:2]]
        np.testing.assert_allclose(rows, matrix, rtol=1e-5, atol=1e-5)
        assert rows[0].dtype == matrix.dtype == np.float32

    @pytest.mark.parametrize(("m", "n"), [(0, 3), (3, 0), (0, 0)])
    def test_nothing_compared_with_something_is_nothing(self, m, n):
        queries, references = np.zeros((m, 2, 4), np.float32), np.zeros((n, 2, 4), np.float32)
        matrix = difference_matrix(queries, references)
        assert matrix.shape == enhance_contrast(matrix).shape == (m, n)
        assert difference_row(np.zeros((2, 4), np.float32), references).shape == (n,)
        assert enhance_row(np.zeros(n)).shape == (n,)
        assert search(matrix)[0].tolist() == [-1] * m

    def test_thumbnails_of_different_sizes_are_refused(self):
        with pytest.raises(ModelError, match=r"\(4, 2\)"):
            difference_matrix(np.zeros((1, 2, 4)), np.zeros((1, 4, 2)))
        with pytest.raises(ModelError, match="made alike"):
            difference_row(np.zeros((2, 4)), np.zeros((1, 2, 8)))


class TestContrast:
    @pytest.mark.parametrize(("n", "radius"), [(40, 5), (40, 2), (7, 5), (1, 5)])
    def test_equals_a_plain_reading(self, n, radius):
        differences = np.random.default_rng(4).uniform(5, 15, (6, n))
        plain = np.array([plain_contrast(row.tolist(), radius) for row in differences])
        np.testing.assert_allclose(enhance_contrast(differences, radius), plain - plain.min(), atol=1e-5)
        bound = 2 * radius / math.sqrt(2 * radius + 1)
        rows = [enhance_row(row, radius) for row in differences]
        np.testing.assert_allclose(rows, (plain + bound) / (2 * bound), atol=1e-5)

    def test_a_row_reaches_its_bounds_and_no_further(self):
        spike = np.ones(21)
        spike[10] = 0
        assert enhance_row(spike)[10] == pytest.approx(0, abs=1e-6)
        assert enhance_row(1 - spike)[10] == pytest.approx(1, abs=1e-6)

    @pytest.mark.parametrize("value", [0.0, 0.1, 7.3])
    def test_equal_differences_have_no_contrast(self, value):
        assert (enhance_row(np.full(30, value)) == 0.5).all()
        assert (enhance_contrast(np.full((2, 30), value)) == 0).all()

    def test_scale_and_offset_of_a_row_do_not_matter(self):
        row = np.random.default_rng(5).uniform(1, 2, 50)
        np.testing.assert_allclose(enhance_row(3 * row + 100), enhance_row(row), atol=1e-5)

    def test_a_neighbourhood_of_one_is_refused(self):
        with pytest.raises(ConfigError, match="radius"):
            enhance_row(np.zeros(3), 0)


class TestSearch:
    @pytest.mark.parametrize(
        ("m", "n", "ds", "window"), [(25, 30, 10, 10), (25, 30, 4, 6), (12, 9, 10, 10), (25, 8, 10, 4), (9, 30, 10, 10)]
    )
    def test_equals_a_plain_reading_of_the_original(self, m, n, ds, window):
        differences = np.random.default_rng(6).uniform(0, 5, (m, n))
        matches, ratios = search(differences, ds=ds, window=window)
        plain_matches, plain_ratios = plain_search(differences, ds, window)
        assert matches.tolist() == plain_matches
        np.testing.assert_allclose(ratios, plain_ratios, rtol=1e-9)

    def test_two_perfect_trajectories_are_not_unique(self):
        matches, ratios = search(np.zeros((11, 40)))
        assert matches[5] == 5
        assert ratios[5] == 1

    def test_an_odd_number_of_steps_is_raised_by_one(self):
        differences = np.random.default_rng(7).uniform(0, 5, (25, 30))
        np.testing.assert_array_equal(search(differences, ds=9)[0], search(differences, ds=10)[0])

    @pytest.mark.parametrize("settings", [{"ds": 0}, {"slowest": 0.0}, {"slowest": 1.3}])
    def test_impossible_trajectories_are_refused(self, settings):
        with pytest.raises(ConfigError, match="slowest <= fastest"):
            TrajectorySearch(**settings)

    @pytest.mark.parametrize("ds", [4, 10])
    @pytest.mark.parametrize("growing", [False, True])
    def test_every_frame_online_equals_a_plain_reading(self, ds, growing):
        rng = np.random.default_rng(8)
        rows = [rng.uniform(0, 1, frame if growing else 33) for frame in range(40)]
        trajectories = TrajectorySearch(ds=ds)
        finite = 0
        for frame, row in enumerate(rows):
            scores = trajectories.push(row)
            assert scores.shape == row.shape
            expected = [plain_score(rows[: frame + 1], j, ds) if frame >= ds else -math.inf for j in range(len(row))]
            np.testing.assert_allclose(np.nan_to_num(scores, nan=-math.inf), expected, rtol=1e-5)
            finite += np.isfinite(scores).sum()
        assert finite > 300

    def test_online_costs_are_the_original_ones_seen_from_the_end(self):
        # A floor from the end and one from the start are mirror images, so both drives run backwards here.
        differences = np.random.default_rng(9).uniform(0, 1, (30, 40))
        matches, _ = search(differences[::-1, ::-1])
        trajectories = TrajectorySearch()
        for frame, row in enumerate(differences):
            scores = trajectories.push(row)
            if frame >= 10:
                mirrored = 39 - (matches[29 - frame + 5] - 5)
                assert np.nanargmax(scores) == mirrored

    def test_a_masked_reference_is_on_no_trajectory(self):
        rows = np.random.default_rng(10).uniform(0, 1, (11, 30))
        rows[5, 20] = np.inf
        trajectories = TrajectorySearch(slowest=1, fastest=1)
        scores = [trajectories.push(row) for row in rows][-1]
        assert np.flatnonzero(np.isnan(scores)).tolist() == [*range(10), 25]

    def test_a_restored_search_goes_on_as_if_it_had_never_stopped(self):
        rng = np.random.default_rng(11)
        rows = [rng.uniform(0, 1, frame) for frame in range(40)]
        whole, first = TrajectorySearch(), TrajectorySearch()
        expected = [whole.push(row) for row in rows]
        for row in rows[:25]:
            first.push(row)
        second = TrajectorySearch().restore(first.to_arrays())
        for row, scores in zip(rows[25:], expected[25:], strict=True):
            np.testing.assert_array_equal(second.push(row), scores)

    @pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0)])
    def test_no_rows_give_no_matches(self, shape):
        matches, ratios = search(np.zeros(shape))
        assert matches.shape == ratios.shape == shape[:1]
        assert TrajectorySearch().push(np.zeros(shape[1])).shape == shape[1:]


class TestUniqueness:
    def test_is_the_ratio_of_the_original_turned_round(self):
        differences = np.random.default_rng(12).uniform(0, 5, (11, 40))
        _, ratios = search(differences)
        trajectories = TrajectorySearch()
        scores = [trajectories.push(row) for row in differences[::-1, ::-1]][-1]
        assert uniqueness(scores, window=10) == pytest.approx(1 - ratios[5], rel=1e-5)

    @pytest.mark.parametrize("scores", [[], [np.nan] * 9, [-0.1, np.nan], [-0.3, -0.1, -0.2], [0.0] * 20])
    def test_nothing_to_compare_with_is_not_unique(self, scores):
        assert uniqueness(np.array(scores), window=10) == 0

    def test_a_perfect_match_among_others_is_fully_unique(self):
        assert uniqueness(np.array([0, -1.0, -2.0]), window=0) == 1


class TestDrives:
    """A long made-up wall that a camera passes, once as a reference, then again under other light and speed."""

    def drive(self, speed: float, frames: int, *, gain: float = 1, offset: float = 0) -> np.ndarray:
        wall = gaussian_filter(np.random.default_rng(13).normal(size=(32, 1100)), 5)
        wall = 100 * (wall - wall.min()) / np.ptp(wall)
        views = [wall[:, round(8 * speed * i) :][:, :64] for i in range(frames)]
        return thumbnails([np.repeat((gain * v + offset).astype(np.uint8)[..., None], 3, axis=2) for v in views])

    @pytest.mark.parametrize("speed", [0.8, 0.9, 1.0, 1.1, 1.2])
    def test_finds_the_diagonal_under_other_light_and_at_other_speeds(self, speed):
        references = self.drive(1, 120)
        queries = self.drive(speed, 90, gain=1.5, offset=60)
        expected = speed * np.arange(90)
        matches, _ = search(enhance_contrast(difference_matrix(queries, references)))
        # The match is the start plus half of the steps: a drive at another speed is off by up to one frame more.
        right = np.abs(matches - expected)[5:85] <= (0 if speed == 1 else 2)
        assert right.mean() > 0.97

    @pytest.mark.parametrize(("correlated", "share"), [(False, 0.97), (True, 1)])
    @pytest.mark.parametrize("speed", [0.8, 0.9, 1.0, 1.1, 1.2])
    def test_online_too(self, speed, correlated, share):
        references = self.drive(1, 120)
        places = CorrelationMap()
        for reference in references:
            places.add(reference)
        trajectories = TrajectorySearch()
        right = []
        for frame, query in enumerate(self.drive(speed, 90, gain=1.5, offset=60)):
            row = -places.similarities(query) if correlated else enhance_row(difference_row(query, references))
            scores = trajectories.push(row)
            if frame >= 13:  # even a drive at 0.8 of the speed has a whole trajectory behind it
                right.append(abs(np.nanargmax(scores) - speed * frame) < (0.5 if speed == 1 else 1.5))
        assert np.mean(right) >= share

    def test_finds_the_second_lap_of_one_stream(self):
        lap = self.drive(1, 60)
        places, trajectories = CorrelationMap(exclude_recent=30), TrajectorySearch()
        for frame, query in enumerate([*lap, *lap]):
            scores = trajectories.push(-places.similarities(query))
            places.add(query)
            if frame >= 71:
                assert np.nanargmax(scores) == frame - 60


@pytest.mark.parametrize(("reference", "query"), [("day_left", "day_right"), ("corridor_ref", "corridor_query")])
def test_gives_the_outputs_of_openseqslam_on_real_photographs(data_folder: Path, reference, query):
    with np.load(data_folder / "reference/seqslam_input_64x32.npz") as file:
        references, queries = (normalise_patches(file[name], quantise=True) for name in (reference, query))
    with np.load(data_folder / f"reference/seqslam_{reference}__{query}.npz") as file:
        original = {name: file[name] for name in ("D", "DD", "match_0based", "score")}
    differences = difference_matrix(queries, references)
    np.testing.assert_allclose(differences, original["D"].T, rtol=1e-6)
    contrast = enhance_contrast(differences)
    np.testing.assert_allclose(contrast, original["DD"].T, rtol=1e-4, atol=1e-4)
    matches, ratios = search(contrast)
    np.testing.assert_array_equal(matches, np.nan_to_num(original["match_0based"], nan=-1))
    np.testing.assert_allclose(ratios, np.nan_to_num(original["score"], nan=np.inf), rtol=1e-5)
