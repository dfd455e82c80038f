"""SequenceKL against Eq. 6-14 written as loops."""

import numpy as np
import pytest
from sklearn.decomposition import PCA

from loopclosure.compression import FlatKL, SequenceKL
from loopclosure.errors import FitError

SHAPE = (2, 3, 4)


def some_maps(m=6, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(m, *SHAPE)) * np.linspace(1, 3, m)[:, None, None, None] + 2).astype(np.float32)


def fitted(maps, **rule):
    return SequenceKL(**rule).fit(maps)


def paper(maps):
    """Eq. 6-14 by loops: energies, eigenvectors as rows, all eigen-images; signs are arbitrary."""
    m, n = len(maps), int(np.prod(SHAPE))
    X = [[float(value) for value in image.ravel()] for image in maps]  # Eq. 6
    E = [sum(X[i][j] for i in range(m)) / m for j in range(n)]  # Eq. 8
    C = np.zeros((m, m))
    for a in range(m):
        for b in range(m):
            C[a, b] = sum((X[a][j] - E[j]) * (X[b][j] - E[j]) for j in range(n)) / m  # Eq. 10
    energies, vectors = np.linalg.eigh(C)  # Eq. 11-13
    order = sorted(range(m), key=lambda i: -energies[i])
    Y = [[sum(vectors[a, i] * X[a][j] for a in range(m)) for j in range(n)] for i in order]  # Eq. 14
    return energies[order], vectors.T[order], np.array(Y)


@pytest.mark.parametrize(("gamma", "k"), [(0, 6), (0.2, 5), (0.6, 2), (0.9, 1)])
def test_equals_the_equations(gamma, k):
    maps = some_maps()
    _, _, expected = paper(maps)
    kl = fitted(maps, gamma=gamma)
    found = kl.transform(maps)
    assert found.shape == (k, *SHAPE)
    assert found.dtype == np.float32
    for image, reference in zip(found.reshape(k, -1), expected, strict=False):
        sign = np.sign(image @ reference)
        np.testing.assert_allclose(sign * image, reference, atol=1e-4)


def test_mixing_is_orthonormal_and_equals_the_eigenvectors():
    maps = some_maps()
    _, vectors, _ = paper(maps)
    mixing = fitted(maps, components=4).mixing(maps)
    np.testing.assert_allclose(mixing @ mixing.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(mixing * vectors[:4], axis=1)), 1, atol=1e-9)


def test_energy_rule():
    maps = some_maps()
    energies, _, _ = paper(maps)
    for k in range(1, 6):
        share = energies[:k].sum() / energies.sum()
        assert len(fitted(maps, energy=share - 1e-6).transform(maps)) == k


def test_inverse_with_all_components_is_the_input():
    maps = some_maps()
    kl = fitted(maps, gamma=0)
    np.testing.assert_allclose(kl.inverse_transform(kl.transform(maps), kl.mixing(maps)), maps, atol=1e-5)


def test_inverse_of_fewer_components_lacks_the_mean():
    """Eigenvectors with energy are orthogonal to (1, ..., 1): what all images share is in the last eigen-image."""
    maps = some_maps()
    kl = fitted(maps, components=5)
    rebuilt = kl.inverse_transform(kl.transform(maps), kl.mixing(maps))
    np.testing.assert_allclose(rebuilt, maps - maps.mean(axis=0), atol=1e-4)


def test_is_the_flat_basis_of_the_sequence_scaled_by_its_energy():
    maps = some_maps()
    flat = FlatKL(components=5).fit(maps)
    images = fitted(maps, components=5).transform(maps).reshape(5, -1)
    np.testing.assert_allclose(np.abs(np.sum(images * flat.basis_, axis=1)), np.sqrt(6 * flat.energies_[:5]), rtol=1e-5)


