"""What a heat map promises: where it is hot, the similarity comes from."""

from __future__ import annotations

import re
import sys

import cv2
import numpy as np
import pytest
import torch

from loopclosure import LoopDetector
from loopclosure.config import Config
from loopclosure.errors import ConfigError, FitError, ImageError, ResultsError
from loopclosure.evaluation import read_loops
from loopclosure.images.sequence import ImageSequence
from loopclosure.images.simulator import SimulationSettings, simulate
from loopclosure.report.explain import explain_images, explain_run
from loopclosure.report.heatmaps import DescriptorNetwork, Explainer, View, cluster_shares, cosine, matches
from loopclosure.report.means import window_start
from loopclosure.report.overlays import heat_overlay
from loopclosure.runs import detect_loops

SMALL = {
    "features.height": 64,
    "features.width": 64,
    "compression.reading": "channel",
    "aggregation.clusters": 8,
    "aggregation.components": 0,
    "sequence.length": 1,
}
LAP = 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """60 frames of a street that is driven twice."""
    drive = tmp_path_factory.mktemp("drive") / "drive"
    return simulate(drive, SimulationSettings(frames=2 * LAP, width=160, height=120, spacing_m=3)) / "images"


@pytest.fixture(scope="module")
def images(folder):
    return list(ImageSequence(folder))


def fitted(images, **settings):
    settings = {"compression__reading": "channel"} | settings
    detector = LoopDetector(Config().with_settings({name.replace("__", "."): v for name, v in settings.items()}))
    detector.fit(images, source="test")
    return detector.method


@pytest.fixture(scope="module")
def method(images):
    return fitted(images[:LAP:2], aggregation__clusters=32)


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """One stream, one frame a sequence, so that a score is the similarity of two frames."""
    settings = {**SMALL, "learning.warm_up": 15, "learning.refit_at": "", "sequence.exclude_recent": 15}
    return detect_loops(folder, tmp_path_factory.mktemp("run"), config=Config().with_settings(settings)).folder


@pytest.mark.parametrize(
    "settings",
    [{}, {"compression__whiten": True}, {"compression__energy": 0.9}, {"compression__reading": "none"}],
)
def test_the_network_makes_the_descriptor_of_the_method(images, settings):
    method = fitted(images[:8], features__height=96, features__width=128, aggregation__clusters=8, **settings)
    maps = method.features(images[20:23])
    made = DescriptorNetwork(method)(torch.from_numpy(np.stack(maps)).permute(0, 3, 1, 2)).numpy()
    described = np.stack([method.describe([item]) for item in maps])  # behind NetVLAD stands the layout
    np.testing.assert_allclose(made, described[:, : made.shape[1]], atol=1e-5)


def test_heat_is_what_each_position_adds(images):
    """Against Eq. 19 in plain loops, on images as small as their maps, so that nothing is interpolated."""
    method = fitted(images[:6], features__height=256, features__width=256, aggregation__clusters=4)
    small = [cv2.resize(images[i], (16, 16), interpolation=cv2.INTER_AREA) for i in (3, 4)]
    mean = method.describe(method.features(images[5:6])) * 0.5
    explainer = Explainer(method)
    left, right = (explainer.look(image, mean) for image in small)
    arrays = method.to_arrays()
    centres, weights, bias = (arrays[f"netvlad.{name}"] for name in ("centres", "weights", "bias"))
    codes = (left.maps - arrays["kl.mean"]) @ arrays["kl.basis"].T
    residuals = np.zeros((16, 16, *centres.shape))
    for y in range(16):
        for x in range(16):
            local = codes[y, x] / np.linalg.norm(codes[y, x])
            odds = np.exp(weights @ local + bias - (weights @ local + bias).max())
            for k in range(len(centres)):
                residuals[y, x, k] = odds[k] / odds.sum() * (local - centres[k])
    for k in range(len(centres)):
        residuals[:, :, k] /= np.linalg.norm(residuals[:, :, k].sum((0, 1)))
    adds = np.maximum(residuals.reshape(16, 16, -1) @ right.descriptor, 0)
    adds -= adds.min()
    np.testing.assert_allclose(explainer.heat(left, right), adds / adds.max(), atol=1e-4)


