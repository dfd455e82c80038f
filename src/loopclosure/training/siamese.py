"""A Siamese network: two branches with shared weights, pairs of images, contrastive loss (paper 2.1)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn import functional

from loopclosure import store
from loopclosure.config import Config, Training
from loopclosure.errors import ConfigError
from loopclosure.features.backbones import Backbone
from loopclosure.images.ahead import in_batches, read_ahead
from loopclosure.images.decode import Image
from loopclosure.methods import METHODS
from loopclosure.training.augment import Augmentation
from loopclosure.training.card import made_from, save_model, write_card
from loopclosure.training.checkpoint import expect
from loopclosure.training.data import TrainingData, open_data
from loopclosure.training.loop import Measures, Progress, run_training
from loopclosure.training.losses import ContrastiveLoss, hardest_pairs
from loopclosure.training.measures import best_threshold, pair_accuracy, place_measures
from loopclosure.training.network import (
    NOTHING,
    TOGETHER,
    autocast,
    freeze,
    inputs_of,
    maps_of,
    open_backbone,
    save_backbone,
)

LEARNING_RATE, MARGIN = 3e-4, 1.0
_MOST_HELD_OUT = 1000  # images; their similarities are one matrix
_HELD_OUT_PAIRS = 1000


class PairBatch(NamedTuple):
    """Pairs of one step.

    Attributes
    ----------
    pairs : ndarray of int64, shape (n, 2)
        Numbers of images.
    same : ndarray of bool, shape (n,)
        Whether a pair shows one place.
    seed : int
        Of the augmentation.
    """

    pairs: np.ndarray
    same: np.ndarray
    seed: int


def train_siamese(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    poses: str | os.PathLike[str] | None = None,
    config: Config | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train the backbone as a Siamese network and write a model folder.

    The model holds the network alone: basis and clusters are learned from the drive, or the reference, as without it.

    Parameters
    ----------
    source, poses
        See `loopclosure.training.data.open_data`.
    out : path
        Model folder, made if it is absent; holds the checkpoints too.
    config : Config, optional
        Its sections `features` and `training` decide.
    resume : bool
        Go on from the last checkpoint in `out`.
    progress : callable, optional
        Told a `TrainingProgress` after each step.

    Returns
    -------
    dict
        The content of ``model_card.json``.

    Raises
    ------
    LoopClosureError
        If data, settings, weights or the checkpoint cannot be used, or the loss is not finite.
    """
    config, folder = config or Config(), Path(out)
    expect(folder, resume=resume)
    if not METHODS[config.method].weights:
        raise ConfigError(
            f"the method '{config.method}' has no network that is trained here; see `loopclosure methods`"
        )
    data = open_data(source, poses=poses, config=config)
    backbone = open_backbone(config)
    layers = list(backbone.module.parts)
    until = config.training.freeze_until or (layers[-2] if len(layers) > 1 else NOTHING)
    freeze(backbone.module, until)
    task = SiameseTask(backbone, data, config)
    training = config.training
    run = run_training(
        task,
        folder,
        training,
        optimizer=torch.optim.AdamW(
            task.parameters.values(), lr=training.learning_rate or LEARNING_RATE, weight_decay=training.weight_decay
        ),
        made_from=made_from(config, backbone, data.summary),
        resume=resume,
        progress=progress,
    )
    save_backbone(backbone, folder / store.TRAINED)
    save_model(folder, config.with_settings({"features.weights": str(folder / store.TRAINED)}))
    return write_card(folder, "siamese", config, backbone=backbone, data=data.summary, run=run)


