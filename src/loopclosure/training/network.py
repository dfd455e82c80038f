"""The network that is trained: what stays frozen, where it runs, and the file of weights that it becomes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from safetensors.torch import save_file
from torch import nn

from loopclosure.config import Config, Training
from loopclosure.errors import ConfigError, did_you_mean
from loopclosure.features.backbones import BACKBONES, Backbone, TapChain
from loopclosure.features.checkpoints import read_checkpoint, without
from loopclosure.images.decode import Image
from loopclosure.weights import Progress, locate, weights_for

NOTHING = "nothing"
TOGETHER = 32
"""Images that go through the network at once where nothing is learned."""
_FEW = 4  # images whose early maps stay in a processor's cache; 32 at once take four times as long


def open_backbone(config: Config, *, progress: Progress | None = None) -> Backbone:
    """Open the network that `config.features` names, to be trained where `config.training` says.

    Batch normalisation keeps the statistics of the weights, and nothing is dropped: the network is never in training
    mode, so that it describes an image in training as it will in use.

    Raises
    ------
    ConfigError, WeightsError
        If the settings or the weights cannot be used.
    """
    features, training = config.features, config.training
    backbone = Backbone(
        features.backbone,
        features.layer,
        weights=features.weights,
        height=features.height,
        width=features.width,
        device=chosen_device(training),
        progress=progress,
    )
    default = weights_for(features.backbone)
    if replace(backbone.weights, mean=default.mean, std=default.std, variant=default.variant) != backbone.weights:
        raise ConfigError(
            f"the weights '{backbone.weights_name}' want another input than a file of weights for "
            f"{features.backbone} does; train from the default weights"
        )
    return backbone


def chosen_device(training: Training) -> str:
    """Return the device that ``training.device`` means here."""
    if training.device != "auto":
        return training.device
    return "cuda" if torch.cuda.is_available() else "cpu"


def autocast(training: Training, device: torch.device) -> torch.autocast:
    """Return the context of a forward pass: mixed precision where it is asked for or the GPU has it."""
    wanted = training.precision == "bfloat16"
    if training.precision == "auto" and device.type == "cuda":
        wanted = torch.cuda.is_bf16_supported()
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted)


def freeze(chain: TapChain, until: str) -> None:
    """Let only the parts behind the layer `until` learn; `NOTHING` lets all of them.

    Raises
    ------
    ConfigError
        If there is no such layer.
    """
    names = list(chain.parts)
    if until != NOTHING and until not in names:
        raise ConfigError(
            f"training.freeze_until = '{until}'{did_you_mean(until, names)}; known here: {', '.join(names)}, {NOTHING}"
        )
    frozen = names.index(until) + 1 if until != NOTHING else 0
    for place, name in enumerate(names):
        chain.parts[name].requires_grad_(place >= frozen)


def inputs_of(backbone: Backbone, images: Sequence[Image]) -> torch.Tensor:
    """Return the input of ``backbone.module``, float32 (n, 3, height, width), on its device."""
    batch = torch.from_numpy(backbone.preprocessing.batch(images))
    return batch.to(backbone.device, memory_format=torch.channels_last)


def maps_of(chain: TapChain, inputs: torch.Tensor) -> torch.Tensor:
    """Return the map of the last layer, float (n, c, h, w).

    On a CPU the layers before the first that learns see a few images at a time; so do all where no gradient is wanted.

    Parameters
    ----------
    chain : TapChain
        With one tap.
    inputs : Tensor of float32, shape (n, 3, height, width)
    """
    parts = list(chain.parts.values())
    learning = (torch.is_grad_enabled() and any(p.requires_grad for p in part.parameters()) for part in parts)
    frozen = next((place for place, learns in enumerate(learning) if learns), len(parts))
    before, behind = nn.Sequential(*parts[:frozen]), nn.Sequential(*parts[frozen:])
    together = _FEW if inputs.device.type == "cpu" else len(inputs)
    with torch.no_grad():
        maps = torch.cat([before(some) for some in inputs.split(together)])
    return cast(torch.Tensor, behind(maps))


def save_backbone(backbone: Backbone, path: Path) -> None:
    """Write the network as a file of weights that `Backbone` reads; it appears only when it is whole.

    Layers behind the tap are those of the weights that training began with, zeros where these were random.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    save_file({key: value.cpu().contiguous() for key, value in _whole_state(backbone).items()}, part)
    os.replace(part, path)


def _whole_state(backbone: Backbone) -> dict[str, torch.Tensor]:
    """Return the tensors of the whole network by the names that its own file has."""
    architecture, size = BACKBONES[backbone.name], (backbone.preprocessing.height, backbone.preprocessing.width)
    with torch.device("meta"):
        network: nn.Module = architecture.network(*size, backbone.weights.variant)
        parts = dict(zip(architecture.layers, architecture.cut(network), strict=True))
        chain = TapChain(parts, backbone.layers)
    wanted = without(network.state_dict(keep_vars=True), architecture.heads)
    if backbone.random:
        state = {key: torch.zeros(value.shape, dtype=value.dtype) for key, value in wanted.items()}
    else:
        state = without(read_checkpoint(locate(backbone.weights)), architecture.heads)
    # The chain is cut from the network: what is one tensor in both has a name in each.
    names = {id(value): key for key, value in wanted.items()}
    trained = backbone.module.state_dict()
    return state | {
        names[id(value)]: trained[key] for key, value in chain.state_dict(keep_vars=True).items() if id(value) in names
    }