def test_hiding_what_is_hot_costs_more_than_hiding_what_is_cold(images, method):
    maps = method.features(images)
    means = [np.mean([method.describe([item]) for item in lap], axis=0) for lap in (maps[:LAP], maps[LAP:])]
    explainer = Explainer(method)

    def without(image, hidden):
        return np.where(hidden[..., None], image.mean((0, 1)).astype(np.uint8), image)

    for place in range(2, LAP, 4):
        match, query = explainer.look(images[place], means[0]), explainer.look(images[LAP + place], means[1])
        heat = explainer.heat(query, match)
        assert heat.shape == query.image.shape[:2]
        assert 0 <= heat.min() < 0.1
        assert 0.9 < heat.max() <= 1
        order = heat.ravel().argsort().argsort().reshape(heat.shape)
        fifth = heat.size // 5
        hot, cold = (
            cosine(explainer.look(without(query.image, hidden), means[1]), match)
            for hidden in (order >= heat.size - fifth, order < fifth)
        )
        assert hot < cold


def test_a_descriptor_compared_with_itself_gives_its_own_shares(images, method):
    view = Explainer(method).look(images[0])
    assert cosine(view, view) == pytest.approx(1, abs=1e-5)
    shares = view.residuals.sum((0, 1)).ravel()
    np.testing.assert_allclose(shares, method.describe([view.maps])[: shares.size], atol=1e-5)
    assert cluster_shares(view, view).sum() == pytest.approx(1, abs=1e-5)


