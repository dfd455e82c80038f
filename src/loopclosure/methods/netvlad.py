"""NetVLAD without the Karhunen-Loeve transform, the baseline that shows what the transform does."""

from __future__ import annotations

from collections.abc import Callable

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.methods.kl_netvlad import KLNetVLAD


def netvlad(config: Config, *, progress: Callable[[int, int], None] | None = None) -> KLNetVLAD:
    """Build `netvlad-resnet152` or `netvlad-vgg16`: `KLNetVLAD` with the reading ``none``.

    Deviations from Arandjelovic et al. 2016: clusters come from k-means on the frames at hand, not from training, no
    PCA-whitening follows, and the running mean is taken out as in the method that it is compared with.

    Raises
    ------
    ConfigError
        If the settings ask for compression.
    """
    if config.compression.reading != "none":
        raise ConfigError(
            f"compression.reading = '{config.compression.reading}': {config.method} has no compression; "
            f"that is --method kl-netvlad --backbone {config.features.backbone}"
        )
    method = KLNetVLAD(config, progress=progress)
    method.threshold = 0.6
    return method
