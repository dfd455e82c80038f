"""ChannelKL against scikit-learn's PCA and against its own properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA

from loopclosure.compression import ChannelKL, channel
from loopclosure.errors import FitError


def some_maps(n=12, h=5, w=4, c=9, seed=0):
    """Maps with correlated channels, unequal energies and a mean of their own."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(c, c)) * np.geomspace(3, 0.05, c)[:, None]
    return (rng.normal(size=(n, h, w, c)) @ mixing + rng.normal(size=c)).astype(np.float32)


@pytest.mark.parametrize("whiten", [False, True])
def test_equals_pca_up_to_sign(whiten):
    maps = some_maps()
    rows = maps.reshape(-1, 9).astype(float)
    pca = PCA(4, whiten=whiten).fit(rows)
    kl = ChannelKL(components=4, whiten=whiten).fit(maps)
    # scikit-learn divides by m - 1, Eq. 10 by m.
    np.testing.assert_allclose(kl.energies_[:4], pca.explained_variance_ * (1 - 1 / len(rows)), rtol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(kl.basis_ * pca.components_, axis=1)), 1, atol=1e-5)
    assert kl.energy_kept_ == pytest.approx(pca.explained_variance_ratio_.sum(), rel=1e-6)
    expected = pca.transform(rows) * (np.sqrt(len(rows) / (len(rows) - 1)) if whiten else 1)
    found = kl.transform(maps).reshape(-1, 4)
    signs = np.sign(np.sum(kl.basis_ * pca.components_, axis=1))
    np.testing.assert_allclose(found * signs, expected, atol=2e-4)


def test_basis_is_orthonormal_sorted_and_signed():
    kl = ChannelKL(gamma=0.3).fit(some_maps())
    assert kl.basis_.shape == (6, 9)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(6), atol=1e-6)
    assert (np.diff(kl.energies_) <= 0).all()
    assert (kl.energies_ >= 0).all()
    assert (np.take_along_axis(kl.basis_, np.abs(kl.basis_).argmax(1)[:, None], 1) > 0).all()


def test_energies_are_the_variances_of_the_code():
    kl = ChannelKL(components=9).fit(some_maps())
    np.testing.assert_allclose(kl.transform(some_maps()).reshape(-1, 9).var(axis=0), kl.energies_, rtol=1e-4)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(0, 12), max_size=5), st.integers(0, 5))
def test_a_stream_gives_what_a_batch_gives(cuts, seed):
    maps = some_maps(seed=seed) * 5 + 100
    batch = ChannelKL(components=5).fit(maps)
    stream = ChannelKL(components=5)
    for part in np.split(maps, sorted(cuts)):
        stream.partial_fit(part)
    assert stream.n_samples_ == batch.n_samples_ == 240
    np.testing.assert_allclose(stream.mean_, batch.mean_, rtol=1e-12)
    np.testing.assert_allclose(stream.energies_, batch.energies_, rtol=1e-9, atol=1e-14 * 100**2)
    np.testing.assert_allclose(stream.basis_, batch.basis_, atol=1e-6)


def test_small_chunks_change_nothing(monkeypatch):
    whole = ChannelKL(components=5).fit(some_maps())
    monkeypatch.setattr(channel, "CHUNK_BYTES", 1)
    chunked = ChannelKL(components=5).fit(some_maps())
    np.testing.assert_allclose(chunked.energies_, whole.energies_, rtol=1e-9)
    np.testing.assert_allclose(chunked.basis_, whole.basis_, atol=1e-6)


def test_a_stream_can_be_used_in_between():
    maps = some_maps()
    kl = ChannelKL(components=5).partial_fit(maps[:6])
    first = kl.transform(maps)
    np.testing.assert_allclose(first, ChannelKL(components=5).fit(maps[:6]).transform(maps), atol=1e-5)
    second = kl.partial_fit(maps[6:]).transform(maps)
    np.testing.assert_allclose(second, ChannelKL(components=5).fit(maps).transform(maps), atol=1e-4)


def test_fit_forgets():
    kl = ChannelKL(components=5).fit(some_maps(seed=1, c=8)).fit(some_maps())
    np.testing.assert_array_equal(kl.basis_, ChannelKL(components=5).fit(some_maps()).basis_)


@pytest.mark.parametrize("whiten", [False, True])
def test_inverse_with_all_components_is_the_input(whiten):
    maps = some_maps()
    kl = ChannelKL(gamma=0, whiten=whiten).fit(maps)
    np.testing.assert_allclose(kl.inverse_transform(kl.transform(maps)), maps, atol=1e-4)


