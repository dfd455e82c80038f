"""LoopDetector beyond `matching.flat_up_to` against the same detector that compares with all places."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopclosure import Config, LoopDetector, Reason
from loopclosure.errors import ModelError
from loopclosure.matching import index, shortlist
from loopclosure.matching.index import PlaceIndex

FLAT = 60
SMALL = {
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 8,
    "sequence.length": 6,
    "sequence.exclude_recent": 40,
    "learning.refit_at": (60, 120),
    "verification.mode": "none",
}
LAP = 260


@pytest.fixture(autouse=True, scope="module")
def _everything_smaller():
    """Let a map of some hundred places be as large as one of a hundred thousand is otherwise."""
    sizes = {"_STEP": 32, "_CODED": 96, "_SURVIVORS": 100, "_BLOCK": 1 << 13, "_LEAST_ROWS": 64}
    with pytest.MonkeyPatch.context() as patch:
        for name, size in sizes.items():
            patch.setattr(index, name, size)
        for name, size in {"_FOUND": 20, "_FOLLOWED": 40, "_SPREAD": 128}.items():
            patch.setattr(shortlist, name, size)
        yield


def config(flat_up_to=FLAT, **settings):
    given = {name.replace("__", "."): value for name, value in settings.items()}
    return Config().with_settings(SMALL | {"matching.flat_up_to": flat_up_to} | given)


def make_lap(frames=LAP, *, offset=0):
    """Views from a camera that moves sideways along a wall of coloured blocks, `offset` pixels away from the track."""
    blocks = np.random.default_rng(0).integers(0, 255, size=(10, 10 + 2 * frames, 3), dtype=np.uint8)
    wall = blocks.repeat(8, axis=0).repeat(8, axis=1)
    return [wall[offset : offset + 64, 16 * i + offset : 16 * i + offset + 64] for i in range(frames)]


@pytest.fixture(scope="module")
def drive():
    """A street, a part of it once more, and three frames that cannot be read."""
    images = [*make_lap(), *make_lap(offset=3)[60:200]]
    return [None if i in (100, 101, LAP + 50) else image for i, image in enumerate(images)]


def gone_through(images, **settings):
    detector = LoopDetector(config(**settings))
    return detector, [(detector.add(image), detector.scores, detector.evidence) for image in images]


@pytest.fixture(scope="module")
def both_ways(drive):
    return gone_through(drive), gone_through(drive, flat_up_to=50_000)


def indexed(detector):
    return not detector._traverse.places.exact


def test_the_loops_are_those_of_the_whole_comparison(both_ways):
    (large, mine), (small, everything) = both_ways
    assert indexed(large)
    assert not indexed(small)
    revisit = list(zip(mine[LAP + 6 :], everything[LAP + 6 :], strict=True))
    assert np.mean([one.match == two.match for (one, *_), (two, *_) in revisit]) >= 0.99
    bar = math.log(small.threshold / (1 - small.threshold))
    clear = [(one, two) for (one, *_), (two, _, found) in revisit if found and abs(found[0].log_odds - bar) > 2]
    assert len(clear) > 40
    assert np.mean([one.accepted == two.accepted for one, two in clear]) >= 0.99
    right = [abs(one.match - (one.query - LAP + 60)) <= 1 for one, *_ in mine if one.accepted]
    assert len(right) > 50
    assert all(right)


def test_scores_are_those_of_the_whole_comparison_where_there_are_any(both_ways):
    (_, mine), (_, everything) = both_ways
    looked_at = []
    for (_, some, _), (_, all_of_them, _) in zip(mine, everything, strict=True):
        assert some.shape == all_of_them.shape
        there = ~np.isnan(some)
        np.testing.assert_allclose(some[there], all_of_them[there], atol=1e-5)
        looked_at.append(there.sum() / max((~np.isnan(all_of_them)).sum(), 1))
    assert np.median(looked_at[LAP:]) < 0.5


def test_what_speaks_for_a_place_is_the_same(both_ways):
    """From the first whole sequence on; before, candidates are chance, and stand now above, now below zero."""
    (_, mine), (_, everything) = both_ways
    pairs = [
        (one, two)
        for (_, _, some), (_, _, all_of_it) in zip(mine[LAP + 6 :], everything[LAP + 6 :], strict=True)
        for one in some[:1]
        for two in all_of_it[:1]
        if one.match == two.match
    ]
    assert len(pairs) > 120
    assert all(one.similarity == pytest.approx(two.similarity, abs=1e-5) and one.run == two.run for one, two in pairs)
    apart = np.array([one.standing - two.standing for one, two in pairs])  # among a hundred places, among all
    assert abs(apart.mean()) < 0.2
    assert apart.std() < 0.7


def test_recent_frames_stay_excluded(both_ways):
    (large, mine), _ = both_ways
    for decision, scores, _ in mine:
        assert np.isnan(scores[max(decision.query - large.config.sequence.exclude_recent + 1, 0) :]).all()
        assert decision.match is None or decision.query - decision.match >= large.config.sequence.exclude_recent


def test_unreadable_frames_have_neither_scores_nor_a_match(both_ways):
    (_, mine), _ = both_ways
    for query in (100, 101, LAP + 50):
        decision, scores, evidence = mine[query]
        assert (decision.match, decision.reason, evidence) == (None, Reason.UNREADABLE, ())
        assert scores.shape == (query,)
        assert np.isnan(scores).all()
    assert mine[LAP + 80][0].accepted


def test_nothing_is_approximate_below_the_limit(drive):
    for flat_up_to in (len(drive), 50_000):
        detector, found = gone_through(drive[:300], flat_up_to=flat_up_to)
        assert not indexed(detector)
    plain = detector.method.new_map(exclude_recent=0)
    super(PlaceIndex, plain).restore(detector._traverse.places.to_arrays())
    assert len(plain) == detector.map_size == 300
    assert np.isfinite(found[-1][1]).sum() == 300 - 1 - 39 - 5  # the frames of the sequence, and those too near


@pytest.mark.parametrize("stop", [45, 110, 250, 330])
def test_saved_and_loaded_it_goes_on_as_if_it_had_never_stopped(drive, both_ways, tmp_path, stop):
    (_, mine), _ = both_ways
    first, _ = gone_through(drive[:stop])
    again = LoopDetector.load(first.save(tmp_path / "saved"))
    for image, (decision, scores, _) in zip(drive[stop:], mine[stop:], strict=True):
        other = again.add(image)
        assert (other.query, other.match, other.reason) == (decision.query, decision.match, decision.reason)
        np.testing.assert_allclose(again.scores, scores, atol=1e-5)


def test_a_detector_saved_before_the_limit_was_lower_goes_on(drive, tmp_path):
    """As those do that were saved when every map was compared with as a whole."""
    stop = LAP + 40
    first, _ = gone_through(drive[:stop], flat_up_to=50_000)
    first.config = first.config.with_settings({"matching.flat_up_to": FLAT})
    again = LoopDetector.load(first.save(tmp_path / "saved"))
    assert indexed(again)
    decisions = [again.add(image) for image in drive[stop:]]
    assert np.isnan(again.scores).sum() > 200
    readable = [one for one in decisions if one.reason is not Reason.UNREADABLE]
    assert np.mean([one.match == one.query - LAP + 60 for one in readable]) > 0.95


@pytest.mark.parametrize("direction", ["forward", "both"])
def test_a_large_reference_is_found_in(direction):
    lap = make_lap(200)
    for images, places in ((make_lap(200, offset=3)[60:120], range(60, 120)), (lap[160:100:-1], range(160, 100, -1))):
        found = {}
        for flat_up_to in (FLAT, 50_000):
            detector = LoopDetector(config(flat_up_to, sequence__direction=direction))
            detector.set_reference(lap)
            assert indexed(detector) == (flat_up_to == FLAT)
            found[flat_up_to] = [detector.add(image) for image in images]
        pairs = list(zip(*found.values(), places, strict=True))[5:]
        if places[0] < places[1] or direction == "both":
            assert np.mean([one.match == two.match for one, two, _ in pairs]) >= 0.98
            assert np.mean([one.accepted == two.accepted for one, two, _ in pairs]) >= 0.95
            assert np.mean([abs(one.match - place) <= 1 for one, _, place in pairs]) >= 0.98
        else:
            assert not any(one.accepted for one, *_ in pairs)


def test_a_street_driven_back_is_found_in_one_stream():
    images = [*make_lap(), *make_lap(offset=3)[200:80:-1]]
    _, mine = gone_through(images, sequence__direction="both")
    _, everything = gone_through(images, sequence__direction="both", flat_up_to=50_000)
    decisions = [(one, two) for (one, *_), (two, *_) in zip(mine[LAP + 8 :], everything[LAP + 8 :], strict=True)]
    assert np.mean([one.match == two.match for one, two in decisions]) >= 0.99
    assert np.mean([one.accepted == two.accepted for one, two in decisions]) >= 0.95
    assert np.mean([abs(one.match - (200 - one.query + LAP)) <= 1 for one, _ in decisions]) > 0.9
    assert sum(one.accepted for one, _ in decisions) > 70


def test_a_map_becomes_a_large_reference(drive):
    detector, _ = gone_through(drive[:LAP], flat_up_to=50_000)
    detector.use_map_as_reference(config())
    assert indexed(detector)
    decisions = [detector.add(image) for image in make_lap(offset=3)[60:110]]
    assert all(abs(one.match - one.query - 60) <= 1 for one in decisions[5:])
    detector.use_map_as_reference(config(50_000))
    assert not indexed(detector)


def test_bytes_of_the_map_are_those_of_vectors_and_codes(both_ways):
    (large, _), (small, _) = both_ways
    places = large._traverse.places
    numbers = len(places.to_arrays()["descriptors"][0])
    coded = len(places) // 32 * 32
    code = -(-numbers // 2 // 2) if numbers % 2 == 0 else -(-numbers // 2)  # four bits for each two, or each one
    assert large.map_bytes - small.map_bytes == coded * code
    assert small._traverse.places.nbytes == 4 * numbers * len(places)


def test_the_limit_is_a_setting_of_the_drive_not_of_the_model(tmp_path):
    detector = LoopDetector(config())
    detector.fit(make_lap(80), source="lap")
    model = detector.save_model(tmp_path / "model")
    assert LoopDetector(config(70), model=model).config.matching.flat_up_to == 70
    with pytest.raises(ModelError, match="clusters"):
        LoopDetector(config(70, aggregation__clusters=4), model=model)


@pytest.mark.parametrize("settings", [{"compression.reading": "sequence"}, {"aggregation.components": 0}])
def test_other_descriptors_are_always_compared_with_all(settings):
    detector = LoopDetector(config().with_settings(settings))
    detector.set_reference(make_lap(130))
    assert not isinstance(detector._traverse.places, PlaceIndex)
    for image in make_lap(20, offset=3):
        detector.add(image)
    assert np.isfinite(detector.scores).sum() >= 130 - 5
