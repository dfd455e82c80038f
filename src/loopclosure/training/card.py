"""The folder that a training leaves: a model for ``LoopDetector(model=folder)``, and a card that says how."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure import __version__, store
from loopclosure.config import Config
from loopclosure.features.backbones import Backbone
from loopclosure.methods import build_method
from loopclosure.training.loop import Run

CARD = "model_card.json"
_PACKAGES = ("numpy", "pytorch-metric-learning", "torch", "torchvision")


def made_from(config: Config, backbone: Backbone, data: str) -> dict[str, Any]:
    """Return everything that decides the numbers of a training; how long it goes on does not."""
    decisive = (
        "features.",
        "compression.",
        "aggregation.clusters",
        "learning.",
        "training.",
        "sequence.exclude_recent",
    )
    free = ("training.epochs", "training.patience", "features.backend", "features.weights")
    settings = config.flat().items()
    kept = {name: value for name, value in settings if name.startswith(decisive) and name not in free}
    kept["learning.refit_at"] = list(kept["learning.refit_at"])  # as JSON gives it back
    return {**kept, "weights": backbone.weights_name, "sha256": backbone.weights_sha256, "data": data}


def save_model(
    folder: Path, config: Config, *, arrays: Mapping[str, np.ndarray] | None = None, learned_on: str = ""
) -> None:
    """Write a model that a detector loads.

    Parameters
    ----------
    folder : pathlib.Path
        Holds ``backbone.safetensors`` where `config` names it.
    config : Config
        What the detector is to run with.
    arrays : mapping, optional
        What its method has learned; None where it learns from the drive or the reference, as without a model.
    learned_on : str
        What `arrays` were learned on.
    """
    header = {
        "config": store.carry_weights(config, folder).model_dump(),
        "learned_on": [learned_on] if arrays is not None else [],
        "provenance": build_method(config).provenance,
        "fitted": arrays is not None,
    }
    store.save_arrays(folder, kind="model", header=header, arrays=arrays or {})


def write_card(folder: Path, kind: str, config: Config, *, backbone: Backbone, data: str, run: Run) -> dict[str, Any]:
    """Write ``model_card.json`` and return its content.

    Parameters
    ----------
    kind : str
        ``siamese`` or ``netvlad``.
    backbone : Backbone
        With the weights that training began with.
    data : str
        What it was trained on.
    run : Run
        What it came to.
    """
    card = {
        "kind": kind,
        "data": data,
        "seed": config.training.seed,
        "best_epoch": run.best_epoch,
        "before": run.history[0],
        "after": run.best,
        "history": run.history,
        "parent_weights": {
            "name": backbone.weights_name,
            "sha256": backbone.weights_sha256,
            "licence": backbone.weights.licence,
            "source": backbone.weights.source,
        },
        "config": config.model_dump(mode="json"),
        "device": str(backbone.device),
        "versions": {
            "loopclosure": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in _PACKAGES},
        },
    }
    part = folder / f"{CARD}.part"
    part.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    os.replace(part, folder / CARD)
    return card
