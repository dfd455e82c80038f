"""The whitening of final descriptors against numpy's own decomposition."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.aggregation.netvlad import unit
from loopclosure.aggregation.reduction import Reduction
from loopclosure.errors import FitError


@pytest.fixture
def descriptors():
    rng = np.random.default_rng(0)
    return unit((rng.normal(size=(40, 120)) * np.geomspace(1, 0.01, 120)).astype(np.float32))


def test_similarities_are_those_of_the_textbook(descriptors):
    reduction = Reduction(16).fit(descriptors)
    centred = descriptors - descriptors.mean(0)
    energies, vectors = np.linalg.eigh(np.cov(centred.T, bias=True).astype(np.float64))
    energies, vectors = energies[::-1][:39], vectors[:, ::-1][:, :16]
    raised = energies[:16] + energies.mean()  # of the 39 directions that 40 descriptors span
    expected = unit((descriptors @ vectors / np.sqrt(raised)).astype(np.float32))
    found = np.stack([reduction.transform(one) for one in descriptors])
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=2e-5)


def test_a_direction_that_all_share_counts_less(descriptors):
    first = np.zeros(120, np.float32)
    first[0] = 1
    rng = np.random.default_rng(1)
    strong = unit(descriptors + np.where(rng.random(40) < 0.5, 2, -2)[:, None].astype(np.float32) * first)
    reduction = Reduction(16).fit(strong)
    alike = [one for one in range(40) if strong[one, 0] > 0][:2]
    before = strong[alike[0]] @ strong[alike[1]]
    after = reduction.transform(strong[alike[0]]) @ reduction.transform(strong[alike[1]])
    assert before > 0.8
    assert after < 0.5 * before


def test_few_frames_give_few_numbers(descriptors):
    assert Reduction(64).fit(descriptors[:10]).transform(descriptors[0]).shape == (8,)
    with pytest.raises(FitError, match="2 descriptors, wanted at least 3"):
        Reduction(64).fit(descriptors[:2])
    with pytest.raises(FitError, match="fit first"):
        Reduction(64).transform(descriptors[0])


def test_parts_are_whitened_by_themselves_and_weighed(descriptors):
    scaled = np.hstack([descriptors[:, :70], 1e3 * descriptors[:, 70:]])
    both = Reduction(8, weights=(1.0, 0.5)).fit(scaled, sizes=(70, 50))
    alone = [Reduction(8).fit(unit(part)) for part in (descriptors[:, :70], descriptors[:, 70:])]
    for one in (0, 17):
        parts = [
            reduction.transform(part) for reduction, part in zip(alone, np.split(descriptors[one], [70]), strict=True)
        ]
        expected = np.concatenate([parts[0], 0.5 * parts[1]]) / np.sqrt(1.25)
        np.testing.assert_allclose(both.transform(scaled[one]), expected, atol=1e-4)
    again = Reduction.from_arrays(both.to_arrays(), weights=both.weights)
    np.testing.assert_array_equal(again.transform(scaled[3]), both.transform(scaled[3]))


@pytest.mark.parametrize("sizes", [(20, 20), (120,), (100, 20, 0)])
def test_sizes_that_do_not_fit_are_refused(descriptors, sizes):
    with pytest.raises(FitError, match="wanted 2 that make 120"):
        Reduction(8, weights=(1.0, 0.5)).fit(descriptors, sizes=sizes)


def test_blank_stays_blank_and_state_comes_back(descriptors):
    reduction = Reduction(8).fit(descriptors)
    again = Reduction.from_arrays(reduction.to_arrays())
    assert not reduction.transform(np.zeros(120, np.float32)).any()
    np.testing.assert_array_equal(again.transform(descriptors[3]), reduction.transform(descriptors[3]))
