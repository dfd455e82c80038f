"""Files of weights into networks: nothing in a file is executed, and every name and shape must fit."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load_file
from torch import nn

from loopclosure.errors import WeightsError

MAX_FILE_BYTES = 4 << 30
FOREIGN = (".caffemodel", ".mat")
"""Files that `loopclosure.features.importing` translates."""


def read_checkpoint(path: str | os.PathLike[str]) -> dict[str, torch.Tensor]:
    """Read the tensors of a ``.safetensors`` file, or of one that `torch.save` wrote.

    Training checkpoints count too: the tensors may lie under ``state_dict``, and the ``module.`` that data-parallel
    training puts into names is taken out, wherever it stands.

    Parameters
    ----------
    path : path
        Only tensors and plain containers are read (``weights_only``); anything else is refused unexecuted.

    Returns
    -------
    dict of str to tensor
        On the CPU.

    Raises
    ------
    WeightsError
        If the file is missing, damaged, too large, or holds anything but dense tensors.
    """
    file = Path(path)
    content: Any
    check_file(file)
    if file.suffix in FOREIGN:
        raise WeightsError(f"{file} is of another program; `loopclosure weights import {file}` makes weights of it")
    try:
        if file.suffix == ".safetensors":
            content = load_file(file)
        else:
            content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # noqa: BLE001 - a damaged or hostile file can raise anything
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        raise WeightsError(f"{file} is damaged or holds more than tensors ({reason})") from None
    if isinstance(content, Mapping):
        content = content.get("state_dict", content)
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content):
        raise WeightsError(f"{file} holds a {type(content).__name__}, wanted tensors by name (a state dict)")
    state = {key.replace("module.", ""): value for key, value in content.items()}
    for key, value in state.items():
        if not _is_dense(value):
            raise WeightsError(f"{file} holds '{key}', which is no dense tensor: it is not a state dict")
    return state


def load_strictly(network: nn.Module, state: Mapping[str, torch.Tensor], *, heads: Iterable[str], origin: str) -> None:
    """Put every tensor of `state` into `network`; what is missing, left over or misshapen is an error.

    Parameters
    ----------
    network : Module
        May lie on the ``meta`` device: the tensors are taken over, not copied.
    state : mapping of str to tensor
        As `read_checkpoint` gives it. Counts of training batches may be absent (files from before 2018).
    heads : iterable of str
        Children that are not used, classifiers mostly; their tensors are passed over whatever their shapes.
    origin : str
        Where `state` is from and what it should fit, for the message.

    Raises
    ------
    WeightsError
        In one line.
    """
    wanted = without(network.state_dict(), heads)
    state = without(state, heads)
    wrong = misfits(wanted, state)
    if wrong:
        raise WeightsError(f"{origin}: {wrong}")
    for key, value in state.items():
        if not torch.isfinite(value).all():
            raise WeightsError(f"{origin}: '{key}' holds values that are not finite")
    fitting = {key: state.get(key, torch.tensor(0)).to(value.dtype) for key, value in wanted.items()}
    network.load_state_dict(fitting, strict=False, assign=True)  # only the heads are missing now


class Misfits(NamedTuple):
    """Names of tensors that keep a state dict from fitting a network; false if there are none."""

    missing: list[str]
    unexpected: list[str]
    misshapen: list[str]

    def __bool__(self) -> bool:
        return self.total > 0

    def __str__(self) -> str:
        return "; ".join(f"{what} {_some(names)}" for what, names in self._asdict().items() if names)

    @property
    def total(self) -> int:
        """How many there are."""
        return sum(map(len, self))


def misfits(wanted: Mapping[str, torch.Tensor], state: Mapping[str, torch.Tensor]) -> Misfits:
    """Compare names and shapes; counts of training batches need not be there."""
    missing = [key for key in wanted.keys() - state.keys() if not key.endswith(".num_batches_tracked")]
    misshapen = [key for key in wanted.keys() & state.keys() if not _fits(state[key], wanted[key])]
    return Misfits(missing, list(state.keys() - wanted.keys()), misshapen)


def without(state: Mapping[str, torch.Tensor], heads: Iterable[str]) -> dict[str, torch.Tensor]:
    """Return the tensors that belong to no child of these names."""
    skipped = tuple(f"{head}." for head in heads)
    return {key: value for key, value in state.items() if not key.startswith(skipped)}


def check_file(file: Path) -> None:
    """Refuse what is no file or too large.

    Raises
    ------
    WeightsError
        In one line.
    """
    try:
        found = file.stat()
    except OSError as error:
        raise WeightsError(f"cannot read weights from {file}: {error.strerror}") from None
    if not stat.S_ISREG(found.st_mode):
        raise WeightsError(f"cannot read weights from {file}: it is not a file")
    if found.st_size > MAX_FILE_BYTES:
        raise WeightsError(f"{file} is larger than {MAX_FILE_BYTES} bytes: it holds no weights of these networks")


def _is_dense(value: object) -> bool:
    if not isinstance(value, torch.Tensor):
        return False
    return not value.is_nested and value.layout is torch.strided and value.device.type == "cpu"


def _fits(found: torch.Tensor, wanted: torch.Tensor) -> bool:
    return found.shape == wanted.shape and found.is_floating_point() == wanted.is_floating_point()


def _some(keys: Iterable[str]) -> str:
    names = sorted(keys)
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