class SiameseTask:
    """See `loopclosure.training.loop.Task`.

    Parameters
    ----------
    backbone : Backbone
        Its parameters that want a gradient are trained.
    data : TrainingData
    config : Config
    """

    def __init__(self, backbone: Backbone, data: TrainingData, config: Config) -> None:
        self._backbone, self._images, self._training = backbone, data.images, config.training
        self.parameters: Mapping[str, torch.nn.Parameter] = {
            name: value for name, value in backbone.module.named_parameters() if value.requires_grad
        }
        if not self.parameters:
            raise ConfigError(f"training.freeze_until freezes all of {backbone.name}: nothing is left to train")
        rng = np.random.default_rng(self._training.seed)
        self.places, self.held_out = data.places.split(self._training.held_out, rng)
        self._held_pairs, self._held_same = self.held_out.draw(_HELD_OUT_PAIRS, rng)
        if len(self.held_out) > _MOST_HELD_OUT:
            kept = rng.choice(len(self._held_pairs), _MOST_HELD_OUT // 2, replace=False)
            self._held_pairs, self._held_same = self._held_pairs[kept], self._held_same[kept]
        self._loss = ContrastiveLoss(self._training.margin or MARGIN, self._training.distance)
        height, width = backbone.preprocessing.height, backbone.preprocessing.width
        self._augmentation = Augmentation(height, width) if self._training.augment else None

    @property
    def rounds(self) -> int:
        """Rounds in an epoch; an epoch has half as many pairs as there are images, so that it sees about all."""
        return -(-len(self.places) // (2 * self._training.round))

    def plan(self, epoch: int, part: int) -> list[PairBatch]:
        """Draw the pairs of a round, half of them of one place."""
        rng = np.random.default_rng((self._training.seed, epoch, part))
        pairs, same = self.places.draw(max(2, len(self.places) // (2 * self.rounds)), rng)
        size = self._training.batch
        starts = range(0, len(pairs), size)
        return [PairBatch(pairs[i : i + size], same[i : i + size], int(rng.integers(2**31))) for i in starts]

    def loss(self, batch: PairBatch) -> torch.Tensor:
        """Return the contrastive loss of a batch: both images of a pair go through the same weights."""
        numbers = np.unique(batch.pairs)
        images = [self._images[int(number)] for number in numbers]
        if self._augmentation:
            images = self._augmentation(images, seed=batch.seed)
        vectors = _vectors(self._backbone, images, self._training)
        rows = np.searchsorted(numbers, batch.pairs)
        same, different = (tuple(rows[batch.same == kind].T) for kind in (True, False))
        if self._training.pairs != "drawn":
            most = max(1, len(batch.pairs) // 2) if self._training.pairs == "hardest" else None
            known = self.places.relation(numbers, numbers)
            same, different = hardest_pairs(vectors.detach().cpu().numpy(), known, most=most)
        return self._loss(vectors, same, different)

    def validate(self) -> Measures:
        """Measure on held-out images, as they are; ``pair_accuracy`` is at the best threshold for these pairs."""
        numbers = np.unique(self._held_pairs)
        vectors = self.describe(numbers)
        rows = np.searchsorted(numbers, self._held_pairs)
        same, different = (tuple(rows[self._held_same == kind].T) for kind in (True, False))
        similarity = np.einsum("nd,nd->n", vectors[rows[:, 0]], vectors[rows[:, 1]])
        threshold = best_threshold(similarity, self._held_same)
        return {
            "loss": float(self._loss(torch.from_numpy(vectors), same, different)),
            "pair_accuracy": pair_accuracy(similarity, self._held_same, threshold),
            **place_measures(vectors, self.held_out.relation(numbers, numbers)),
        }

    def error(self, measures: Mapping[str, Any]) -> float:
        """Return the share of pairs on the wrong side; the loss is no measure, it counts only what still adds to it."""
        return 1 - measures["pair_accuracy"]

    def describe(self, numbers: np.ndarray) -> np.ndarray:
        """Return the vector of each image, unit float32 (n, c)."""
        return describe_images(self._backbone, (self._images[int(number)] for number in numbers), self._training)


def describe_images(backbone: Backbone, images: Iterable[Image], training: Training) -> np.ndarray:
    """Return the vector by which images are compared: the mean over the map, of length 1, float32 (n, c)."""
    with torch.no_grad():
        vectors = [
            _vectors(backbone, some, training).cpu().numpy() for some in in_batches(read_ahead(images), TOGETHER)
        ]
    return np.concatenate(vectors)


def _vectors(backbone: Backbone, images: Sequence[Image], training: Training) -> torch.Tensor:
    with autocast(training, backbone.device):
        maps = maps_of(backbone.module, inputs_of(backbone, images))
    return functional.normalize(maps.float().mean((2, 3)), dim=-1)
