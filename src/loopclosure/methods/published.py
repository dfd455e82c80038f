"""A published VGG16-NetVLAD as a model folder: its network among the weights, its clusters for `netvlad-vgg16`."""

from __future__ import annotations

import os

from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import WeightsError
from loopclosure.features.importing import ImportedWeights, import_weights


def import_netvlad(
    file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    name: str | None = None,
    backbone: str | None = None,
    licence: str | None = None,
) -> ImportedWeights:
    """Import the network of a NetVLAD file and write its clusters as a model, for ``LoopDetector(model=out)``.

    The PCA-whitening of such a file is not applied.

    Parameters
    ----------
    file : path
        ``.mat``, see `loopclosure.features.netvlad_matlab`.
    out : path
        Model folder; made if it is absent.
    name, backbone, licence : str, optional
        As for `import_weights`.

    Raises
    ------
    WeightsError
        As `import_weights`, and if the file holds no clusters.
    """
    imported = import_weights(file, name=name, backbone=backbone, licence=licence)
    if not imported.clusters:
        raise WeightsError(f"{file} holds no NetVLAD clusters: no model to write")
    settings = {
        "method": "netvlad-vgg16",
        "features.weights": imported.weights.name,
        "aggregation.clusters": len(imported.clusters["centres"]),
    }
    detector = LoopDetector(Config().with_settings(settings))
    detector.method.restore({f"netvlad.{key}": array for key, array in imported.clusters.items()})
    whitening = f"; its whitening to {imported.whitened} numbers is not applied" if imported.whitened else ""
    detector.learned_on = [f"{imported.weights.source}, sha256 {imported.source_sha256}{whitening}"]
    detector.save_model(out)
    return imported