def test_whitened_eigen_images_have_equal_energy():
    maps = some_maps()
    kl = fitted(maps, gamma=0, whiten=True)
    images = kl.transform(maps).reshape(6, -1)
    np.testing.assert_allclose(images[:5] @ images[:5].T / 6, np.eye(5), atol=1e-5)
    assert (images[5] == 0).all()
    rebuilt = kl.inverse_transform(kl.transform(maps), kl.mixing(maps))
    np.testing.assert_allclose(rebuilt, maps - maps.mean(axis=0), atol=1e-4)


def test_signs_do_not_depend_on_the_order_of_frames():
    maps = some_maps(m=9)
    kl = fitted(maps, components=6)
    reference = kl.transform(maps)
    for order in (np.arange(9)[::-1], np.random.default_rng(1).permutation(9)):
        np.testing.assert_allclose(kl.transform(maps[order]), reference, atol=1e-4)


def test_two_runs_past_one_place_agree():
    """A drive sampled twice, at other moments and with noise: the eigen-images match, signs included."""
    rng = np.random.default_rng(0)
    scene = rng.gamma(1.0, size=(3, *SHAPE))

    def run(offset):
        moments = np.linspace(0, 1, 10)[:, None, None, None] + offset
        drive = scene[0] + 3 * moments * scene[1] + np.cos(6 * moments) * scene[2]
        return drive + 0.01 * rng.normal(size=drive.shape)

    kl = fitted(run(0), components=2)
    for offset in (0.0, 0.01, -0.02):
        first, second = kl.transform(run(0)).reshape(2, -1), kl.transform(run(offset)).reshape(2, -1)
        cosines = np.sum(first * second, axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
        assert (cosines > 0.9).all()


def test_eigen_images_agree_with_the_mean_image():
    maps = some_maps()
    images = fitted(maps, components=5).transform(maps).reshape(5, -1)
    assert (images @ maps.mean(axis=0).ravel() >= -1e-4).all()


def test_nothing_is_learned_across_sequences():
    kl = fitted(some_maps(seed=1), components=3)
    np.testing.assert_array_equal(kl.transform(some_maps()), fitted(some_maps(), components=3).transform(some_maps()))


@pytest.mark.parametrize("value", [0.0, 0.1, 1e20])
@pytest.mark.parametrize("whiten", [False, True])
def test_identical_images(value, whiten):
    maps = np.full((5, *SHAPE), value)
    kl = fitted(maps, gamma=0.4, whiten=whiten)
    images = kl.transform(maps)
    assert images.shape == (3, *SHAPE)
    assert np.isfinite(images).all()
    if not whiten:
        mixing = kl.mixing(maps)
        np.testing.assert_allclose(mixing @ mixing.T, np.eye(3), atol=1e-12)
    else:
        assert (images == 0).all()


def test_short_sequences():
    kl = fitted(some_maps(), gamma=0.8)
    assert kl.transform(some_maps()[:0]).shape == (0, *SHAPE)
    np.testing.assert_allclose(kl.transform(some_maps()[:1]), some_maps()[:1])
    with pytest.raises(FitError, match="k = 3 components wanted, 2 images allow at most 2"):
        fitted(some_maps(), components=3).transform(some_maps()[:2])


def test_other_shapes_are_refused():
    kl = fitted(some_maps(), components=2)
    with pytest.raises(FitError, match=r"maps of one image are \(3, 2, 4\)"):
        kl.transform(np.zeros((2, 3, 2, 4)))
    with pytest.raises(FitError, match="2 eigen-images, but 3 rows"):
        kl.inverse_transform(np.zeros((2, *SHAPE)), np.zeros((3, 6)))


def test_energies_equal_pca_of_the_sequence():
    maps = some_maps()
    energies, _, _ = paper(maps)
    pca = PCA(5).fit(maps.reshape(6, -1).astype(float))
    np.testing.assert_allclose(energies[:5], pca.explained_variance_ * 5 / 6, rtol=1e-9)
