"""Weights from elsewhere into the cache, checked tensor by tensor, under a name that ``--weights`` takes."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from loopclosure.errors import WeightsError, did_you_mean
from loopclosure.features.backbones import BACKBONES, MIN_SIDE
from loopclosure.features.caffe_networks import translate
from loopclosure.features.caffemodel import Window, read_caffemodel
from loopclosure.features.checkpoints import check_file, load_strictly, misfits, read_checkpoint, without
from loopclosure.features.netvlad_matlab import read_netvlad
from loopclosure.weights import DEFAULTS, RANDOM, WEIGHTS, Weights, cache_folder, file_sha256
from loopclosure.weights.imported import is_name, tensors_file, write_record

_DAMAGE = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, struct.error, zlib.error)
_SUFFIXES = (".tar", ".pth", ".pt", ".safetensors", ".caffemodel", ".mat")
_UNIT_STD = (1 / 255,) * 3  # the network sees 0..255


@dataclass(frozen=True)
class ImportedWeights:
    """What an import came to.

    Attributes
    ----------
    weights : Weights
        The record under which the weights can now be used.
    source_sha256 : str
        Digest of the file that was imported.
    taken, left_out : dict of str to int
        Number of tensors by part of the network; left out are classifiers.
    clusters : dict of str to ndarray of float32
        Those of a NetVLAD file, as `loopclosure.aggregation.netvlad.NetVLAD` has them; empty for other files.
    whitened : int
        Length to which the PCA-whitening of a NetVLAD file, which is not applied, would bring descriptors; or 0.
    """

    weights: Weights
    source_sha256: str
    taken: dict[str, int]
    left_out: dict[str, int]
    clusters: dict[str, np.ndarray]
    whitened: int


@dataclass(frozen=True)
class _Content:
    """What a file holds, in torchvision's terms; without a mean, the network's default normalisation applies."""

    tensors: Mapping[str, torch.Tensor]
    variant: str = ""
    mean: tuple[float, float, float] | None = None
    windows: Mapping[str, Window] = field(default_factory=dict)
    pools: tuple[tuple[int, int, int], ...] = ()
    clusters: Mapping[str, np.ndarray] = field(default_factory=dict)
    whitened: int = 0


def import_weights(
    file: str | os.PathLike[str], *, name: str | None = None, backbone: str | None = None, licence: str | None = None
) -> ImportedWeights:
    """Read a file of weights, find the network that it fits, and keep it in the cache.

    A file whose hash is in `loopclosure.weights.WEIGHTS` takes its place there, unless it is given a name.

    Parameters
    ----------
    file : path
        ``.pth`` or ``.pth.tar`` that `torch.save` wrote, ``.safetensors``, ``.caffemodel`` (ResNet-50, -101, -152 or
        VGG16), or ``.mat`` (a published VGG16-NetVLAD). No code in it is run.
    name : str, optional
        What ``--weights`` shall call it; the name of the file without its suffixes otherwise.
    backbone : str, optional
        One of `loopclosure.features.backbones.BACKBONES`; the one that fits otherwise.
    licence : str, optional
        Terms of the file, for the record.

    Raises
    ------
    WeightsError
        If the file is missing, damaged or no file of weights, fits no network, or the name is taken.
    """
    path = Path(file)
    check_file(path)
    content = _read(path)
    backbone = _fitting(path, content, backbone)
    digest = file_sha256(path)
    network = _loaded(path, content, backbone)
    listed = next((row for row in WEIGHTS.values() if row.sha256 and digest.startswith(row.sha256)), None)
    if listed is not None and listed.url is not None and name is None:
        record = _put(path, listed)
    else:
        record = _keep(network, _record(path, _free_name(name, path), backbone, content, listed, licence), digest)
    heads = BACKBONES[backbone].heads
    taken = without(content.tensors, heads)
    return ImportedWeights(
        weights=record,
        source_sha256=digest,
        taken=_by_part(taken),
        left_out=_by_part(content.tensors.keys() - taken.keys()),
        clusters=dict(content.clusters),
        whitened=content.whitened,
    )


def _free_name(name: str | None, path: Path) -> str:
    """Return the name, or one made of that of the file."""
    if name is None:
        name = path.name.replace("_", "-")
        for suffix in _SUFFIXES:
            name = name.removesuffix(suffix)
    if not is_name(name):
        raise WeightsError(f"'{name}' is no name: wanted up to 64 letters, digits, dots, dashes; give one with --name")
    if name in (*WEIGHTS, *DEFAULTS, "default", RANDOM):
        raise WeightsError(f"the name '{name}' is taken; give another one with --name")
    return name


def _read(path: Path) -> _Content:
    if path.suffix not in (".caffemodel", ".mat"):
        return _Content(read_checkpoint(path))
    try:
        if path.suffix == ".mat":
            found = read_netvlad(path)
            return _Content(_as_torch(found.tensors), mean=found.mean, clusters=found.clusters, whitened=found.whitened)
        net = translate(read_caffemodel(path), file_name=path.name)
        return _Content(_as_torch(net.tensors), "caffe", net.mean, net.windows, tuple(net.pools))
    except _DAMAGE as error:
        reason = f"{type(error).__name__}: {error}".removeprefix("ValueError: ").splitlines()[0][:200]
        raise WeightsError(f"{path} is damaged or no {path.suffix} of a network known here: {reason}") from None


def _as_torch(tensors: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(tensor) for key, tensor in tensors.items()}


def _fitting(path: Path, content: _Content, backbone: str | None) -> str:
    """Return the name of the network that the tensors fit."""
    if backbone is not None and backbone not in BACKBONES:
        raise WeightsError(
            f"unknown backbone '{backbone}'{did_you_mean(backbone, BACKBONES)}; known: {', '.join(BACKBONES)}"
        )
    wrong, fits = {}, {}
    for name, row in BACKBONES.items():
        if content.variant in ("", *row.variants):
            state = without(content.tensors, row.heads)
            wrong[name] = misfits(without(_skeleton(name).state_dict(), row.heads), state)
            fits[name] = len(state) - len(wrong[name].unexpected) - len(wrong[name].misshapen)
    nearest = max(wrong, key=lambda name: (fits[name], -wrong[name].total))
    if not fits[nearest]:
        raise WeightsError(f"none of the {len(content.tensors)} tensors of {path} fits a network known here")
    if backbone is not None and (backbone not in wrong or wrong[backbone]):
        reason = wrong.get(backbone, "it is Caffe's")
        raise WeightsError(f"{path} does not fit {backbone}: {reason}; the nearest network is {nearest}")
    if wrong[nearest]:
        raise WeightsError(f"{path} fits no network known here; the nearest is {nearest}: {wrong[nearest]}")
    return backbone or nearest


def _skeleton(backbone: str, variant: str = "") -> nn.Module:
    with torch.device("meta"):
        return BACKBONES[backbone].network(MIN_SIDE, MIN_SIDE, variant)


def _loaded(path: Path, content: _Content, backbone: str) -> nn.Module:
    """Return the network with the tensors in it; its windows must be those that the file tells of."""
    network = _skeleton(backbone, content.variant)
    load_strictly(network, content.tensors, heads=BACKBONES[backbone].heads, origin=f"{path} does not fit {backbone}")
    if content.windows:
        _check_windows(path, content, network, backbone)
    return network


def _check_windows(path: Path, content: _Content, network: nn.Module, backbone: str) -> None:
    modules = dict(network.named_modules())
    for name, found in content.windows.items():
        wanted = _window(modules[name])
        if found != wanted:
            raise WeightsError(f"{path} moves {name} with {found}, wanted {wanted}: it is another kind of {backbone}")
    pools = [module for module in modules.values() if isinstance(module, nn.MaxPool2d)]
    wanted_pools = tuple((pool.kernel_size, pool.stride, pool.padding) for pool in pools)
    if content.pools != wanted_pools:
        raise WeightsError(
            f"{path} pools with {content.pools} (side, stride, padding), wanted {wanted_pools}: "
            f"it is another kind of {backbone}"
        )


def _window(convolution: nn.Module) -> Window:
    stride, pad, dilation = (sides[0] for sides in (convolution.stride, convolution.padding, convolution.dilation))
    return Window(stride, pad, dilation, convolution.groups)


def _record(
    path: Path, name: str, backbone: str, content: _Content, listed: Weights | None, licence: str | None
) -> Weights:
    """Return the record of the weights, but for the digest and the size of what is kept of them."""
    like = listed or WEIGHTS[DEFAULTS[backbone]]
    return replace(
        like,
        name=name,
        sha256=None,
        licence=licence or (listed.licence if listed else "unknown"),
        source=f"{path.name}{f'; {listed.source}' if listed else ''}",
        url=None,
        package=None,
        path=tensors_file(cache_folder(), name),
        mean=content.mean or like.mean,
        std=_UNIT_STD if content.mean else like.std,
        variant=content.variant,
    )


def _keep(network: nn.Module, record: Weights, source_sha256: str) -> Weights:
    """Write tensors and record into the cache; return the record with the digest and size of the tensors."""
    state = without(network.state_dict(), BACKBONES[record.backbone].heads)
    place = tensors_file(cache_folder(), record.name)
    place.parent.mkdir(parents=True, exist_ok=True)
    part = place.with_name(f"{place.name}.part")
    save_file({key: tensor.clone(memory_format=torch.contiguous_format) for key, tensor in state.items()}, part)
    record = replace(record, sha256=file_sha256(part), size_mb=round(part.stat().st_size / 2**20, 3))
    os.replace(part, place)
    write_record(cache_folder(), record, source_sha256=source_sha256)
    return record


def _put(path: Path, listed: Weights) -> Weights:
    """Copy a file of the table to where a download of it would lie."""
    place = cache_folder() / listed.file
    place.parent.mkdir(parents=True, exist_ok=True)
    part = place.with_name(f"{place.name}.part")
    shutil.copyfile(path, part)
    os.replace(part, place)
    return listed


def _by_part(names: Iterable[str]) -> dict[str, int]:
    return dict(Counter(name.partition(".")[0] for name in names))
