"""The running mean of a traverse."""

from __future__ import annotations

import numpy as np

from loopclosure.aggregation.centring import RunningMean, centre_traverse
from loopclosure.aggregation.netvlad import unit


def make_descriptors(count, seed=0):
    return unit(np.random.default_rng(seed).normal(size=(count, 8)).astype(np.float32) + 1)


def test_takes_out_the_mean_of_the_last_frames():
    descriptors = make_descriptors(50)
    running = RunningMean(30)
    centred = [running.centre(descriptor) for descriptor in descriptors]
    for t in (1, 12, 29, 30, 49):
        mean = descriptors[max(0, t - 29) : t + 1].mean(0)
        np.testing.assert_allclose(centred[t], unit(descriptors[t] - mean), atol=1e-5)


def test_prior_stands_in_for_missing_frames():
    descriptors, prior = make_descriptors(40), np.full(8, 0.3, np.float32)
    running = RunningMean(30, prior=prior)
    for t in range(40):
        centred = running.centre(descriptors[t])
        seen = descriptors[max(0, t - 29) : t + 1]
        missing = max(20 - len(seen), 0)
        mean = (seen.sum(0) + missing * prior) / max(len(seen), 20)
        np.testing.assert_allclose(centred, unit(descriptors[t] - mean), atol=1e-5)


def test_a_short_window_lets_go_of_the_prior():
    running = RunningMean(5, prior=np.full(8, 9.0, np.float32))
    descriptors = make_descriptors(30)
    for descriptor in descriptors:
        running.centre(descriptor)
    np.testing.assert_allclose(running.current, descriptors[-5:].mean(0), atol=1e-5)


def test_blank_frames_do_not_count():
    descriptors = make_descriptors(10)
    with_blanks, without = RunningMean(30), RunningMean(30)
    for descriptor in descriptors:
        assert not with_blanks.centre(np.zeros(8, np.float32)).any()
        np.testing.assert_array_equal(with_blanks.centre(descriptor), without.centre(descriptor))


def test_window_zero_changes_nothing():
    descriptor = make_descriptors(1)[0]
    np.testing.assert_array_equal(RunningMean(0).centre(descriptor), descriptor)
    centred, mean = centre_traverse(descriptor[None], window=0)
    np.testing.assert_array_equal(centred[0], descriptor)
    assert mean is None


def test_whole_traverse():
    descriptors = make_descriptors(20)
    descriptors[7] = 0
    centred, mean = centre_traverse(descriptors, window=60)
    np.testing.assert_allclose(mean, np.delete(descriptors, 7, axis=0).mean(0), atol=1e-6)
    assert not centred[7].any()
    np.testing.assert_allclose(centred[3], unit(descriptors[3] - mean), atol=1e-6)


def test_state_comes_back():
    descriptors = make_descriptors(80)
    running = RunningMean(30, prior=np.zeros(8, np.float32))
    for descriptor in descriptors[:60]:
        running.centre(descriptor)
    again = RunningMean.from_arrays(running.to_arrays())
    for descriptor in descriptors[60:]:
        np.testing.assert_allclose(again.centre(descriptor), running.centre(descriptor), atol=1e-6)


def test_a_frame_that_is_all_that_recent_frames_share_says_nothing():
    """What is left of it are rounding errors, which scaled to length 1 would look like a place."""
    descriptor = unit(np.random.default_rng(5).normal(size=50).astype(np.float32))
    mean = RunningMean(30)
    assert not any(mean.centre(descriptor * np.float32(1 + 1e-6 * i)).any() for i in range(40))
    assert not centre_traverse(np.tile(descriptor, (9, 1)), window=5)[0].any()
