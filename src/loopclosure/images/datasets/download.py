"""One file over HTTP, in as many pieces as the connection needs."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import requests  # type: ignore[import-untyped, unused-ignore]

from loopclosure.errors import LoopClosureError
from loopclosure.weights import file_sha256

_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30
_CUT = (requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError)


def download(
    url: str,
    path: Path,
    *,
    limit_bytes: int,
    sha256: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Download a file; what an earlier attempt has brought is not asked for again.

    The file appears under its name only when it is whole and its hash is right; until then it grows beside it as
    ``.part``. The server is asked for the rest only of the very file that was begun: its ETag or date is kept, and a
    file that has changed meanwhile is begun anew.

    Parameters
    ----------
    url : str
        Where it comes from.
    path : pathlib.Path
        Where it goes; the folder is made.
    limit_bytes : int
        A larger file is refused.
    sha256 : str, optional
        What its digest has to be.
    progress : callable, optional
        Told ``(arrived, in_all)`` bytes; 0 in all if the server does not say.

    Raises
    ------
    LoopClosureError
        If it cannot be had; the message names address and folder, and what has arrived is kept for the next attempt.
    """
    part = path.with_name(f"{path.name}.part")
    version = path.with_name(f"{path.name}.part.version")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            before = _size(part)
            try:
                _transfer(url, part, version, limit_bytes, progress)
                break
            except _CUT:
                if _size(part) <= before:  # as long as every connection brings something, the next one goes on
                    raise
        if sha256 and (digest := file_sha256(part)) != sha256:
            part.unlink()
            raise LoopClosureError(f"{url} sent another file (its sha256 is {digest}, wanted {sha256}); it was deleted")
        os.replace(part, path)
        version.unlink(missing_ok=True)
    except OSError as error:  # that of `requests` among them
        kept = f"; {_size(part)} bytes are kept for the next attempt" if _size(part) else ""
        raise LoopClosureError(
            f"cannot download {path.name} from {url} ({_reason(error)}); put it into {path.parent}{kept}"
        ) from None
    return path


def _transfer(
    url: str, part: Path, version: Path, limit_bytes: int, progress: Callable[[int, int], None] | None
) -> None:
    known = version.read_text(encoding="latin-1") if version.is_file() else ""
    arrived = _size(part) if known else 0
    headers = {"Accept-Encoding": "identity"}
    if arrived:
        headers |= {"Range": f"bytes={arrived}-", "If-Range": known}
    with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as answer:
        if arrived and answer.status_code == requests.codes.requested_range_not_satisfiable:
            if _total(answer) != arrived:  # what is here is no beginning of that file
                version.unlink()
                _transfer(url, part, version, limit_bytes, progress)
            return
        answer.raise_for_status()
        if not _continues(answer, arrived):
            part.unlink(missing_ok=True)
            version.write_text(_version(answer), encoding="latin-1")
        _receive(answer, part, limit_bytes, progress)


def _receive(
    answer: requests.Response, part: Path, limit_bytes: int, progress: Callable[[int, int], None] | None
) -> None:
    arrived, total = _size(part), _total(answer)
    with part.open("ab") as file:
        for chunk in answer.iter_content(_CHUNK_BYTES):
            arrived += len(chunk)
            if max(arrived, total) > limit_bytes:
                part.unlink()
                raise LoopClosureError(f"{answer.url} sends more than {limit_bytes} bytes: it is not the file it was")
            file.write(chunk)
            if progress:
                progress(arrived, total)
    if arrived < total:
        raise requests.ConnectionError(f"the connection ended after {arrived} of {total} bytes")


def _continues(answer: requests.Response, arrived: int) -> bool:
    begins = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    return answer.status_code == requests.codes.partial_content and begins is not None and int(begins[1]) == arrived


def _total(answer: requests.Response) -> int:
    """Return the size of the whole file, 0 where the server does not say it."""
    whole = re.search(r"(\d+)$", answer.headers.get("Content-Range") or answer.headers.get("Content-Length", ""))
    return int(whole[1]) if whole else 0


def _version(answer: requests.Response) -> str:
    """Return what tells this file from a later one at the same address; a weak ETag does not."""
    tag = answer.headers.get("ETag", "")
    return tag if tag.startswith('"') else answer.headers.get("Last-Modified", "")


def _size(file: Path) -> int:
    return file.stat().st_size if file.is_file() else 0


def _reason(error: OSError) -> str:
    status = getattr(getattr(error, "response", None), "status_code", None)
    return f"HTTP {status}" if status else error.strerror or type(error).__name__
