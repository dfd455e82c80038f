"""FlatKL against scikit-learn's PCA, a plain SVD and its own properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA

from loopclosure.compression import FlatKL, snapshots
from loopclosure.errors import ConfigError, FitError

SHAPE = (3, 4, 5)


def some_maps(m=14, seed=0, rank=None):
    """Images with unequal energies, of a rank below m if asked for, and a mean of their own."""
    rng = np.random.default_rng(seed)
    rank = rank or m
    maps = rng.normal(size=(m, rank)) * np.geomspace(3, 0.1, rank) @ rng.normal(size=(rank, np.prod(SHAPE)))
    return (maps + 4).reshape(m, *SHAPE).astype(np.float32)


@pytest.mark.parametrize("whiten", [False, True])
def test_equals_pca_up_to_sign(whiten):
    maps = some_maps()
    rows = maps.reshape(14, -1).astype(float)
    pca = PCA(5, whiten=whiten, svd_solver="full").fit(rows)
    kl = FlatKL(components=5, whiten=whiten).fit(maps)
    np.testing.assert_allclose(kl.energies_[:5], pca.explained_variance_ * 13 / 14, rtol=1e-9)
    signs = np.sign(np.sum(kl.basis_ * pca.components_, axis=1))
    np.testing.assert_allclose(kl.basis_ * signs[:, None], pca.components_, atol=1e-5)
    assert kl.energy_kept_ == pytest.approx(pca.explained_variance_ratio_.sum(), rel=1e-9)
    np.testing.assert_allclose(
        kl.transform(maps) * signs, pca.transform(rows) * (np.sqrt(14 / 13) if whiten else 1), atol=1e-4
    )


def test_energies_are_squared_singular_values():
    maps = some_maps()
    rows = maps.reshape(14, -1).astype(float)
    singular = np.linalg.svd(rows - rows.mean(0), compute_uv=False)
    np.testing.assert_allclose(FlatKL(gamma=0.5).fit(maps).energies_, singular[:13] ** 2 / 14, rtol=1e-9)


def test_basis_is_orthonormal_sorted_and_signed():
    kl = FlatKL(gamma=0).fit(some_maps())
    assert kl.basis_.shape == (13, 60)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(13), atol=1e-6)
    assert (np.diff(kl.energies_) <= 0).all()
    assert (np.take_along_axis(kl.basis_, np.abs(kl.basis_).argmax(1)[:, None], 1) > 0).all()


def test_weak_directions_are_orthogonal_too():
    """The m x m problem squares the condition: its eigenvectors alone would be orthogonal to 0.05 only."""
    rng = np.random.default_rng(0)
    directions = np.linalg.qr(rng.normal(size=(300, 100)))[0].T
    maps = ((rng.normal(size=(100, 100)) * np.geomspace(1, 1e-5, 100)) @ directions).reshape(100, 5, 6, 10)
    kl = FlatKL(gamma=0).fit(maps)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(99), atol=1e-6)
    np.testing.assert_allclose(kl.inverse_transform(kl.transform(maps)), maps, atol=1e-5)


@pytest.mark.parametrize("gamma", [0, 0.3, 0.6, 0.9])
def test_gamma_counts_images(gamma):
    kl = FlatKL(gamma=gamma).fit(some_maps())
    assert kl.n_components_ == min(13, round((1 - gamma) * 14))


def test_more_images_than_values():
    maps = np.random.default_rng(0).normal(size=(40, 1, 2, 3))
    kl = FlatKL(gamma=0).fit(maps)
    assert kl.basis_.shape == (6, 6)
    np.testing.assert_allclose(kl.inverse_transform(kl.transform(maps)), maps, atol=1e-5)


@pytest.mark.parametrize("whiten", [False, True])
def test_inverse_with_all_components_is_the_input(whiten):
    maps = some_maps()
    kl = FlatKL(gamma=0, whiten=whiten).fit(maps)
    codes = kl.transform(maps)
    assert codes.shape == (14, 13)
    assert codes.dtype == np.float32
    np.testing.assert_allclose(kl.inverse_transform(codes), maps, atol=1e-4)


def test_whitened_covariance_is_identity():
    maps = some_maps()
    codes = FlatKL(gamma=0, whiten=True).fit(maps).transform(maps)
    np.testing.assert_allclose(np.cov(codes.T, bias=True), np.eye(13), atol=1e-4)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(0, 14), max_size=14), st.integers(0, 5), st.sampled_from([3, 8, 14]))
def test_a_stream_gives_what_a_batch_gives(cuts, seed, rank):
    maps = some_maps(seed=seed, rank=rank)
    k = min(rank, 13)
    batch = FlatKL(components=k).fit(maps)
    stream = FlatKL(components=k, max_components=k)
    for part in np.split(maps, sorted(cuts)):
        stream.partial_fit(part)
    assert stream.n_samples_ == 14
    np.testing.assert_allclose(stream.mean_, batch.mean_, rtol=1e-12)
    np.testing.assert_allclose(stream.energies_, batch.energies_[:k], rtol=1e-4)
    np.testing.assert_allclose(np.abs(np.sum(stream.basis_ * batch.basis_, axis=1)), 1, atol=1e-4)
    assert stream.energy_kept_ == pytest.approx(batch.energy_kept_, abs=1e-6)


def test_a_short_stream_keeps_the_strong_directions_and_counts_what_it_loses():
    maps = some_maps(m=60, rank=40)
    total = maps.reshape(60, -1).astype(float).var(axis=0).sum()
    stream = FlatKL(components=6, max_components=20)
    for image in maps:
        stream.partial_fit(image[None])
    assert stream.to_arrays()["basis"].shape == (20, 60)
    best = FlatKL(components=6).fit(maps)
    assert stream.energy_kept_ <= best.energy_kept_ + 1e-9
    assert stream.energy_kept_ == pytest.approx(best.energy_kept_, abs=0.01)
    np.testing.assert_allclose(stream.basis_ @ stream.basis_.T, np.eye(6), atol=1e-6)
    assert stream.energies_[:6].sum() / stream.energy_kept_ == pytest.approx(total, rel=1e-5)


def test_a_stream_goes_on_after_fit():
    maps = some_maps(rank=4)
    kl = FlatKL(components=4).fit(maps[:9]).partial_fit(maps[9:])
    batch = FlatKL(components=4).fit(maps)
    np.testing.assert_allclose(kl.energies_[:4], batch.energies_[:4], rtol=1e-4)
    np.testing.assert_allclose(kl.basis_, batch.basis_, atol=1e-4)


def test_max_components_bounds_a_stream():
    assert FlatKL(gamma=0, max_components=5).partial_fit(some_maps()).n_components_ == 5
    with pytest.raises(FitError, match="max_components = 5"):
        FlatKL(components=6, max_components=5).partial_fit(some_maps()).transform(some_maps())
    with pytest.raises(FitError, match="keep more"):
        FlatKL(energy=0.999, max_components=2).partial_fit(some_maps()).transform(some_maps())
    with pytest.raises(ConfigError, match="max_components = 0"):
        FlatKL(components=1, max_components=0).fit(some_maps())


def test_small_chunks_change_nothing(monkeypatch):
    whole = FlatKL(gamma=0).fit(some_maps())
    monkeypatch.setattr(snapshots, "CHUNK_BYTES", 1)
    chunked = FlatKL(gamma=0).fit(some_maps())
    np.testing.assert_allclose(chunked.basis_, whole.basis_, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e20])
@pytest.mark.parametrize("whiten", [False, True])
@pytest.mark.parametrize("stream", [False, True])
def test_identical_images(value, whiten, stream):
    maps = np.full((4, *SHAPE), value)
    kl = FlatKL(gamma=0, whiten=whiten)
    for part in np.split(maps, 4) if stream else [maps]:
        kl = kl.partial_fit(part) if stream else kl.fit(part)
    assert kl.basis_.shape == (3, 60)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(3), atol=1e-6)
    codes = kl.transform(maps)
    assert np.abs(codes).max() <= 1e-5 * value
    assert np.isfinite(kl.transform(maps + 1)).all()
    np.testing.assert_allclose(kl.inverse_transform(codes), maps, rtol=1e-5)


def test_images_of_low_rank_fill_the_basis_up():
    maps = some_maps(rank=3)
    kl = FlatKL(components=10).fit(maps)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(10), atol=1e-6)
    np.testing.assert_allclose(kl.basis_[:3], FlatKL(components=3).fit(maps).basis_, atol=1e-5)
    np.testing.assert_allclose(kl.transform(maps)[:, 3:], 0, atol=1e-4)
    white = FlatKL(components=10, whiten=True).fit(maps.astype(float))
    assert np.abs(white.transform(maps)).max() < 10


def test_images_that_repeat_fill_the_basis_up():
    maps = np.tile(np.random.default_rng(0).normal(size=(3, 5, 8, 10)), (150, 1, 1, 1))
    kl = FlatKL(gamma=0, whiten=True).fit(maps)
    assert kl.basis_.shape == (400, 400)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(400), atol=1e-6)
    np.testing.assert_array_equal(kl.transform(maps)[:, 2:], 0)


@pytest.mark.parametrize("seed", range(40))
def test_any_rank_offset_and_scale(seed):
    """Most of these have more images than directions, some of them far from the origin."""
    rng = np.random.default_rng(seed)
    shape, rank = rng.integers(1, 5, 3), rng.integers(1, 6)
    rows = rng.normal(size=(rng.integers(2, 60), rank)) @ rng.normal(size=(rank, np.prod(shape)))
    maps = (rows * 10.0 ** rng.integers(-3, 4) + rng.choice([0, 1, 1e6])).reshape(-1, *shape)
    kl = FlatKL(gamma=0)
    if seed % 2:
        kl.fit(maps)
    else:
        for part in np.array_split(maps, 5):
            kl.partial_fit(part)
    np.testing.assert_allclose(kl.basis_ @ kl.basis_.T, np.eye(kl.n_components_), atol=1e-6)
    rebuilt = kl.inverse_transform(kl.transform(maps))
    np.testing.assert_allclose(rebuilt, maps, atol=1e-5 * np.abs(maps).max())


def test_shapes():
    kl = FlatKL(components=2).fit(some_maps())
    assert kl.transform(some_maps()[:0]).shape == (0, 2)
    assert kl.inverse_transform(np.zeros((0, 2))).shape == (0, *SHAPE)
    assert kl.partial_fit(some_maps()[:0]).n_samples_ == 14
    turned = np.asfortranarray(some_maps())
    np.testing.assert_allclose(FlatKL(components=2).fit(turned).basis_, kl.basis_, atol=1e-6)


def test_layout_is_kept():
    """Two images with the same local features at different places have different codes."""
    maps = np.zeros((2, *SHAPE))
    maps[0, 0, 0, 0] = maps[1, 2, 3, 0] = 1
    codes = FlatKL(components=1).fit(maps).transform(maps)
    assert abs(codes[0, 0] - codes[1, 0]) == pytest.approx(np.sqrt(2), rel=1e-5)


def test_too_few_images():
    with pytest.raises(FitError, match=r"k = 14 components wanted, 14 images .* allow at most 13"):
        FlatKL(components=14).fit(some_maps())
    with pytest.raises(FitError, match="1 image to fit on"):
        FlatKL(components=1).fit(some_maps()[:1])
    with pytest.raises(FitError, match="1 sample seen"):
        FlatKL(components=1).partial_fit(some_maps()[:1]).transform(some_maps())


def test_other_shapes_are_refused():
    kl = FlatKL(components=2).fit(some_maps())
    for use in (kl.transform, kl.partial_fit):
        with pytest.raises(FitError, match=r"maps of one image are \(4, 3, 5\)"):
            use(np.zeros((2, 4, 3, 5)))