def test_inverse_loses_the_energy_that_was_cut():
    maps = some_maps()
    kl = ChannelKL(components=4).fit(maps)
    lost = np.mean(np.sum((kl.inverse_transform(kl.transform(maps)) - maps) ** 2, axis=-1))
    assert lost == pytest.approx(kl.energies_[4:].sum(), rel=1e-4)
    assert kl.energy_kept_ == pytest.approx(1 - kl.energies_[4:].sum() / kl.energies_.sum())


def test_whitened_covariance_is_identity():
    maps = some_maps()
    codes = ChannelKL(gamma=0, whiten=True).fit(maps).transform(maps).reshape(-1, 9)
    np.testing.assert_allclose(np.cov(codes.T, bias=True), np.eye(9), atol=1e-3)


def test_shapes_and_types():
    maps = some_maps()
    kl = ChannelKL(components=3).fit(maps)
    assert kl.transform(maps).shape == (12, 5, 4, 3)
    assert kl.transform(maps).dtype == np.float32
    np.testing.assert_allclose(kl.transform(maps.reshape(-1, 9)), kl.transform(maps).reshape(-1, 3), atol=1e-6)
    assert kl.transform(maps[:0]).shape == (0, 5, 4, 3)
    assert kl.inverse_transform(np.zeros((0, 5, 4, 3))).shape == (0, 5, 4, 9)
    np.testing.assert_allclose(kl.transform(maps.astype(float)), kl.transform(maps), atol=1e-6)


def test_channels_may_lie_in_any_memory_order():
    maps = some_maps()
    turned = np.ascontiguousarray(maps.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)
    np.testing.assert_allclose(
        ChannelKL(components=3).fit(turned).transform(turned),
        ChannelKL(components=3).fit(maps).transform(maps),
        atol=1e-5,
    )


def test_input_is_left_alone():
    maps = some_maps()
    before = maps.copy()
    kl = ChannelKL(components=3).fit(maps)
    kl.transform(maps)
    np.testing.assert_array_equal(maps, before)
    wide = maps.astype(float)
    ChannelKL(components=3).fit(wide)
    np.testing.assert_array_equal(wide, before)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e20])
@pytest.mark.parametrize("whiten", [False, True])
def test_identical_samples(value, whiten):
    maps = np.full((3, 4, 4, 6), value)
    kl = ChannelKL(gamma=0, whiten=whiten).fit(maps)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(6), atol=1e-6)
    codes = kl.transform(maps)
    assert np.abs(codes).max() <= 1e-6 * value
    assert np.isfinite(kl.transform(maps + 1)).all()
    np.testing.assert_allclose(kl.inverse_transform(codes), maps, rtol=1e-6)
    assert kl.energy_kept_ == 1 or kl.energies_[0] < (1e-9 * value) ** 2


def test_a_direction_without_variance_whitens_to_zero():
    maps = some_maps()
    maps[..., 8] = maps[..., 0]
    kl = ChannelKL(gamma=0, whiten=True).fit(maps)
    codes = kl.transform(some_maps(seed=3))
    assert (codes[..., 8] == 0).all()
    assert np.isfinite(codes).all()
    np.testing.assert_allclose(kl.inverse_transform(kl.transform(maps)), maps, atol=1e-4)


@pytest.mark.parametrize(("mean", "deviation"), [(1000, 1e-6), (0, 1e-40)])
def test_variance_that_float32_does_not_resolve_whitens_to_zero(mean, deviation):
    maps = mean + deviation * np.random.default_rng(0).normal(size=(5, 4, 4, 6))
    assert (ChannelKL(gamma=0, whiten=True).fit(maps).transform(maps) == 0).all()


def test_too_few_samples():
    with pytest.raises(FitError, match="k = 7 components wanted, 6 samples of 9 channels allow at most 5"):
        ChannelKL(components=7).fit(some_maps().reshape(-1, 9)[:6])
    with pytest.raises(FitError, match="1 sample seen"):
        ChannelKL(components=1).fit(some_maps().reshape(-1, 9)[:1])
    with pytest.raises(FitError, match="0 sample seen"):
        ChannelKL(components=1).fit(some_maps()[:0])


def test_energy_one_needs_no_more_samples_than_there_are():
    kl = ChannelKL(energy=1.0).fit(some_maps().reshape(-1, 9)[:6])
    assert kl.n_components_ == 5


def test_other_channels_are_refused():
    kl = ChannelKL(components=3).fit(some_maps())
    for use in (kl.transform, kl.partial_fit):
        with pytest.raises(FitError, match="maps have 8 channels, the basis 9"):
            use(some_maps(c=8))
    with pytest.raises(FitError, match="codes have 4 components, this basis 3"):
        kl.inverse_transform(np.zeros((2, 4)))
