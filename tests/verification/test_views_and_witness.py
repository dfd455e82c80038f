"""Views of a drive, and what a sequence of them says of a candidate."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.verification import LocalFeatures, Verifier, Views, Witness

SIZE = (640, 480)


@pytest.fixture
def verifier():
    return Verifier("fast")


def features(seed, points=None, count=120):
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), SIZE, (count, 2)).astype(np.float32) if points is None else points
    return LocalFeatures(points, rng.integers(0, 200, (len(points), 128)).astype(np.uint8), SIZE)


def moved(view, by):
    return LocalFeatures(view.points + np.float32(by), view.descriptors, view.size)


def joined(*views):
    return LocalFeatures(
        np.concatenate([view.points for view in views]), np.concatenate([view.descriptors for view in views]), SIZE
    )


def test_what_goes_along_with_the_robot_is_left_out(verifier):
    lorry, street = features(0, count=40), features(1)
    views = Views(verifier, every=3)
    for step in range(3):
        views.add(joined(moved(lorry, (3 * step, 0)), moved(street, (40 * step, 0))))
    frame, kept = views.nearest(7)
    assert frame == 6
    np.testing.assert_array_equal(kept.descriptors, street.descriptors)
    assert len(views.nearest(0)[1]) == 160  # nothing before it to compare with


def test_a_robot_that_stands_keeps_everything(verifier):
    views = Views(verifier, every=1)
    for _ in range(3):
        views.add(features(2))
    assert len(views.nearest(2)[1]) == 120


def test_unreadable_frames_keep_their_place_and_state_comes_back(verifier):
    views = Views(verifier, every=2)
    for view in (features(0), None, features(1), features(2)):
        views.add(view)
    again = Views(verifier, every=2).restore(views.to_arrays())
    assert again.nearest(2) == (2, None)
    assert len(again) == 4
    assert again.nbytes == views.nbytes > 0
    for one in (views, again):
        one.add(moved(features(1), (1, 1)))  # still, against the view before last
    assert len(views.nearest(8)[1]) == len(again.nearest(8)[1])


@pytest.fixture
def street(verifier):
    """A drive of 12 views, every third frame, and the same one driven again."""
    views = Views(verifier, every=3)
    for place in range(12):
        views.add(features(100 + place))
    return views


def drive_again(verifier, street, *, places, both=False):
    views = Views(verifier, every=3)
    witness = Witness(views, street, length=10, both_directions=both)
    heard = []
    for query, place in enumerate(places):
        if views.wanted(query):
            view = features(100 + place // 3) if place is not None else features(999 + query)
            views.add(moved(view, (5, 2)))
        heard.append(witness.hear(query, [place or 0, 33]))
    return heard, witness


def test_the_place_is_confirmed_and_remembered_between_views(verifier, street):
    heard, _ = drive_again(verifier, street, places=range(12))
    assert all(right.support > 2 * verifier.least_support for right, _ in heard)
    assert all(right.inliers > 60 for right, _ in heard)
    assert all(wrong.support < 1 for _, wrong in heard)


def test_another_street_is_not_confirmed(verifier, street):
    heard, _ = drive_again(verifier, street, places=[None] * 9)
    assert all(one.support < 1 for pair in heard for one in pair)


def test_what_is_older_than_a_sequence_is_forgotten(verifier, street):
    heard, witness = drive_again(verifier, street, places=range(12))
    assert heard[-1][0].support > 0
    assert witness.hear(40, [40]) == [(0.0, None)]


@pytest.mark.parametrize("both", [False, True])
def test_the_way_back_counts_only_where_it_is_asked_for(verifier, street, both):
    heard, _ = drive_again(verifier, street, places=range(30, 8, -2), both=both)
    assert (heard[10][0].support > 0) is both  # a frame without a view: what was seen before it decides


def test_state_of_the_witness_comes_back(verifier, street):
    _, witness = drive_again(verifier, street, places=range(8))
    again = Witness(Views(verifier, every=3), street, length=10).restore(witness.to_arrays())
    assert again.hear(8, [8]) == witness.hear(8, [8])


def test_the_bar_is_that_of_the_verifier(verifier, street):
    assert Witness(Views(verifier, every=3), street, length=10).bar == verifier.least_support
