"""A second Karhunen-Loeve transform, behind NetVLAD: few numbers a place, and what all share counts less.

Compressing local vectors (paper 2.2) leaves a NetVLAD descriptor of K * D numbers in which the commonest directions,
road, sky and the backs of vehicles, weigh most. Whitened, they weigh as little as the rare ones that tell places apart
(Jegou and Chum 2012).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopclosure.aggregation.netvlad import unit
from loopclosure.compression import FlatKL
from loopclosure.errors import FitError


class Reduction:
    """Centred descriptors to whitened unit vectors of few numbers.

    A descriptor may be of several parts, one behind the other, each of which is whitened by itself and then scaled to
    its weight. Two different places are then as alike by chance in the one part as in the other, whatever the parts
    were made of, so that one weight can do for all drives.

    A variance is raised by the mean variance of all directions before it is divided out: a basis that few frames were
    seen for must not blow up its weakest directions.

    Parameters
    ----------
    components : int
        Numbers a part; fewer where it is fitted on as few frames.
    weights : sequence of float
        One a part.

    Examples
    --------
    >>> descriptors = unit(np.random.default_rng(0).normal(size=(50, 300)).astype(np.float32))
    >>> Reduction(16).fit(descriptors).transform(descriptors[0]).shape
    (16,)
    >>> Reduction(16, weights=(1.0, 0.5)).fit(descriptors, sizes=(200, 100)).transform(descriptors[0]).shape
    (32,)
    """

    def __init__(self, components: int, *, weights: Sequence[float] = (1.0,)) -> None:
        self.components = components
        self.weights = tuple(weights)

    def fit(self, descriptors: np.ndarray, *, sizes: Sequence[int] | None = None) -> Reduction:
        """Learn the bases.

        Parameters
        ----------
        descriptors : ndarray of float32, shape (n, d)
            Centred; at least three.
        sizes : sequence of int, optional
            Numbers of each part, d in all; not needed where there is one.

        Raises
        ------
        FitError
            If there are fewer, or the sizes do not fit.
        """
        if len(descriptors) < 3:
            raise FitError(f"{len(descriptors)} descriptors, wanted at least 3 to learn what they have in common")
        sizes = sizes or (descriptors.shape[1],)
        if sum(sizes) != descriptors.shape[1] or len(sizes) != len(self.weights):
            raise FitError(
                f"parts of {list(sizes)} numbers, wanted {len(self.weights)} that make {descriptors.shape[1]} together"
            )
        edges = np.cumsum(sizes)[:-1]
        fitted = [self._whitening(part) for part in np.split(descriptors, edges, axis=1)]
        self.bases_ = [basis for basis, _ in fitted]
        self.energies_ = [energies for _, energies in fitted]
        return self

    def _whitening(self, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kl = FlatKL(components=min(self.components, len(part) - 2))
        kl.fit(unit(part)[:, None, None, :])
        energies = kl.energies_
        scale = 1 / np.sqrt(energies[: kl.n_components_] + max(energies.mean(), np.finfo(np.float32).tiny))
        return (kl.basis_ * scale[:, None]).astype(np.float32), energies

    def transform(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the unit vector, float32 (k,), of one centred descriptor, float32 (d,); zeros stay zeros."""
        if not hasattr(self, "bases_"):
            raise FitError("the reduction has no basis yet; call fit first")
        parts = np.split(descriptor, np.cumsum([basis.shape[1] for basis in self.bases_])[:-1])
        whitened = [
            weight * unit(basis @ part) for weight, basis, part in zip(self.weights, self.bases_, parts, strict=True)
        ]
        return unit(np.concatenate(whitened).astype(np.float32))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        bases = {f"basis{i}": basis for i, basis in enumerate(self.bases_)}
        return bases | {f"energies{i}": energies for i, energies in enumerate(self.energies_)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], *, weights: Sequence[float] = (1.0,)) -> Reduction:
        """Rebuild what `to_arrays` gave."""
        reduction = cls(len(arrays["basis0"]), weights=weights)
        reduction.bases_ = [arrays[f"basis{i}"] for i in range(len(weights))]
        reduction.energies_ = [arrays[f"energies{i}"] for i in range(len(weights))]
        return reduction
