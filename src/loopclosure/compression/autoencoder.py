"""A small dense autoencoder, the learned rival of the Karhunen-Loeve transform of the same size."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from torch import nn

from loopclosure.compression.spectrum import check_rule
from loopclosure.errors import FitError, ModelError

_STEPS = 400
_BATCH = 512  # together with the steps this bounds a fit: seconds, however many samples there are
_RATE = 3e-3
_ROUNDING = 1e-6  # samples that differ less are equal


class Autoencoder:
    """Compress local vectors through a bottleneck of two dense layers, trained to bring them back.

    ``code = W2 tanh(W1 (y - mean) / scale + b1) + b2`` with a hidden layer twice as wide as the code, and its mirror
    image for the way back. The code has the length that `ChannelKL` gives it: ``round((1 - gamma) * c)``.

    Parameters
    ----------
    gamma : float, optional
        Share of the length that is cut away.
    components : int, optional
        Length of the code, in place of `gamma`. A share of the energy cannot be asked for: there is no spectrum.
    seed : int
        Of the first weights and of the samples of each step.

    Attributes
    ----------
    mean_ : ndarray of float32, shape (c,)
        Mean of the samples.
    scale_ : ndarray of float32, shape ()
        Their standard deviation over all channels.
    weights_ : list of 2 (ndarray, ndarray)
        Matrix and offset of each layer of the encoder.

    Raises
    ------
    ConfigError
        Unless exactly one of `gamma` and `components` is given.

    References
    ----------
    Hinton & Salakhutdinov, "Reducing the dimensionality of data with neural networks", Science 313, 2006.

    Examples
    --------
    >>> maps = np.random.default_rng(0).normal(size=(4, 7, 7, 16)).astype(np.float32)
    >>> Autoencoder(gamma=0.75).fit(maps).transform(maps).shape
    (4, 7, 7, 4)
    """

    def __init__(self, *, gamma: float | None = None, components: int | None = None, seed: int = 0) -> None:
        check_rule(gamma=gamma, energy=None, components=components)
        self.gamma = gamma
        self.components = components
        self.seed = seed

    def fit(self, maps: np.ndarray) -> Autoencoder:
        """Train on local vectors.

        Parameters
        ----------
        maps : ndarray of float, shape (..., c)
            Every position is a sample.

        Raises
        ------
        FitError
            If there is no sample, or a code would be longer than a sample.
        """
        rows = np.asarray(maps, np.float32).reshape(-1, maps.shape[-1])
        if not len(rows):
            raise FitError("found no local vectors to train the autoencoder on")
        if not np.isfinite(rows).all():
            raise FitError("the local vectors hold values that are not finite")
        self.mean_ = rows.mean(0, dtype=np.float64).astype(np.float32)
        deviation = float(rows.std(dtype=np.float64))
        self.scale_ = np.float32(deviation if deviation > _ROUNDING * np.abs(rows).max() else 1)
        layers = _train((rows - self.mean_) / self.scale_, self._length(rows.shape[1]), self.seed)
        self.weights_ = [(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers[:2]]
        return self

    def transform(self, maps: np.ndarray) -> np.ndarray:
        """Encode local vectors.

        Parameters
        ----------
        maps : ndarray of float, shape (..., c)

        Returns
        -------
        ndarray of float32, shape (..., k)

        Raises
        ------
        FitError
            If nothing was fitted, or for another c.
        """
        if not hasattr(self, "mean_"):
            raise FitError("the autoencoder is used before it was fitted: call fit first")
        if maps.shape[-1] != len(self.mean_):
            raise FitError(
                f"local vectors have {maps.shape[-1]} dimensions, the autoencoder {len(self.mean_)}; "
                "were they made by the same network?"
            )
        (inner, inner_bias), (outer, outer_bias) = self.weights_
        hidden = np.tanh((np.asarray(maps, np.float32) - self.mean_) / self.scale_ @ inner.T + inner_bias)
        return hidden @ outer.T + outer_bias

    def _length(self, width: int) -> int:
        length = self.components or max(1, round((1 - (self.gamma or 0)) * width))
        if length > width:
            raise FitError(f"found local vectors of {width} numbers, wanted at least the {length} of a code")
        return length

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        matrices = {f"matrix{i}": matrix for i, (matrix, _) in enumerate(self.weights_)}
        offsets = {f"offset{i}": offset for i, (_, offset) in enumerate(self.weights_)}
        return {"mean": self.mean_, "scale": np.asarray(self.scale_), **matrices, **offsets}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Autoencoder:
        """Take over what `to_arrays` gave.

        Raises
        ------
        ModelError
            If the arrays do not fit together.
        """
        try:
            self.mean_, self.scale_ = arrays["mean"], np.float32(arrays["scale"])
            self.weights_ = [(arrays[f"matrix{i}"], arrays[f"offset{i}"]) for i in range(2)]
            self.transform(self.mean_)
        except (KeyError, ValueError, TypeError) as error:
            raise ModelError(f"the saved autoencoder is damaged: {error}") from None
        return self


def _train(rows: np.ndarray, length: int, seed: int) -> list[nn.Linear]:
    """Return the two layers of the encoder and the two of the decoder; the global random state is left alone."""
    generator = torch.Generator().manual_seed(seed)
    sizes = (rows.shape[1], 2 * length, length, 2 * length, rows.shape[1])
    layers = [_layer(wide, narrow, generator) for wide, narrow in pairwise(sizes)]
    network = nn.Sequential(layers[0], nn.Tanh(), layers[1], layers[2], nn.Tanh(), layers[3])
    optimizer = torch.optim.Adam(network.parameters(), lr=_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
    samples = torch.from_numpy(rows)
    for _ in range(_STEPS):
        batch = samples[torch.randint(len(samples), (_BATCH,), generator=generator)]
        loss = nn.functional.mse_loss(network(batch), batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return layers


def _layer(width: int, out: int, generator: torch.Generator) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, width, out)  # the usual start would draw from the global generator
    with torch.no_grad():
        layer.weight.normal_(0, width**-0.5, generator=generator)
        layer.bias.zero_()
    return layer
