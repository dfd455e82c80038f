"""Archives from strangers: nothing is written outside the folder, nothing but plain files, no more than agreed."""

from __future__ import annotations

import lzma
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, NamedTuple

from loopclosure.errors import LoopClosureError

ARCHIVES = (".zip", ".tar.gz")
MAX_FILES = 500_000
_DAMAGED = (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, OSError)


class _Member(NamedTuple):
    name: str
    size: int
    plain: bool
    encrypted: bool
    open: Callable[[], IO[bytes] | None]


def unpack(archive: Path, into: Path, *, limit_bytes: int, progress: Callable[[int, int], None] | None = None) -> None:
    """Unpack a ``.zip`` or ``.tar.gz`` into a folder, beside what is there already.

    Everything is unpacked aside first, so that a refused or damaged archive leaves nothing behind.

    Parameters
    ----------
    archive, into : pathlib.Path
        The file; the folder.
    limit_bytes : int
        The contents may not be larger.
    progress : callable, optional
        Told ``(unpacked, limit)`` bytes.

    Raises
    ------
    LoopClosureError
        If it is damaged, encrypted or too large, or holds links, devices or paths that lead out of the folder.
    """
    aside = into / f".{archive.name}.unpacking"
    shutil.rmtree(aside, ignore_errors=True)
    try:
        _unpack(archive, aside, limit_bytes, progress)
        for file in [path for path in aside.rglob("*") if path.is_file()]:
            target = into / file.relative_to(aside)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
    except _DAMAGED as error:
        raise LoopClosureError(
            f"{archive} cannot be unpacked into {into} ({error}); if it is damaged, delete it and fetch it anew"
        ) from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _unpack(archive: Path, aside: Path, limit_bytes: int, progress: Callable[[int, int], None] | None) -> None:
    unpacked = 0
    for count, member in enumerate(_members(archive), start=1):
        unpacked += member.size
        if unpacked > limit_bytes or count > MAX_FILES:
            raise LoopClosureError(f"{archive} holds more than {limit_bytes} bytes or {MAX_FILES} files: refused")
        target = aside / _inside(archive, member)
        target.parent.mkdir(parents=True, exist_ok=True)
        source = member.open()
        if source is None:
            raise EOFError(f"{member.name} has no content")
        with source, target.open("wb") as file:
            shutil.copyfileobj(source, file, 1 << 20)
        if progress:
            progress(unpacked, limit_bytes)


def _inside(archive: Path, member: _Member) -> PurePosixPath:
    path = PurePosixPath(member.name)
    if path.is_absolute() or ".." in path.parts or set(member.name) & set("\\:\0") or not path.parts:
        raise LoopClosureError(f"{archive} holds {member.name!r}, which leads out of the folder: refused")
    if not member.plain:
        raise LoopClosureError(f"{archive} holds {member.name!r}, which is a link or a device: refused")
    if member.encrypted:
        raise LoopClosureError(f"{archive} holds {member.name!r}, which is encrypted: refused")
    return path


def _members(archive: Path) -> Iterator[_Member]:
    return _in_zip(archive) if archive.name.endswith(".zip") else _in_tar(archive)


def _in_zip(archive: Path) -> Iterator[_Member]:
    with zipfile.ZipFile(archive) as packed:
        for info in packed.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)  # 0 where it was packed on Windows
            if not info.is_dir():
                yield _Member(
                    info.filename,
                    info.file_size,
                    plain=kind in (0, stat.S_IFREG),
                    encrypted=bool(info.flag_bits & 1),
                    open=partial(packed.open, info),
                )


def _in_tar(archive: Path) -> Iterator[_Member]:
    with tarfile.open(archive, "r|gz") as packed:
        for info in packed:
            if not info.isdir():
                yield _Member(
                    info.name, info.size, plain=info.isreg(), encrypted=False, open=partial(packed.extractfile, info)
                )
