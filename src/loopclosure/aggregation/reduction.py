"""A second Karhunen-Loeve transform behind NetVLAD: few numbers a place, and what all share counts less.

Compressing local vectors (paper 2.2) leaves a NetVLAD descriptor of K * D numbers in which the commonest directions,
road, sky and the backs of vehicles, weigh most. Whitened, they weigh as little as the rare ones that tell places apart
(Jegou and Chum 2012).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.aggregation.netvlad import unit
from loopclosure.compression import FlatKL
from loopclosure.errors import FitError


class Reduction:
    """Centred descriptors to whitened unit vectors of at most `components` numbers.

    A variance is raised by the mean variance of all directions before it is divided out: a basis that few frames were
    seen for must not blow up its weakest directions.

    Parameters
    ----------
    components : int
        Numbers a descriptor; fewer where it is fitted on as few frames.

    Examples
    --------
    >>> descriptors = unit(np.random.default_rng(0).normal(size=(50, 300)).astype(np.float32))
    >>> Reduction(16).fit(descriptors).transform(descriptors[0]).shape
    (16,)
    """

    def __init__(self, components: int) -> None:
        self.components = components

    def fit(self, descriptors: np.ndarray) -> Reduction:
        """Learn the basis.

        Parameters
        ----------
        descriptors : ndarray of float32, shape (n, d)
            Centred, unit rows; at least three.

        Raises
        ------
        FitError
            If there are fewer.
        """
        if len(descriptors) < 3:
            raise FitError(f"{len(descriptors)} descriptors, wanted at least 3 to learn what they have in common")
        kl = FlatKL(components=min(self.components, len(descriptors) - 2))
        kl.fit(descriptors[:, None, None, :])
        energies = kl.energies_
        scale = 1 / np.sqrt(energies[: kl.n_components_] + max(energies.mean(), np.finfo(np.float32).tiny))
        self.basis_ = (kl.basis_ * scale[:, None]).astype(np.float32)
        self.energies_ = energies
        return self

    def transform(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the unit vector, float32 (k,), of one centred descriptor, float32 (d,); zeros stay zeros."""
        if not hasattr(self, "basis_"):
            raise FitError("the reduction has no basis yet; call fit first")
        return unit(self.basis_ @ descriptor)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        return {"basis": self.basis_, "energies": self.energies_}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Reduction:
        """Rebuild what `to_arrays` gave."""
        reduction = cls(len(arrays["basis"]))
        reduction.basis_, reduction.energies_ = arrays["basis"], arrays["energies"]
        return reduction
