"""The Karhunen-Loeve transform of feature maps (paper 2.2), in three readings.

================  ======================  ==================  ==============================================
reading           one sample is           eigenproblem        maps (n, h, w, c) become
================  ======================  ==================  ==============================================
`ChannelKL`       a map position          c x c               (n, h, w, k): one local descriptor a position
`FlatKL`          a whole flattened map   m x m, learned      (n, k): one code an image
`SequenceKL`      a whole flattened map   m x m, a sequence   (k, h, w, c): k eigen-images a sequence
================  ======================  ==================  ==============================================

The paper calls the transform "non-linear" and opposes it to PCA. It is neither: it multiplies by a fixed matrix, so it
is linear, and on centred data it is principal component analysis. The first two readings centre; the third
follows Eq. 14, which does not.
"""

from __future__ import annotations

from loopclosure.compression.channel import ChannelKL
from loopclosure.compression.flat import FlatKL
from loopclosure.compression.sequence import SequenceKL
from loopclosure.compression.spectrum import choose_components, energy_share
from loopclosure.errors import ConfigError, did_you_mean

READINGS: dict[str, type[ChannelKL] | type[FlatKL] | type[SequenceKL]] = {
    "channel": ChannelKL,
    "flat": FlatKL,
    "sequence": SequenceKL,
}
"""The table of readings."""


def build(
    reading: str,
    *,
    gamma: float | None = None,
    energy: float | None = None,
    components: int | None = None,
    whiten: bool = False,
) -> ChannelKL | FlatKL | SequenceKL:
    """Return an unfitted transform of this `reading`.

    Raises
    ------
    ConfigError
        For an unknown reading, with the nearest known one.

    Examples
    --------
    >>> build("flat", gamma=0.8).reading
    'flat'
    """
    if reading not in READINGS:
        raise ConfigError(f"unknown reading '{reading}'{did_you_mean(reading, READINGS)}; known: {', '.join(READINGS)}")
    return READINGS[reading](gamma=gamma, energy=energy, components=components, whiten=whiten)


__all__ = ["READINGS", "ChannelKL", "FlatKL", "SequenceKL", "build", "choose_components", "energy_share"]
