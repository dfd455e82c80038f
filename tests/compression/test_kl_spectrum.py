"""The rules for k, against plain sums."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopclosure.compression import READINGS, build, choose_components, energy_share
from loopclosure.compression.spectrum import check_maps, eigenvectors, fix_signs, whitening
from loopclosure.errors import ConfigError, FitError

ENERGIES = st.lists(st.floats(0, 1e6), min_size=1, max_size=30).map(lambda values: sorted(values, reverse=True))


@given(ENERGIES)
def test_energy_share_is_equation_15(energies):
    share = energy_share(energies)
    for n in range(1, len(energies) + 1):
        expected = sum(energies[:n]) / sum(energies) if sum(energies) else 1.0
        assert share[n - 1] == pytest.approx(expected, abs=1e-12)


def test_energy_share_counts_lost_energy():
    assert energy_share([6.0, 3.0], lost=1.0).tolist() == [0.6, 0.9]


@given(ENERGIES, st.floats(0.01, 1))
def test_energy_keeps_the_smallest_k_that_reaches_it(energies, wanted):
    k = choose_components(energies, energy=wanted)
    share = energy_share(energies)
    assert share[k - 1] >= wanted - 1e-11
    assert k == 1 or share[k - 2] < wanted


@pytest.mark.parametrize(
    ("gamma", "size", "k"), [(0.8, 2048, 410), (0.6, 10, 4), (0.7, 10, 3), (0.8, 10, 2), (0.9, 10, 1), (0.99, 10, 1)]
)
def test_gamma_is_equation_16(gamma, size, k):
    assert choose_components(np.ones(size), gamma=gamma) == k


def test_gamma_zero_keeps_all():
    assert choose_components(np.ones(7), gamma=0) == 7


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        ({}, "found none"),
        ({"gamma": 0.5, "energy": 0.5}, "found gamma and energy"),
        ({"gamma": 1.0}, "gamma = 1.0"),
        ({"gamma": -0.1}, "gamma = -0.1"),
        ({"gamma": float("nan")}, "gamma = nan"),
        ({"gamma": "auto"}, "gamma = 'auto'"),
        ({"energy": 0.0}, "energy = 0.0"),
        ({"energy": 1.1}, "energy = 1.1"),
        ({"components": 0}, "components = 0"),
        ({"components": 2.5}, "components = 2.5"),
    ],
)
def test_a_rule_out_of_range_is_refused(rule, says):
    with pytest.raises(ConfigError, match=says):
        choose_components([1.0, 0.5], **rule)


def test_more_than_the_samples_allow_is_refused():
    with pytest.raises(FitError, match="k = 2000 components wanted, 1469 samples allow at most 1468"):
        choose_components(np.ones(2048), components=2000, limit=1468, source="1469 samples")


def test_energy_beyond_the_samples_is_rounding():
    assert choose_components([1.0, 1.0, 1e-9], energy=1.0, limit=2) == 2


def test_energy_lost_by_rounding_is_forgiven():
    assert choose_components([6.0, 4.0], energy=1.0, lost=1e-13) == 2


def test_energy_that_was_forgotten_is_refused():
    with pytest.raises(FitError, match=r"hold 0\.9000"):
        choose_components([6.0, 3.0], energy=0.95, lost=1.0)


def test_eigenvectors_are_sorted_rows():
    matrix = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 5.0]])
    energies, vectors = eigenvectors(matrix)
    np.testing.assert_allclose(energies, [5, 3, 1], atol=1e-12)
    np.testing.assert_allclose(vectors @ matrix, energies[:, None] * vectors, atol=1e-12)


def test_signs_make_the_largest_entry_positive():
    for order in ("C", "F"):
        rows = np.array([[0.1, -0.9, 0.2], [0.9, -0.1, 0.2]], np.float32, order=order)
        fix_signs(rows)
        np.testing.assert_array_equal(rows, np.float32([[-0.1, 0.9, -0.2], [0.9, -0.1, 0.2]]))


def test_whitening_of_no_variance_is_zero():
    np.testing.assert_array_equal(whitening(np.array([4.0, 1e-20, 0.0]), 1e-12), [0.5, 0, 0])


@pytest.mark.parametrize(
    ("maps", "says"),
    [
        (np.zeros((2, 3, 3)), r"shape \(2, 3, 3\)"),
        (np.zeros((2, 3, 3, 0)), "none empty"),
        (np.zeros((2, 3, 3, 1), complex), "complex128"),
        (np.full((2, 3, 3, 1), np.nan), "NaN"),
        (np.full((2, 3, 3, 1), np.inf, np.float16), "NaN or values beyond"),
        (np.full((2, 3, 3, 1), -1e31), "values beyond"),
    ],
)
def test_maps_that_cannot_be_used_are_refused(maps, says):
    with pytest.raises(FitError, match=says):
        check_maps(maps)


def test_one_nan_among_many_is_found():
    maps = np.zeros((3, 4, 4, 5), np.float32)
    maps[1, 2, 3, 4] = np.nan
    with pytest.raises(FitError, match="NaN"):
        check_maps(maps)


def test_build_knows_every_reading():
    for reading, kind in READINGS.items():
        kl = build(reading, energy=0.9, whiten=True)
        assert type(kl) is kind
        assert kl.reading == reading
        assert (kl.gamma, kl.energy, kl.components, kl.whiten) == (None, 0.9, None, True)


def test_build_guesses():
    with pytest.raises(ConfigError, match="did you mean 'channel'"):
        build("chanel", gamma=0.5)