def test_what_has_not_changed_adds_less(images, method):
    half = images[20].copy()
    half[:, : half.shape[1] // 2] = images[0][:, : half.shape[1] // 2]
    explainer = Explainer(method)
    plain, moved = explainer.look(half), explainer.look(half, before=images[0])
    shares = moved.residuals.sum((0, 1)).ravel()
    described = method.describe(method.features([images[0], half]))
    np.testing.assert_allclose(shares, described[: shares.size], atol=1e-5)
    left = slice(0, half.shape[1] // 2 - 30)
    heats = [explainer.heat(view, view) for view in (plain, moved)]
    assert heats[1][:, left].mean() / heats[1].mean() < 0.7 * heats[0][:, left].mean() / heats[0].mean()


def test_a_blank_image_gives_numbers(method):
    explainer = Explainer(method)
    views = [explainer.look(np.full((40, 60, 3), grey, np.uint8)) for grey in (0, 255)]
    heat = explainer.heat(*views)
    assert np.isfinite(heat).all()
    assert heat.shape == (40, 60)
    matches(*views)


def made_view(rng, rows, columns):
    residuals = rng.normal(size=(rows, columns, 2, 3)).astype(np.float32)
    mean = rng.normal(size=6).astype(np.float32) * 0.1
    centred = residuals.sum((0, 1)).ravel() - mean
    none = np.zeros((rows, columns), np.int64)
    pixel = np.zeros((1, 1, 3), np.uint8)
    return View(pixel, none, none, residuals, none, mean, centred / np.linalg.norm(centred))


def test_matches_are_mutually_best(images):
    rng = np.random.default_rng(0)
    left, right = made_view(rng, 3, 4), made_view(rng, 2, 5)

    def adds(a, b):
        parts = []
        for view, (row, column) in ((left, a), (right, b)):
            whole = view.residuals.sum((0, 1)).ravel() - view.mean
            parts.append((view.residuals[row, column].ravel() - view.mean / view.clusters.size) / np.linalg.norm(whole))
        return parts[0] @ parts[1]

    lefts, rights = list(np.ndindex(3, 4)), list(np.ndindex(2, 5))
    assert sum(adds(a, b) for a in lefts for b in rights) == pytest.approx(cosine(left, right), abs=1e-5)
    wanted = {}
    for a in lefts:
        b = max(rights, key=lambda place: adds(a, place))
        if max(lefts, key=lambda place: adds(place, b)) == a and adds(a, b) > 0:
            wanted[a, b] = adds(a, b)
    found = matches(left, right, most=100)
    assert {(match.left, match.right) for match in found} == set(wanted)
    assert len(found) > 1
    np.testing.assert_allclose([match.share for match in found], sorted(wanted.values(), reverse=True), rtol=1e-4)
    assert matches(left, right, most=1) == found[:1]


def test_an_overlay_is_brighter_where_it_is_hot():
    heat = np.linspace(0, 1, 20)[None].repeat(5, axis=0)
    brightness = heat_overlay(np.full((5, 20, 3), 128, np.uint8), heat).sum(-1, dtype=int)
    assert (np.diff(brightness, axis=1) >= 0).mean() > 0.8
    assert brightness[0, -1] > 1.5 * brightness[0, 0]


def numbers_of(page):
    """Score of the sequence and of the frames alone, of each pair of a page."""
    found = re.findall(r"Score (-?[\d.]+), [\w ]+\. The two frames alone, unwhitened: (-?[\d.]+),", page)
    return np.array(found, float).reshape(-1, 2)


def test_a_run_is_explained_with_the_descriptors_that_it_used(run, tmp_path):
    done = explain_run(run, tmp_path / "out", most=2)
    page = done.page.read_text()
    assert len(done.pictures) == 3 * len(numbers_of(page)) + 1
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in done.pictures)
    assert set(re.findall(r'src="(.{15})', page)) == {"data:image/png;"}
    assert "http:" not in page
    assert "https:" not in page
    log = read_loops(run)
    late = np.flatnonzero(log.match >= 19)  # from there on the mean is known exactly
    assert len(late) > 3
    for query in late[[0, -1]]:
        page = explain_run(run, tmp_path / "out", query=int(query)).page.read_text()
        score, alone = numbers_of(page)[0]
        assert alone == pytest.approx(score, abs=0.0011)


def test_a_run_against_a_reference(folder, tmp_path):
    config = Config().with_settings(SMALL)
    run = detect_loops(folder, tmp_path / "run", reference=folder, config=config)
    page = explain_run(run.folder, tmp_path / "out", most=3).page.read_text()
    assert len(numbers_of(page)) == 3
    np.testing.assert_allclose(*numbers_of(page).T, atol=0.0011)


def test_one_image_and_two_images(folder, tmp_path):
    files = sorted(folder.iterdir())
    settings = {**SMALL, "features.height": 128, "features.width": 128}
    done = explain_images(files[:1], tmp_path, config=Config().with_settings(settings))
    assert [file.name for file in done.pictures] == ["heat_images.png", "clusters_images.png", "spectrum.png"]
    done = explain_images(
        files[:2], tmp_path, config=Config().with_settings(settings | {"compression.reading": "none"})
    )
    assert [file.name for file in done.pictures] == ["heat_images.png", "geometry_images.png", "clusters_images.png"]
    with pytest.raises(ImageError, match="3 images given"):
        explain_images(files[:3], tmp_path)
    with pytest.raises(FitError, match="learned on the images shown"):
        explain_images(files[:1], tmp_path, config=Config().with_settings(SMALL))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"method": "seqslam"}, "'seqslam' has no heat maps"),
        ({"compression.reading": "flat"}, "compression.reading = 'flat'"),
        ({"compression.reading": "sequence"}, "compression.reading = 'sequence'"),
    ],
)
def test_other_descriptors_are_refused(folder, tmp_path, settings, words):
    config = Config().with_settings({**SMALL, **settings})
    with pytest.raises(ConfigError, match=words):
        explain_images(sorted(folder.iterdir())[:1], tmp_path, config=config)


def test_what_is_no_run_is_refused(run, folder, tmp_path):
    with pytest.raises(ResultsError, match=r"holds no run\.json"):
        explain_run(folder, tmp_path)
    with pytest.raises(ResultsError, match=r"frame 2 of .* has no candidate: reason warming_up"):
        explain_run(run, tmp_path, query=2)
    with pytest.raises(ResultsError, match="the run has 60 frames"):
        explain_run(run, tmp_path, query=60)
    (tmp_path / "run.json").write_text('{"config": {}}')
    with pytest.raises(ResultsError, match="damaged"):
        explain_run(tmp_path, tmp_path)


def test_the_missing_package_names_its_extra(method, monkeypatch):
    monkeypatch.setitem(sys.modules, "pytorch_grad_cam", None)
    with pytest.raises(ConfigError, match=r"pip install 'loopclosure\[explain\]'"):
        Explainer(method)


def test_unreadable_frames_do_not_count_among_those_before():
    images = [0, 1, 2, 3, None, None, 6, 7, 8]
    assert [window_start(images, frame, 6) for frame in (0, 2, 6, 7, 8)] == [0, 0, 0, 0, 1]
    assert [window_start(images, frame, 1) for frame in (0, 8)] == [0, 8]
    assert window_start([None, None, 2], 2, 6) == 2
