"""From evidence to decisions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from loopclosure import Config, LoopDetector, Reason
from loopclosure.decision import Evidence, features_of, least_probability
from loopclosure.images.simulator import Drive, SimulationSettings

WEAK = Evidence(match=3, similarity=0.55, standing=0.0, run=1)
STRONG = Evidence(match=3, similarity=0.8, standing=6.0, run=40, support=20.0, inliers=90)


@pytest.mark.parametrize("better", [{"similarity": 0.7}, {"standing": 3.0}, {"run": 12}, {"support": 6.0}])
def test_each_piece_of_evidence_raises_the_odds(better):
    assert replace(WEAK, **better).log_odds > WEAK.log_odds


def test_probability_is_that_of_the_odds():
    for one in (WEAK, STRONG):
        assert one.probability == pytest.approx(math.exp(one.log_odds) / (1 + math.exp(one.log_odds)))
    assert STRONG.probability > 0.9999
    assert WEAK.probability < 0.05


def test_support_that_chance_gives_is_none():
    assert features_of(replace(WEAK, support=0.7)) == features_of(WEAK)


def test_fewer_false_loops_ask_for_more():
    bars = [least_probability(rate) for rate in (0.1, 1, 10, 1000)]
    assert bars == sorted(bars, reverse=True)
    assert 0.5 <= bars[-1] < bars[0] < 1


@pytest.fixture(scope="module")
def frames():
    return list(Drive(SimulationSettings(frames=120, seed=3, spacing_m=1.5)))


@pytest.fixture(scope="module")
def decided(frames):
    detector = LoopDetector()
    return [(detector.add(frame.image), detector.evidence) for frame in frames]


def test_a_street_that_is_driven_again_is_found(decided):
    accepted = [decision for decision, _ in decided if decision.accepted]
    assert len(accepted) > 20
    assert all(abs(decision.query - 60 - decision.match) <= 3 for decision in accepted)
    assert all(decision.inliers > 0 for decision in accepted)


def test_a_decision_is_its_best_evidence(decided):
    for decision, evidence in decided:
        if decision.match is None:
            assert evidence == ()
            continue
        assert [one.log_odds for one in evidence] == sorted((one.log_odds for one in evidence), reverse=True)
        assert (decision.match, decision.score) == (evidence[0].match, evidence[0].probability)
        assert decision.inliers == evidence[0].inliers


def test_the_reason_names_what_is_missing(decided):
    least = least_probability(1.0)
    for decision, evidence in decided:
        if decision.match is None:
            continue
        best = evidence[0]
        if decision.reason is Reason.ACCEPTED:
            assert best.probability >= least
        elif decision.reason is Reason.INCONSISTENT:
            assert best.probability < least <= replace(best, run=1000).probability
        elif decision.reason is Reason.NOT_VERIFIED:
            assert replace(best, run=1000).probability < least <= replace(best, support=best.support + 10).probability


def test_without_verification_nothing_is_said_of_inliers(frames):
    detector = LoopDetector(Config().with_settings({"verification.mode": "none"}))
    decisions = [detector.add(frame.image) for frame in frames[:80]]
    assert all(decision.inliers is None for decision in decisions)
    assert detector.verifier is None


def test_a_rate_allows_more(frames):
    def accepted(rate):
        detector = LoopDetector(Config().with_settings({"decision.false_loops_per_1000": rate}))
        decisions = [detector.add(frame.image) for frame in frames]
        return {decision.query for decision in decisions if decision.accepted}

    assert accepted(0.1) <= accepted(20)
    assert len(accepted(0.1)) < len(accepted(20))


@pytest.mark.parametrize("at", [20, 45, 100])
def test_a_saved_detector_goes_on_the_same(frames, tmp_path, at):
    detector = LoopDetector()
    for frame in frames[:at]:
        detector.add(frame.image)
    detector.save(tmp_path / "saved")
    again = LoopDetector.load(tmp_path / "saved")
    for frame in frames[at : at + 8]:
        assert again.add(frame.image) == detector.add(frame.image)
        assert again.evidence == detector.evidence


def test_a_reference_keeps_its_local_features_when_saved(frames, tmp_path):
    images = [frame.image for frame in frames]
    detector = LoopDetector()
    detector.set_reference(images[:60])
    for image in images[60:90]:
        detector.add(image)
    assert detector.evidence[0].inliers
    detector.save(tmp_path / "saved")
    again = LoopDetector.load(tmp_path / "saved")
    assert again.map_bytes == detector.map_bytes
    for image in images[90:95]:
        assert again.add(image) == detector.add(image)


def test_a_threshold_of_ones_own_is_on_the_score(frames):
    detector = LoopDetector(Config().with_settings({"decision.threshold": 0.5}))
    decisions = [detector.add(frame.image) for frame in frames]
    assert all(decision.accepted == (decision.score >= 0.5) for decision in decisions if decision.match is not None)
    assert any(decision.accepted for decision in decisions)


def test_blank_images_are_no_loop():
    detector = LoopDetector()
    black = np.zeros((48, 64, 3), np.uint8)
    decisions = [detector.add(black) for _ in range(60)]
    assert not any(decision.accepted for decision in decisions)
    assert all(decision.score is None or math.isfinite(decision.score) for decision in decisions)
