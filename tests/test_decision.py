"""From evidence to decisions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import loopclosure.decision as judging
from loopclosure import Config, LoopDetector, Reason
from loopclosure.decision import Evidence, Judge, features_of, least_probability, new_views
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.matching.scored import Scored
from loopclosure.verification import Verifier

WEAK = Evidence(match=3, similarity=0.55, standing=0.0, run=1)
STRONG = Evidence(match=3, similarity=0.8, standing=6.0, run=40, lasting=3.0, support=20.0, inliers=90)
DEFAULT_RATE = Config().decision.false_loops_per_1000


@pytest.mark.parametrize("better", [{"standing": 3.0}, {"run": 12}, {"lasting": 2.0}, {"support": 12.0}])
def test_each_piece_of_evidence_raises_the_odds(better):
    assert replace(WEAK, **better).log_odds > WEAK.log_odds


def test_probability_is_that_of_the_odds():
    for one in (WEAK, STRONG):
        assert one.probability == pytest.approx(math.exp(one.log_odds) / (1 + math.exp(one.log_odds)))
    assert STRONG.probability > 0.9999
    assert WEAK.probability < 0.05


def test_support_that_chance_gives_is_none():
    assert features_of(replace(WEAK, support=0.7)) == features_of(WEAK)


@pytest.mark.parametrize("much", ["standing", "run", "support"])
def test_no_piece_of_evidence_counts_without_end(much):
    assert features_of(replace(WEAK, **{much: 10**6})) == features_of(replace(WEAK, **{much: 10**3}))


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
    least = least_probability(DEFAULT_RATE)
    for decision, evidence in decided:
        if decision.match is None:
            continue
        best = evidence[0]
        enough = {
            Reason.ACCEPTED: best,
            Reason.INCONSISTENT: replace(best, run=1000),
            Reason.NOT_VERIFIED: replace(best, support=max(best.support, judging._CONFIRMED)),
            Reason.BELOW_THRESHOLD: None,
        }
        first = next(reason for reason, one in enough.items() if one is None or one.probability >= least)
        assert decision.reason is first
    assert len({decision.reason for decision, _ in decided if decision.match is not None}) > 1


def test_without_verification_nothing_is_said_of_inliers(frames):
    detector = LoopDetector(Config().with_settings({"verification.mode": "none"}))
    decisions = [detector.add(frame.image) for frame in frames[:80]]
    assert all(decision.inliers is None for decision in decisions)
    assert detector.verifier is None


def test_a_lower_rate_allows_less(frames, decided):
    scores = {decision.query: decision.score for decision, _ in decided if decision.accepted}
    rate = DEFAULT_RATE * (1 - min(scores.values())) / (1 - least_probability(DEFAULT_RATE)) / 2
    detector = LoopDetector(Config().with_settings({"decision.false_loops_per_1000": rate}))
    decisions = [detector.add(frame.image) for frame in frames]
    accepted = {decision.query for decision in decisions if decision.accepted}
    assert accepted == {query for query, score in scores.items() if score >= least_probability(rate)}
    assert 0 < len(accepted) < len(scores)


@pytest.fixture(scope="module")
def reference(frames):
    """The method, and views of the street when it was driven first."""
    method = LoopDetector().method
    views = new_views(Config(), method)
    for frame in frames[: 60 : views.every]:
        views.add(views.pack(frame.image))
    return method, views


def judged(frames, reference, *, alike=0.8, **nearest):
    """Decide on the second drive down the street by scores made here: the place is alike, another one is a little."""
    method, views = reference
    judge = Judge(Config(), method, one_stream=False, reference=views)
    rng = np.random.default_rng(0)
    for query, frame in enumerate(frames[60:84]):
        row = rng.normal(0.5, 0.04, 60).astype(np.float32)
        row[query], row[(query + 30) % 60] = alike, 0.62
        judge.see(query, judge.views.pack(frame.image) if judge.views.wanted(query) else None)
        yield judge.decide(query, Scored(row), readable=True, **nearest), judge.evidence


def test_a_place_that_stands_out_without_end_lasts_no_better_for_it(frames, reference):
    for _, (best, *_) in judged(frames, reference, alike=1.2):
        assert best.standing > 10
        assert best.lasting == pytest.approx(features_of(best)[0] * (1 - 0.95**best.run))
    assert best.run == 24


def log_odds_before(one):
    return replace(one, support=0.0).log_odds


def test_only_what_is_worth_a_look_is_verified(frames, reference, monkeypatch):
    compared, verify = [], Verifier.verify
    monkeypatch.setattr(Verifier, "verify", lambda *given: compared.append(1) or verify(*given))
    views = reference[1]

    def look(bar):
        """Return the candidates of all frames, and how many of those that have a view were worth a look."""
        monkeypatch.setattr(judging, "_WORTH_A_LOOK", bar)
        found, looks = [], []
        for query, (_, evidence) in enumerate(judged(frames, reference)):
            likely = sorted(evidence, key=log_odds_before, reverse=True)[: judging._LOOKS]
            worth = {views.nearest(one.match)[0] for one in likely if log_odds_before(one) >= bar}
            assert len(compared) == (len(worth) if query % views.every == 0 else 0)
            looks.append(len(compared))
            compared.clear()
            found += evidence
        return found, sum(looks)

    none, looks = look(math.inf)
    assert looks == 0
    assert {(one.support, one.inliers) for one in none} == {(0.0, None)}
    some, few = look(float(np.median([one.log_odds for one in none])))
    everything, many = look(-math.inf)
    assert 8 <= few < many
    assert sorted(map(log_odds_before, some)) == pytest.approx(sorted(one.log_odds for one in none))
    support = [max(one.support for one in evidence) for evidence in (some, everything)]
    assert support[0] == support[1] > Verifier("fast").least_support


def test_the_best_candidate_is_told_from_its_neighbours(frames, reference):
    asked = []

    def nearest(match, run):
        asked.append((match, run))
        return match + 2

    plain, moved = list(judged(frames, reference)), list(judged(frames, reference, nearest=nearest))
    assert asked == [(evidence[0].match, evidence[0].run) for _, evidence in plain]
    assert asked[-1] == (23, 24)
    for (before, evidence), (after, neighbour) in zip(plain, moved, strict=True):
        assert after == replace(before, match=before.match + 2)
        assert neighbour == (replace(evidence[0], match=after.match), *evidence[1:])


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


def test_a_reference_keeps_its_views_when_saved(frames, tmp_path):
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


def test_a_map_serves_as_reference_more_than_once_with_its_own_views(frames):
    images = [frame.image for frame in frames]
    detector = LoopDetector()
    for image in images[:60]:
        detector.add(image)
    whole = detector.map_bytes
    for _ in range(2):
        detector.use_map_as_reference()
        for image in images[60:80]:
            detector.add(image)
        assert detector.map_bytes == whole
        assert detector.evidence[0].inliers


def test_frames_are_not_verified_against_the_drive_where_the_map_has_no_views(frames, tmp_path):
    images = [frame.image for frame in frames]
    detector = LoopDetector(Config().with_settings({"verification.mode": "none"}))
    for image in images[:60]:
        detector.add(image)
    detector.use_map_as_reference(Config())
    for image in images[60:75]:
        detector.add(image)
        assert all(one.inliers is None for one in detector.evidence)
    again = LoopDetector.load(detector.save(tmp_path / "saved"))
    for image in images[75:80]:
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
