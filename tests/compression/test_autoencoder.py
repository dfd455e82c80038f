"""The dense autoencoder: it learns what the data are made of, repeatably, and leaves the global random state alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from loopclosure.compression.autoencoder import Autoencoder
from loopclosure.errors import ConfigError, FitError, ModelError


@pytest.fixture(scope="module")
def maps():
    """Maps of 20 channels that vary in 4 directions."""
    rng = np.random.default_rng(0)
    return (rng.normal(size=(12, 6, 6, 4)) @ rng.normal(size=(4, 20)) + 3).astype(np.float32)


@pytest.fixture(scope="module")
def fitted(maps):
    return Autoencoder(gamma=0.8).fit(maps)


def test_the_code_holds_what_the_maps_hold(maps, fitted):
    codes = fitted.transform(maps)
    assert codes.shape == (12, 6, 6, 4)
    assert codes.dtype == np.float32
    rows, codes = maps.reshape(-1, 20).astype(np.float64), codes.reshape(-1, 4)
    # The best linear way back, found here and not by the decoder, brings back nearly everything.
    inputs = np.column_stack([codes, np.ones(len(codes))])
    back = inputs @ np.linalg.lstsq(inputs, rows, rcond=None)[0]
    assert np.square(rows - back).sum() < 0.05 * np.square(rows - rows.mean(0)).sum()


def test_transform_is_the_equation_of_the_docstring(maps, fitted):
    (inner, inner_offset), (outer, outer_offset) = fitted.weights_
    y = maps[1, 2, 3]
    hidden = [np.tanh(sum(w * v for w, v in zip(row, (y - fitted.mean_) / fitted.scale_, strict=True)) + b)
              for row, b in zip(inner, inner_offset, strict=True)]  # fmt: skip
    code = [
        sum(w * h for w, h in zip(row, hidden, strict=True)) + b for row, b in zip(outer, outer_offset, strict=True)
    ]
    np.testing.assert_allclose(fitted.transform(maps)[1, 2, 3], code, atol=1e-4)


def test_fits_are_repeatable_and_leave_global_random_states_alone(maps, fitted):
    torch_state, numpy_state = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    again = Autoencoder(gamma=0.8).fit(maps)
    assert torch.equal(torch.random.get_rng_state(), torch_state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    np.testing.assert_array_equal(again.transform(maps), fitted.transform(maps))
    assert not np.array_equal(Autoencoder(gamma=0.8, seed=1).fit(maps).transform(maps), fitted.transform(maps))


def test_saved_and_restored(maps, fitted):
    arrays = fitted.to_arrays()
    again = Autoencoder(gamma=0.8).restore(arrays)
    np.testing.assert_array_equal(again.transform(maps), fitted.transform(maps))
    for damaged in ({}, arrays | {"mean": arrays["mean"][:3]}, arrays | {"matrix1": arrays["matrix0"]}):
        with pytest.raises(ModelError, match="the saved autoencoder is damaged"):
            Autoencoder(gamma=0.8).restore(damaged)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e6])
def test_equal_samples_give_finite_codes(value):
    maps = np.full((2, 3, 3, 8), value, np.float32)
    codes = Autoencoder(components=2).fit(maps).transform(maps)
    assert np.isfinite(codes).all()
    assert np.abs(codes - codes[0, 0, 0]).max() < 1e-6


def test_sizes():
    maps = np.random.default_rng(0).random((2, 10), np.float32)
    assert Autoencoder(gamma=0.99).fit(maps).transform(maps).shape == (2, 1)
    assert Autoencoder(components=10).fit(maps).transform(maps[:0]).shape == (0, 10)


def test_errors(maps, fitted):
    with pytest.raises(ConfigError, match="exactly one"):
        Autoencoder()
    with pytest.raises(ConfigError, match=r"gamma = 1\.5"):
        Autoencoder(gamma=1.5)
    with pytest.raises(FitError, match="before it was fitted"):
        Autoencoder(gamma=0.5).transform(maps)
    with pytest.raises(FitError, match="have 3 dimensions, the autoencoder 20"):
        fitted.transform(maps[..., :3])
    with pytest.raises(FitError, match="found no local vectors"):
        Autoencoder(gamma=0.5).fit(maps[:0])
    with pytest.raises(FitError, match="at least the 30 of a code"):
        Autoencoder(components=30).fit(maps)
    with pytest.raises(FitError, match="not finite"):
        Autoencoder(gamma=0.5).fit(np.full((2, 4), np.nan))
