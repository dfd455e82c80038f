"""Views of a drive, and what a sequence of them says of a candidate."""

from __future__ import annotations

import numpy as np
import pytest
from textures import texture

from loopclosure.errors import ModelError
from loopclosure.verification import Verifier, Views, Witness
from loopclosure.verification import views as module
from loopclosure.verification.pictures import unpack_picture

LORRY = np.s_[90:230, 120:280]  # rows and columns


class Counting(Verifier):
    """A verifier that says how often it was asked."""

    def __init__(self):
        super().__init__("fast")
        self.found = self.compared = 0

    def features(self, image):
        self.found += 1
        return super().features(image)

    def verify(self, query, match):
        self.compared += 1
        return super().verify(query, match)


@pytest.fixture
def verifier():
    return Counting()


def kept(verifier, images, *, every=1):
    views = Views(verifier, every=every)
    for image in images:
        views.add(None if image is None else views.pack(image))
    return views


def scrolled(seed, by, *, count, width=400):
    """Views from a camera that moves along a wall, `by` pixels from one to the next."""
    wall = texture(seed, width=width + by * count)
    return [wall[:, by * i : by * i + width].copy() for i in range(count)]


def same(one, other):
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.descriptors, other.descriptors)
    assert one.size == other.size


def behind_a_lorry(seed, *, count):
    images = scrolled(seed, 40, count=count)
    for image in images:
        image[LORRY] = texture(3)[LORRY]
    return images


def on_the_lorry(points):
    """Which points lie so far within that they are described by the lorry alone."""
    rows, columns = LORRY
    start, stop = np.array([columns.start, rows.start]) + 17, np.array([columns.stop, rows.stop]) - 17
    return ((points >= start) & (points < stop)).all(axis=1)


def test_features_are_found_in_the_picture_when_they_are_asked_for(verifier):
    images = scrolled(0, 30, count=6)
    views = kept(verifier, images, every=3)
    assert verifier.found == 0
    frame, features = views.nearest(4)
    assert frame == 3
    assert verifier.found == 1
    same(features, Verifier("fast").features(unpack_picture(views.pack(images[1]), 400)))
    same(views.nearest(3)[1], features)
    assert verifier.found == 1
    same(views.nearest(99)[1], views.nearest(15)[1])


@pytest.mark.parametrize("limit", [1, 3])
def test_only_so_many_are_remembered(verifier, monkeypatch, limit):
    views = kept(verifier, scrolled(1, 30, count=8))
    everything = [views.nearest(frame)[1] for frame in range(8)]
    assert verifier.found == 8
    monkeypatch.setattr(module, "_REMEMBERED", limit)
    few = kept(verifier, scrolled(1, 30, count=8))
    for _ in range(2):
        for frame, wanted in enumerate(everything):
            same(few.nearest(frame)[1], wanted)
            assert len(few._found) <= limit
    assert verifier.found > 8 + 8  # those of the first round were forgotten


def test_what_goes_along_with_the_robot_is_left_out(verifier):
    images = behind_a_lorry(2, count=5)
    views = kept(verifier, images, every=3)
    whole = Verifier("fast").features(unpack_picture(views.pack(images[4]), 400))
    frame, moving = views.nearest(13)
    assert frame == 12
    before, after = on_the_lorry(whole.points), on_the_lorry(moving.points)
    assert before.sum() > 40
    assert after.sum() < 0.1 * before.sum()
    street = [(abs(one.points - 200) > (100, 0)).all(axis=1).sum() for one in (whole, moving)]  # left and right of it
    assert street[1] > 0.97 * street[0] > 100
    assert on_the_lorry(views.nearest(3)[1].points).sum() > 40  # no view before it to compare with


def test_a_robot_that_stands_keeps_everything(verifier):
    views = kept(verifier, [texture(4)] * 3)
    same(views.nearest(2)[1], views.nearest(0)[1])
    assert len(views.nearest(2)[1]) > 300


def test_unreadable_frames_keep_their_place(verifier):
    first, _, third, fourth = behind_a_lorry(5, count=4)
    views = kept(verifier, [first, None, third, fourth], every=2)
    assert len(views) == 4
    assert views.nearest(2) == (2, None)
    assert on_the_lorry(views.nearest(4)[1].points).sum() < 5
    assert on_the_lorry(views.nearest(6)[1].points).sum() > 40  # the view before last could not be read


def test_state_comes_back(verifier):
    images = scrolled(6, 30, count=5)
    views = kept(verifier, [*images[:2], None, images[2]])
    again = Views(verifier, every=1).restore(views.to_arrays())
    assert len(again) == 4
    assert again.nbytes == views.nbytes > 0
    for one in (views, again):
        one.add(one.pack(images[3]))
    assert again.nearest(2) == views.nearest(2) == (2, None)
    for frame in (0, 1, 3, 4):
        same(again.nearest(frame)[1], views.nearest(frame)[1])
    empty = Views(verifier, every=1)
    assert len(Views(verifier, every=1).restore(empty.to_arrays())) == 0


