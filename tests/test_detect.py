"""LoopDetector: online equals batch, learning from the drive, references, unreadable frames, saving."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config, LoopDetector, Reason
from loopclosure.errors import ConfigError, FitError, ImageError, ModelError

SMALL = {
    "features.height": 64,
    "features.width": 64,
    "aggregation.clusters": 8,
    "aggregation.centre_window": 15,
    "sequence.length": 4,
    "decision.threshold": 0.57,
    "decision.consistency": 1,
    "sequence.exclude_recent": 10,
    "learning.refit_at": (20, 30),
}


def small(**settings):
    return Config().with_settings(SMALL | {name.replace("__", "."): value for name, value in settings.items()})


def make_lap(frames, *, offset=0):
    """Views from a camera that moves sideways along a wall of coloured blocks, `offset` pixels away from the track."""
    blocks = np.random.default_rng(0).integers(0, 255, size=(10, 10 + 2 * frames, 3), dtype=np.uint8)
    wall = blocks.repeat(8, axis=0).repeat(8, axis=1)
    return [wall[offset : offset + 64, 16 * i + offset : 16 * i + offset + 64] for i in range(frames)]


@pytest.fixture(scope="module")
def two_laps():
    return [*make_lap(24), *make_lap(24, offset=3)]


def as_rows(decisions):
    return [(d.query, d.match, d.score, d.accepted, d.reason) for d in decisions]


def test_finds_the_second_lap_and_nothing_before(two_laps):
    detector = LoopDetector(small())
    decisions = [detector.add(image) for image in two_laps]
    assert [d.query for d in decisions] == list(range(48))
    assert not any(d.accepted for d in decisions[:24])
    full = decisions[24 + 3 :]
    assert [d.match for d in full] == [d.query - 24 for d in full]
    assert all(d.accepted and d.reason is Reason.ACCEPTED for d in full[6:])  # three views on the way were verified


def test_batch_gives_the_rows_of_frame_by_frame(two_laps):
    one_by_one = LoopDetector(small())
    rows = [one_by_one.add(image) for image in two_laps]
    assert as_rows(LoopDetector(small()).detect(iter(two_laps))) == as_rows(rows)


def test_a_decision_never_depends_on_later_frames(two_laps):
    whole = list(LoopDetector(small()).detect(two_laps))
    for cut in (15, 25, 40):
        assert as_rows(LoopDetector(small()).detect(two_laps[:cut])) == as_rows(whole[:cut])


def test_reasons_in_order(two_laps):
    decisions = list(LoopDetector(small(sequence__exclude_recent=12)).detect(two_laps))
    reasons = [d.reason for d in decisions]
    assert reasons[:11] == [Reason.WARMING_UP] * 11
    assert reasons[11] is Reason.TOO_RECENT
    assert reasons[12:15] == [Reason.SEQUENCE_TOO_SHORT] * 3  # no full window ends at frame 2 or before
    assert reasons[15] in (Reason.BELOW_THRESHOLD, Reason.INCONSISTENT)
    assert decisions[11].match is None
    assert 0 <= decisions[15].match <= 3


def test_learns_anew_at_the_milestones_and_says_so(two_laps):
    detector = LoopDetector(small())
    for image in two_laps:
        detector.add(image)
    assert detector.learned_on == [f"frames 0 to {last} of the drive" for last in (9, 19, 29)]
    bounded = LoopDetector(small(learning__max_kept_mb=1e-6))
    list(bounded.detect(two_laps))
    assert bounded.learned_on == ["frames 0 to 9 of the drive"]


def test_a_loop_must_be_led_up_to(two_laps):
    first_full = 24 + 3
    decisions = list(LoopDetector(small(decision__consistency=6, aggregation__components=0)).detect(two_laps))
    assert all(d.reason is Reason.INCONSISTENT and not d.accepted for d in decisions[first_full : first_full + 4])
    assert all(d.accepted for d in decisions[first_full + 5 :])


@pytest.mark.parametrize("reading", ["channel", "flat", "sequence", "none"])
def test_every_reading_finds_the_other_traverse(reading):
    detector = LoopDetector(small(compression__reading=reading))
    detector.set_reference(make_lap(24))
    decisions = list(detector.detect(make_lap(24, offset=3)))
    assert [d.reason for d in decisions[:3]] == [Reason.SEQUENCE_TOO_SHORT] * 3
    right = np.mean([abs(d.match - d.query) <= 1 for d in decisions[3:]])
    assert right >= (0.7 if reading == "sequence" else 1)  # chance: 0.12; eigen-images blur the frames of a sequence


def test_reversed_drive_is_found_when_asked():
    lap, scores = make_lap(24), {}
    for direction in ("both", "forward"):
        detector = LoopDetector(small(sequence__direction=direction))
        detector.set_reference(lap)
        decisions = list(detector.detect(lap[::-1]))[3:]
        scores[direction] = np.array([d.score for d in decisions])
        if direction == "both":
            assert [d.match for d in decisions] == [23 - d.query for d in decisions]
            assert all(d.accepted for d in decisions)
    assert (scores["forward"] < scores["both"]).all()


def test_unreadable_frames_keep_their_place(two_laps):
    holes = [None if i in (0, 5, 26, 40) else image for i, image in enumerate(two_laps)]
    decisions = list(LoopDetector(small()).detect(holes))
    assert [d.query for d in decisions if d.reason is Reason.UNREADABLE] == [0, 5, 26, 40]
    assert all(d.match is None for d in decisions if d.reason is Reason.UNREADABLE)
    assert decisions[36].match == 12
    assert all(d.score is None or np.isfinite(d.score) for d in decisions)


@pytest.mark.parametrize("value", [0, 255])
def test_blank_frames_give_no_nan(value):
    blank = [np.full((48, 48, 3), value, np.uint8)] * 16
    decisions = list(LoopDetector(small()).detect([*blank, *make_lap(8), *blank]))
    assert all(d.score is None or np.isfinite(d.score) for d in decisions)


def test_frames_of_mixed_sizes_are_allowed(two_laps):
    mixed = [image if i % 2 else image.repeat(2, axis=0).repeat(2, axis=1) for i, image in enumerate(two_laps)]
    decisions = list(LoopDetector(small()).detect(mixed))
    assert [d.match for d in decisions[30:]] == list(range(6, 24))


def test_a_drive_that_begins_in_the_dark_still_learns_from_enough_frames(two_laps):
    detector = LoopDetector(small())
    decisions = list(detector.detect([*[None] * 12, *two_laps]))
    assert [d.reason for d in decisions[:12]] == [Reason.UNREADABLE] * 12
    assert decisions[20].reason is Reason.WARMING_UP
    assert detector.learned_on[0] == "frames 0 to 21 of the drive, 12 of them unreadable"
    assert [d.match for d in decisions[-10:]] == list(range(26, 36))


def test_a_small_exclusion_band_does_not_mean_a_small_fit(two_laps):
    detector = LoopDetector(small(sequence__exclude_recent=1))
    list(detector.detect(two_laps[:12]))
    assert detector.learned_on == ["frames 0 to 9 of the drive"]


def test_a_model_knows_the_first_places_of_a_drive_as_well(two_laps):
    detector = LoopDetector(small(sequence__length=1))
    detector.fit(make_lap(24), source="lap")
    decisions = list(detector.detect(two_laps))
    assert [d.match for d in decisions[24:28]] == [0, 1, 2, 3]


def test_fitting_begins_a_new_drive(two_laps):
    detector = LoopDetector(small())
    list(detector.detect(two_laps[:12]))
    detector.fit(make_lap(24), source="lap")
    assert (detector.frames, detector.map_size, detector.scores.size) == (0, 0, 0)
    assert detector.add(two_laps[0]).query == 0


def test_unreadable_queries_have_no_scores(two_laps):
    detector = LoopDetector(small())
    list(detector.detect([*two_laps[:30], None]))
    assert detector.scores.size == 30
    assert np.isnan(detector.scores).all()


def test_a_live_source_is_asked_for_one_image_at_a_time(two_laps):
    taken = []

    def camera():
        for i, image in enumerate(two_laps):
            taken.append(i)
            yield image

    decisions = LoopDetector(small()).detect(camera())
    for expected in range(5):
        next(decisions)
        assert len(taken) == expected + 1


@pytest.mark.parametrize("stop", [5, 15, 25, 35])
@pytest.mark.parametrize("reading", ["channel", "sequence"])
def test_saved_detector_goes_on_as_if_it_had_never_stopped(two_laps, tmp_path, stop, reading):
    detector = LoopDetector(small(compression__reading=reading))
    for image in two_laps[:stop]:
        detector.add(image)
    detector.save(tmp_path / "saved")
    again = LoopDetector.load(tmp_path / "saved")
    for image in two_laps[stop:]:
        one, two = detector.add(image), again.add(image)
        assert (one.query, one.match, one.reason) == (two.query, two.match, two.reason)
        assert one.score == pytest.approx(two.score, abs=1e-5) if one.score is not None else two.score is None
    assert again.learned_on == detector.learned_on


def test_saved_detector_with_a_reference_goes_on(tmp_path):
    query = make_lap(24, offset=3)
    detector = LoopDetector(small(aggregation__centre_window=5))
    detector.set_reference(make_lap(24))
    for image in query[:12]:
        detector.add(image)
    again = LoopDetector.load(detector.save(tmp_path / "saved"))
    assert not again.one_stream
    for image in query[12:]:
        one, two = detector.add(image), again.add(image)
        assert (one.query, one.match, one.reason) == (two.query, two.match, two.reason)
        assert one.score == pytest.approx(two.score, abs=1e-5)


def test_a_saved_map_serves_as_reference(tmp_path):
    morning = LoopDetector(small())
    for image in make_lap(24):
        morning.add(image)
    morning.save(tmp_path / "morning")
    evening = LoopDetector.load(tmp_path / "morning")
    evening.use_map_as_reference(small(decision__threshold=0.7))
    decisions = list(evening.detect(make_lap(24, offset=3)))
    assert [d.match for d in decisions[3:]] == list(range(3, 24))
    evening.use_map_as_reference(small(sequence__length=8))
    decisions = list(evening.detect(make_lap(24, offset=3)))
    assert [d.match for d in decisions] == [None] * 7 + list(range(7, 24))
    with pytest.raises(ModelError, match=r"aggregation\.centre_window = 15, wanted 0"):
        evening.use_map_as_reference(small(aggregation__centre_window=0))
    with pytest.raises(ModelError, match=r"features\.layer = s16, wanted s8"):
        evening.use_map_as_reference(small(features__layer="s8"))


def test_model_is_used_and_guarded(tmp_path):
    teacher = LoopDetector(small(compression__gamma=0.6))
    teacher.fit(make_lap(24), source="lap")
    teacher.save_model(tmp_path / "model")
    pupil = LoopDetector(model=tmp_path / "model")
    assert pupil.config == small(compression__gamma=0.6)
    assert pupil.learned_on == ["24 of 24 frames of the lap"]
    assert pupil.add(make_lap(1)[0]).reason is Reason.TOO_RECENT
    with pytest.raises(ModelError, match=r"compression\.gamma = 0\.6, wanted 0\.9"):
        LoopDetector(small(compression__gamma=0.9), model=tmp_path / "model")
    with pytest.raises(ModelError, match="holds 'model', wanted 'detector'"):
        LoopDetector.load(tmp_path / "model")


def test_map_holds_only_descriptors_of_the_reference():
    detector = LoopDetector(small())
    detector.set_reference(make_lap(24))
    list(detector.detect(make_lap(10)))
    assert detector.map_size == 24
    assert detector.scores.shape == (24,)


def test_errors_towards_users():
    with pytest.raises(FitError, match="nothing was fitted yet"):
        LoopDetector(small()).save_model("nowhere")
    with pytest.raises(FitError, match="map is empty"):
        LoopDetector(small()).use_map_as_reference()
    with pytest.raises(ImageError):
        LoopDetector(small()).add(np.zeros((64, 64), np.uint8))
    with pytest.raises(ConfigError, match="did you mean 'kl-netvlad'"):
        LoopDetector(Config(method="kl-netvald"))
    with pytest.raises(FitError, match="none of the 3 frames"):
        LoopDetector(small()).set_reference([None] * 3)
