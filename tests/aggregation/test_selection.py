"""The choice of gamma without truth."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure import Config
from loopclosure.aggregation.netvlad import unit
from loopclosure.aggregation.selection import GAMMAS, margin
from loopclosure.errors import ConfigError
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.methods import build_method


def drive(noise, seed=0):
    """Descriptors that move on smoothly through a large space."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(80, 64))
    smooth = np.stack([steps[i : i + 8].sum(0) for i in range(72)])
    return unit((smooth + noise * rng.normal(size=smooth.shape)).astype(np.float32))


def test_margin_is_its_definition():
    descriptors = drive(0.5)
    differences = []
    for i, one in enumerate(descriptors):
        near = [one @ descriptors[j] for j in range(72) if 2 <= abs(i - j) <= 4]
        far = [one @ descriptors[j] for j in range(72) if abs(i - j) >= 18]
        if far:
            differences.append(sum(near) / len(near) - max(far))
    assert margin(descriptors) == pytest.approx(np.mean(differences), abs=1e-5)


def test_noise_lowers_it():
    margins = [margin(drive(noise)) for noise in (0.0, 2.0, 8.0)]
    assert margins == sorted(margins, reverse=True)
    assert margins[0] > margins[2] + 0.2


def test_too_few_frames_tell_nothing():
    assert margin(drive(0)[:8]) == -np.inf


def test_auto_takes_the_gamma_of_the_largest_margin():
    images = [frame.image for frame in Drive(SimulationSettings(frames=60, seed=1, revisit=False))][:40]
    auto = build_method(Config().with_settings({"compression.gamma": "auto"}))
    features = auto.features(images)
    auto.fit(features)
    assert auto.gamma in GAMMAS
    fixed = build_method(Config().with_settings({"compression.gamma": auto.gamma}))
    fixed.fit(features)
    np.testing.assert_array_equal(auto.describe(features[:1]), fixed.describe(features[:1]))
    again = build_method(Config().with_settings({"compression.gamma": "auto"}))
    again.restore(auto.to_arrays())
    assert again.gamma == auto.gamma
    np.testing.assert_array_equal(auto.describe(features[:1]), again.describe(features[:1]))


def test_auto_is_for_the_reading_that_has_a_descriptor_a_frame():
    with pytest.raises(ConfigError, match="auto"):
        Config().with_settings({"compression.gamma": "auto", "compression.reading": "sequence"})
    with pytest.raises(ConfigError, match="gamma"):
        Config().with_settings({"compression.gamma": "automatic"})