def test_a_spoilt_picture_is_refused_when_it_is_asked_for(verifier):
    arrays = kept(verifier, scrolled(7, 30, count=3)).to_arrays()
    first = arrays["lengths"][0]
    pictures = arrays["pictures"].copy()
    pictures[first : first + 20] = 0
    views = Views(verifier, every=1).restore(arrays | {"pictures": pictures})
    assert len(views.nearest(0)[1]) > 300
    with pytest.raises(ModelError, match="damaged"):
        views.nearest(1)


def seen_at(place, *, later=False):
    """What is seen at a place; later, from a little aside."""
    wall = texture(100 + place, width=420, height=310)
    return wall[8:308, 12:412] if later else wall[:300, :400]


@pytest.fixture(scope="module")
def street():
    """A drive of 12 views, of every third frame."""
    return kept(Counting(), map(seen_at, range(12)), every=3)


def drive_again(street, *, places, both=False, look_at=None):
    """Hear, at every frame, the place where the robot is (None = in another street) and place 33."""
    views = Views(Counting(), every=3)
    witness = Witness(views, street, both_directions=both)
    heard = []
    for query, place in enumerate(places):
        if views.wanted(query):
            views.add(views.pack(seen_at(800 + query if place is None else place // 3, later=True)))
        matches = [place or 0, 33]
        heard.append(witness.hear(query, matches, look_at=matches if look_at is None else look_at(place)))
    return heard, witness, views.verifier


BAR = Verifier("fast").least_support  # of a pair that is verified by itself
WHOLE = 18  # frames after which every look that is asked for was taken


def test_the_place_is_confirmed_and_remembered_between_views(street):
    heard, _, verifier = drive_again(street, places=range(24))
    assert all(right.support > 2 * BAR for right, _ in heard[WHOLE:])
    assert all(right.inliers > 60 for right, _ in heard)
    assert all(wrong.support < BAR / 2 for _, wrong in heard)
    assert verifier.compared == 8 * 2  # at each view both candidates


def test_support_is_the_mean_of_nearly_all_frames(street):
    """In 20 frames there are seven with a view; six are asked for, and of each frame one look counts."""
    heard, witness, _ = drive_again(street, places=range(22))
    best_of = {}
    for query, match, support, _ in witness.to_arrays()["seen"]:
        if abs(match - query) <= min(2 + (21 - query) / 2, 7):
            best_of[query] = max(best_of.get(query, 0), support)
    assert sorted(best_of) == [3, 6, 9, 12, 15, 18, 21]
    assert heard[-1][0].support == pytest.approx(sum(sorted(best_of.values())[1:]) / 6)
    growing = [right.support for right, _ in heard[:WHOLE:3]]
    assert growing == sorted(growing)
    assert growing[0] < 0.25 * growing[-1]


def test_two_candidates_near_each_other_are_one_witness(street):
    alone, *_ = drive_again(street, places=range(22), look_at=lambda place: [place])
    both, *_ = drive_again(street, places=range(22), look_at=lambda place: [place, place + 5, max(place - 5, 0)])
    assert both[-1][0].support == pytest.approx(alone[-1][0].support, rel=0.02)


def test_one_thing_that_both_streets_have_confirms_nothing(street):
    """Such as a zebra crossing: two looks agree very well, those around them not at all."""
    heard, *_ = drive_again(street, places=[12 + i if 5 < i < 12 else None for i in range(24)])
    assert max(pair[0].inliers for pair in heard if pair[0].inliers is not None) > 60
    whole, *_ = drive_again(street, places=range(24))
    assert max(pair[0].support for pair in heard) < 0.5 * whole[-1][0].support


def test_another_street_is_not_confirmed(street):
    heard, *_ = drive_again(street, places=[None] * 24)
    assert all(one.support < BAR / 2 for pair in heard for one in pair)


def test_only_candidates_that_are_worth_it_are_looked_at(street):
    heard, _, verifier = drive_again(street, places=range(12), look_at=lambda place: [])
    assert heard == [[(0.0, None)] * 2] * 12
    assert verifier.found == verifier.compared == 0
    heard, _, verifier = drive_again(street, places=range(24), look_at=lambda place: [place])
    assert all(right.support > 2 * BAR for right, _ in heard[WHOLE:])
    assert all(wrong == (0.0, None) for _, wrong in heard)
    assert verifier.compared == 8


def test_candidates_that_share_a_view_are_looked_at_once(street):
    heard, _, verifier = drive_again(street, places=[15], look_at=lambda place: [14, 15, 16])
    assert verifier.compared == 1
    assert heard[0][0].support > 0


def test_what_is_old_is_forgotten(street):
    heard, witness, _ = drive_again(street, places=range(12))
    assert heard[-1][0].support > 0
    assert witness.hear(40, [40], look_at=[]) == [(0.0, None)]


@pytest.mark.parametrize("both", [False, True])
def test_the_way_back_counts_only_where_it_is_asked_for(street, both):
    heard, *_ = drive_again(street, places=range(30, 8, -2), both=both)
    assert (heard[10][0].support > 0) is both  # a frame without a view: what was seen before it decides


def test_state_of_the_witness_comes_back(street):
    _, witness, _ = drive_again(street, places=range(8))
    again = Witness(Views(Counting(), every=3), street).restore(witness.to_arrays())
    assert again.hear(8, [8], look_at=[8]) == witness.hear(8, [8], look_at=[8])
