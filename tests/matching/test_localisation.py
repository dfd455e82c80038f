"""The place that the last frames fit best, against a reading of the definition in plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.localisation import FRAMES, Trail
from loopclosure.matching.sequences import SequenceScores


def unit_rows(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def random_rows(seed, count, size=16):
    return unit_rows(np.random.default_rng(seed).normal(size=(count, size)))


def filled(rows):
    return PlaceIndex().restore({"descriptors": rows})


def by_definition(places, frames, match, *, newest, both, excluded=0):
    """The place at most five away, and none after `newest`, on whose diagonals the frames (newest first) fit best.

    In one stream a frame is compared with what was old enough when it was taken.
    """
    best, most = None, -np.inf
    for place in range(match - 5, match + 6):
        for step in (1, -1) if both else (1,):
            track = [(place - step * age, frame) for age, frame in enumerate(frames)]
            ends = [len(places) - (excluded + age if excluded else 0) for age in range(len(frames))]
            pairs = zip(track, ends, strict=True)
            cosines = [float(places[at] @ frame) for (at, frame), end in pairs if 0 <= at < end]
            if 0 <= place <= newest and np.mean(cosines) > most:
                best, most = place, np.mean(cosines)
    return best


@pytest.mark.parametrize("both", [False, True])
def test_equals_the_definition_in_another_traverse(both):
    rows, frames = random_rows(0, 40), random_rows(1, 30)
    trail, seen, found = Trail(filled(rows), length=2, both_directions=both), [], []
    for query, frame in enumerate(frames):
        trail.push(frame)
        seen.insert(0, frame)
        for match in (0, 1, 7, 20, 36, 39):
            for run in (3, 6, FRAMES, 60):
                wanted = by_definition(rows, seen[: min(run, FRAMES)], match, newest=39, both=both)
                if run <= query + 1:
                    assert trail.nearest(match, run) == wanted
                    found.append(wanted - match)
    assert set(found) == set(range(-5, 6))


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("excluded", [1, 12])
def test_equals_the_definition_in_one_stream(both, excluded):
    rows = random_rows(2, 40)
    places = PlaceIndex()
    trail = Trail(places, length=3, exclude_recent=excluded, both_directions=both)
    for query, row in enumerate(rows):
        places.add(row)
        trail.push(row)
        newest = query - excluded
        seen = rows[max(query - FRAMES + 1, 0) : query + 1][::-1]
        for match in range(max(newest - 6, 0), newest + 1):
            found = trail.nearest(match, 50)
            assert found == by_definition(rows[: query + 1], seen, match, newest=newest, both=both, excluded=excluded)
            assert found <= newest


@pytest.mark.parametrize(("length", "run"), [(1, 1), (4, 4), (9, 3), (FRAMES, 60), (30, 60)])
def test_what_a_sequence_told_already_stays_but_where_the_map_begins(length, run):
    rows, frames = random_rows(3, 60), random_rows(4, 15)
    trail = Trail(filled(rows), length=length)
    for frame in frames:
        trail.push(frame)
    seen = frames[::-1][: max(min(run, FRAMES), 3)]
    found = [trail.nearest(match, run) for match in range(60)]
    begins = length + 5  # the nearest place before this one is the first that has a whole sequence behind it
    assert found[:begins] == [by_definition(rows, seen, match, newest=59, both=False) for match in range(begins)]
    assert found[:begins] != list(range(begins))
    assert found[begins:] == list(range(begins, 60))


def smooth_drive(seed, frames=300):
    """Descriptors that change slowly, and the same drive once more in another light."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(frames + 12, 64))
    places = unit_rows(np.stack([steps[i : i + 12].mean(axis=0) for i in range(frames)]))
    return places, unit_rows(places + rng.normal(0, 0.24, places.shape))


@pytest.mark.parametrize("way", [1, -1])
def test_a_near_miss_of_a_short_sequence_is_put_right(way):
    rows, again = smooth_drive(4)
    truth = np.arange(len(rows))[::way]
    scores = SequenceScores(2, both_directions=way < 0)
    trail = Trail(filled(rows), length=2, both_directions=way < 0)
    missed = []
    for query, place in enumerate(truth):
        trail.push(again[place])
        row = scores.push((1 + rows @ again[place]) / 2)
        if 20 < query < 280:
            match = int(np.nanargmax(row))
            missed.append((abs(match - place), abs(trail.nearest(match, query) - place)))
    before, after = np.array(missed).T
    assert (before > 0).mean() > 0.15
    assert (after > 0).mean() < 0.3 * (before > 0).mean()
    assert after.sum() < 0.3 * before.sum()


def test_frames_that_were_not_read_do_not_turn_it():
    rows, again = smooth_drive(5, frames=60)
    trail = Trail(filled(rows), length=2)
    for place in range(20, 35):
        trail.push(np.zeros(64, np.float32) if place in (27, 30) else again[place])
    assert [trail.nearest(match, 15) for match in (31, 34, 37)] == [34, 34, 34]


def test_state_comes_back():
    rows = random_rows(6, 40)
    one = Trail(filled(rows), length=2)
    assert Trail(filled(rows), length=2).restore(one.to_arrays()).to_arrays() == {}
    for row in random_rows(7, 12):
        one.push(row)
    two = Trail(filled(rows), length=2).restore(one.to_arrays())
    for row in random_rows(8, 4):
        one.push(row)
        two.push(row)
        assert [one.nearest(match, 20) for match in range(40)] == [two.nearest(match, 20) for match in range(40)]
