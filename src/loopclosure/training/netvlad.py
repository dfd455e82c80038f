"""NetVLAD by the weakly supervised triplet ranking loss (paper 2.3; Arandjelovic et al. 2016, section 4)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import nn

from loopclosure import store
from loopclosure.aggregation.centring import centre_traverse
from loopclosure.aggregation.layout import layout
from loopclosure.aggregation.netvlad import NetVLAD
from loopclosure.aggregation.netvlad_torch import NetVLADLayer
from loopclosure.aggregation.reduction import Reduction
from loopclosure.compression import ChannelKL
from loopclosure.config import Config
from loopclosure.errors import ConfigError, FitError
from loopclosure.features.backbones import Backbone, TapChain
from loopclosure.images.ahead import in_batches, read_ahead
from loopclosure.images.decode import Image
from loopclosure.training.augment import Augmentation
from loopclosure.training.card import made_from, save_model, write_card
from loopclosure.training.checkpoint import expect
from loopclosure.training.data import Images, TrainingData, open_data
from loopclosure.training.loop import Measures, Progress, run_training
from loopclosure.training.losses import TripletRankingLoss, hardest_triplets
from loopclosure.training.measures import place_measures
from loopclosure.training.network import TOGETHER, autocast, freeze, inputs_of, maps_of, open_backbone, save_backbone
from loopclosure.training.places import DIFFERENT, SAME, UNKNOWN, PosedPlaces

LEARNING_RATE, MARGIN = 1e-4, 0.1
METHODS = ("kl-netvlad", "netvlad-resnet152", "netvlad-vgg16")
_MOST_HELD_OUT = 1000  # frames; their similarities are one matrix


class TripletBatch(NamedTuple):
    """Triplets of one step.

    Attributes
    ----------
    triplets : ndarray of int64, shape (n, 3)
        Frames: query, best potential positive, hard negative.
    seed : int
        Of the augmentation.
    """

    triplets: np.ndarray
    seed: int


def train_netvlad(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    poses: str | os.PathLike[str],
    config: Config | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train the NetVLAD layer, and the layers below it if ``training.freeze_until`` says so, on a drive with poses.

    The KL basis is fitted first and stays; the clusters begin where k-means puts them.

    Parameters
    ----------
    source : path
        Folder of images in order, or a text file of paths.
    out : path
        Model folder, made if it is absent; holds the checkpoints too.
    poses : path
        ``frame,x,y[,z]``, TUM or KITTI, one pose a frame.
    config, resume, progress
        See `loopclosure.training.siamese.train_siamese`.

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
    if config.method not in METHODS or config.compression.reading not in ("channel", "none"):
        raise ConfigError(
            f"method {config.method} with compression.reading = {config.compression.reading} has no NetVLAD layer "
            f"that is trained here; wanted {' or '.join(METHODS)} with channel or none"
        )
    data = open_data(source, poses=poses, config=config)
    backbone, training = open_backbone(config), config.training
    freeze(backbone.module, training.freeze_until or list(backbone.module.parts)[-1])
    task = NetVLADTask(backbone, data, config)
    run = run_training(
        task,
        folder,
        training,
        optimizer=torch.optim.SGD(
            task.parameters.values(),
            lr=training.learning_rate or LEARNING_RATE,
            momentum=training.momentum,
            weight_decay=training.weight_decay,
        ),
        made_from=made_from(config, backbone, data.summary),
        resume=resume,
        progress=progress,
    )
    used = config
    if task.trains_backbone:
        save_backbone(backbone, folder / store.TRAINED)
        used = config.with_settings({"features.weights": str(folder / store.TRAINED)})
    save_model(folder, used, arrays=task.to_arrays(), learned_on=data.summary)
    return write_card(folder, "netvlad", config, backbone=backbone, data=data.summary, run=run)


class Describer(nn.Module):  # type: ignore[misc]
    """Images or codes to unit descriptors: the backbone, the fixed KL transform, the NetVLAD layer.

    Parameters
    ----------
    chain : TapChain
        With one tap.
    kl : ChannelKL or None
        Fitted; None for none.
    fitted : NetVLAD
        Where the layer starts.
    """

    def __init__(self, chain: TapChain, kl: ChannelKL | None, fitted: NetVLAD) -> None:
        super().__init__()
        self.chain = chain
        self.layer = NetVLADLayer(fitted)
        matrix = offset = None
        if kl is not None:
            # The transform is affine: what it makes of zero and of the unit vectors tells all of it.
            at_zero = kl.transform(np.zeros((1, len(kl.mean_))))
            at_units = kl.transform(np.eye(len(kl.mean_)))
            matrix = torch.from_numpy(np.ascontiguousarray((at_units - at_zero).T))[:, :, None, None]
            offset = torch.from_numpy(at_zero[0])
        self.register_buffer("matrix", matrix)
        self.register_buffer("offset", offset)

    def codes(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return what the KL transform makes of the maps of a network input, float (n, D, h, w)."""
        maps = maps_of(self.chain, inputs)
        return maps.float() if self.matrix is None else nn.functional.conv2d(maps.float(), self.matrix, self.offset)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the descriptors of a network input, unit float (n, K * D)."""
        return cast(torch.Tensor, self.layer(self.codes(inputs)))


class NetVLADTask:
    """See `loopclosure.training.loop.Task`.

    Where the backbone is frozen, codes are computed once and kept in memory, and images are not augmented.

    Parameters
    ----------
    backbone : Backbone
        Its parameters that want a gradient are trained, beside those of the layer.
    data : TrainingData
        With poses.
    config : Config
    """

    def __init__(self, backbone: Backbone, data: TrainingData, config: Config) -> None:
        self._backbone, self._images, self._training = backbone, data.images, config.training
        everything = cast(PosedPlaces, data.places)
        rng = np.random.default_rng(self._training.seed)
        self.places, self.held_out = everything.split(self._training.held_out, rng)
        self._queries = self.places.anchors(SAME)
        if not len(self._queries) or not len(self.held_out.anchors(SAME)):
            raise FitError(
                "learned or held-out frames have no other visit left: use a longer drive, or another training.held_out"
            )
        self._members = everything.members
        self._aggregation = config.aggregation
        self.kl, netvlad = _fitted(backbone, data.images, self.places.members, config)
        self.network = Describer(backbone.module, self.kl, netvlad).to(backbone.device)
        self.parameters: Mapping[str, torch.nn.Parameter] = {
            name: value for name, value in self.network.named_parameters() if value.requires_grad
        }
        self.trains_backbone = any(name.startswith("chain.") for name in self.parameters)
        self._codes = None if self.trains_backbone else self._all_codes()
        self._loss = TripletRankingLoss(self._margin)
        size = backbone.preprocessing
        self._augmentation = Augmentation(size.height, size.width) if self._training.augment else None

    @property
    def _margin(self) -> float:
        return self._training.margin or MARGIN

    @property
    def rounds(self) -> int:
        """Rounds in an epoch: descriptors to mine from are renewed after each ``training.round`` queries."""
        return -(-len(self._queries) // self._training.round)

    def plan(self, epoch: int, part: int) -> list[TripletBatch]:
        """Describe all frames and choose the hardest triplets of this round's queries."""
        training = self._training
        order = np.random.default_rng((training.seed, epoch)).permutation(self._queries)
        rng = np.random.default_rng((training.seed, epoch, part))
        descriptors = self.describe(self.places.members)
        chosen = []
        for query in order[part * training.round : (part + 1) * training.round]:
            triplets = self._mine(int(query), descriptors, rng)
            if len(triplets):
                chosen.append(triplets)
        return [
            TripletBatch(np.concatenate(some), int(rng.integers(2**31))) for some in in_batches(chosen, training.batch)
        ]

    def loss(self, batch: TripletBatch) -> torch.Tensor:
        """Return the ranking loss of a batch."""
        frames, rows = np.unique(batch.triplets, return_inverse=True)
        return self._loss(self._vectors(frames, seed=batch.seed), rows.reshape(batch.triplets.shape))

    def validate(self) -> Measures:
        """Measure on the held-out stretch; the loss is that of each query with its hardest negatives."""
        members = self.held_out.members[:_MOST_HELD_OUT]
        descriptors = self.describe(members)
        relation = self.held_out.relation(members, members)
        similarity = descriptors @ descriptors.T
        total = 0.0
        queries = np.flatnonzero((relation == SAME).any(axis=1))
        for query in queries:
            triplets = hardest_triplets(
                int(query), similarity[query], relation[query], negatives=self._training.negatives, margin=self._margin
            )
            total += sum(2 * (similarity[q, n] - similarity[q, p]) + self._margin for q, p, n in triplets)
        return {"loss": float(total) / max(1, len(queries)), **place_measures(descriptors, relation)}

    def error(self, measures: Mapping[str, Any]) -> float:
        """Return the held-out loss."""
        return float(measures["loss"])

    def describe(self, frames: np.ndarray) -> np.ndarray:
        """Return the descriptor of each frame, unit float32 (n, K * D)."""
        with torch.no_grad():
            return np.concatenate(
                [self._vectors(np.array(some)).cpu().numpy() for some in in_batches(frames, TOGETHER)]
            )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what `KLNetVLAD` restores, learned on the whole drive, and the mean that a detector begins with."""
        layer = self.network.layer.to_numpy()
        arrays = {f"netvlad.{name}": array for name, array in layer.to_arrays().items()}
        if self.kl is not None:
            arrays |= {f"kl.{name}": array for name, array in self.kl.to_arrays().items()}
        parts, weights = self._parts(), self._aggregation.part_weights
        centred, mean = centre_traverse(np.hstack(parts), window=1)
        if self._aggregation.whitened:
            sizes = [part.shape[1] for part in parts]
            reduction = Reduction(self._aggregation.components, weights=weights).fit(centred, sizes=sizes)
            arrays |= {f"reduction.{name}": array for name, array in reduction.to_arrays().items()}
        return arrays | ({} if mean is None else {"mean_of_fit": mean})

    def _parts(self) -> list[np.ndarray]:
        """Return NetVLAD, and the layout where `KLNetVLAD` puts that beside it, of each frame of the drive."""
        found: list[list[np.ndarray]] = [[] for _ in self._aggregation.part_weights]
        with torch.no_grad():
            for some in in_batches(self._members, TOGETHER):
                codes = self._codes_of(np.array(some))
                found[0].append(self.network.layer(codes).cpu().numpy())
                if len(found) > 1:
                    found[1].append(layout(codes.permute(0, 2, 3, 1).float().cpu().numpy()))
        return [np.concatenate(part) for part in found]

    def _mine(self, query: int, descriptors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        members = self.places.members
        row = int(np.searchsorted(members, query))
        known = self.places.relation(np.array([query]), members)[0]
        negatives = np.flatnonzero(known == DIFFERENT)
        if len(negatives) > self._training.pool:
            left_out = rng.permutation(negatives)[self._training.pool :]
            known[left_out] = UNKNOWN
        triplets = hardest_triplets(
            row, descriptors @ descriptors[row], known, negatives=self._training.negatives, margin=self._margin
        )
        return members[triplets]

    def _all_codes(self) -> torch.Tensor:
        with torch.no_grad():
            codes = [self._code(some) for some in in_batches(self._read(self._members), TOGETHER)]
        return torch.cat(codes)

    def _code(self, images: list[Image]) -> torch.Tensor:
        with autocast(self._training, self._backbone.device):
            return self.network.codes(inputs_of(self._backbone, images))

    def _vectors(self, frames: np.ndarray, *, seed: int | None = None) -> torch.Tensor:
        """Describe frames; with a seed, frames that are seen otherwise."""
        return cast(torch.Tensor, self.network.layer(self._codes_of(frames, seed=seed)))

    def _codes_of(self, frames: np.ndarray, *, seed: int | None = None) -> torch.Tensor:
        if self._codes is not None:
            rows = torch.from_numpy(np.searchsorted(self._members, frames)).to(self._codes.device)
            return self._codes[rows]
        images = list(self._read(frames))
        if seed is not None and self._augmentation:
            images = self._augmentation(images, seed=seed)
        return self._code(images)

    def _read(self, frames: Iterable[int]) -> Iterator[Image]:
        return read_ahead(self._images[int(frame)] for frame in frames)


def _fitted(
    backbone: Backbone, images: Images, members: np.ndarray, config: Config
) -> tuple[ChannelKL | None, NetVLAD]:
    """Fit the KL basis and then k-means on evenly spaced frames."""
    most = min(len(members), config.learning.fit_frames)
    chosen = members[np.unique(np.linspace(0, len(members) - 1, most).round().astype(int))]
    layer = config.features.layer
    read = (images[int(frame)] for frame in chosen)
    maps = np.concatenate([backbone.maps(some)[layer] for some in in_batches(read, TOGETHER)])
    kl = None
    if config.compression.reading == "channel":
        kl = ChannelKL(**config.compression.model_dump(exclude={"reading"})).fit(maps)
        maps = kl.transform(maps)
    return kl, NetVLAD(config.aggregation.clusters, seed=config.learning.seed).fit(maps)
