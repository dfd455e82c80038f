"""The table against torchvision's own, and downloads from a server in this process."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import WeightsError
from loopclosure.weights import (
    DEFAULTS,
    WEIGHTS,
    Weights,
    all_weights,
    cache_folder,
    fetch,
    file_sha256,
    is_cached,
    locate,
    weights_for,
)
from loopclosure.weights.imported import write_record

CONTENT = np.random.default_rng(0).bytes(3 << 20)
DIGEST = hashlib.sha256(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves CONTENT; ``/broken.pth`` ends half way."""

    daemon_threads = True
    requests = 0


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.requests += 1
        if self.path == "/absent.pth":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        self.wfile.write(CONTENT[: len(CONTENT) // 2] if self.path == "/broken.pth" else CONTENT)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(("127.0.0.1", 0), Handler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    return tmp_path / "weights"


def record(port: int, file: str = "tiny.pth", sha256: str | None = DIGEST) -> Weights:
    url = f"http://127.0.0.1:{port}/{file}"
    return Weights(name="tiny", backbone="resnet18", sha256=sha256, size_mb=3, licence="", source="", url=url)


def closed_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


# --- the table


def test_table_is_torchvisions() -> None:
    from torchvision.models import get_model_weights

    # The detector of regions takes an image of any size and is checked by its address below.
    ours = {name for name, row in WEIGHTS.items() if row.url and "pytorch.org" in row.url} - {"fasterrcnn-coco"}
    for backbone in sorted({WEIGHTS[name].backbone for name in ours}):
        for theirs in get_model_weights(backbone):
            name = f"{backbone}-{theirs.name.lower().replace('_', '-')}"
            ours.remove(name)  # each of theirs is in the table, and nothing is left over
            row = WEIGHTS[name]
            assert row.url == theirs.url
            assert row.size_mb == theirs.meta["_file_size"]
            assert row.sha256 is not None
            assert f"-{row.sha256[:8]}.pth" in row.file
            transform = theirs.transforms()
            assert [row.height, row.width] == transform.crop_size * 2
            if backbone != "googlenet":  # see tests/features/test_backbones.py
                assert list(row.mean) == transform.mean
                assert list(row.std) == transform.std
    assert not ours


def test_defaults_are_torchvisions() -> None:
    from torchvision.models import get_model_weights

    for backbone, name in DEFAULTS.items():
        assert WEIGHTS[name].backbone == backbone
        if WEIGHTS[name].package is None:
            assert WEIGHTS[name].url == get_model_weights(backbone).DEFAULT.url


def test_table_is_well_formed() -> None:
    for name, row in WEIGHTS.items():
        assert row.name == name
        assert row.backbone in DEFAULTS
        assert (row.url is None) != (row.package is None)
        assert row.sha256 is None or (len(row.sha256) in (8, 64) and set(row.sha256) <= set("0123456789abcdef"))
        assert row.licence
        assert row.source
    files = [row.file for row in WEIGHTS.values() if row.url]
    assert len(set(files)) == len(files)


def test_embedded_file_is_the_published_one() -> None:
    row = WEIGHTS["efficientnet-lite0"]
    path = locate("efficientnet-lite0", download=False)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == row.sha256
    assert path.stat().st_size / 2**20 == pytest.approx(row.size_mb, abs=1e-3)
    assert is_cached("efficientnet-lite0")


# --- what the user asks for


def test_names_are_resolved(tmp_path: Path) -> None:
    assert weights_for("resnet152").name == "resnet152-imagenet1k-v2"
    assert weights_for("resnet50", "resnet50-places365") is WEIGHTS["resnet50-places365"]
    own = tmp_path / "mine.bin"
    own.write_bytes(CONTENT)
    for given in (own, str(own)):
        found = weights_for("googlenet", given)
        assert (found.name, found.path, found.mean, found.url) == ("mine.bin", own, (0.5, 0.5, 0.5), None)
        assert is_cached(found)
        assert locate(found) == own
    drawn = weights_for("efficientnet-lite0", "random")
    assert drawn.random
    assert drawn.name == "random (seed 0)"
    assert drawn.mean == WEIGHTS["efficientnet-lite0"].mean
    assert not any(row.random for row in WEIGHTS.values())


@pytest.mark.parametrize(
    ("backbone", "weights", "message"),
    [
        ("resnet18", "resnet18-imagenet1k-v3", "did you mean 'resnet18-imagenet1k-v1'"),
        ("resnet18", "resnet50-places365", "are for resnet50, the backbone is resnet18"),
        ("resnet18", "/no/such/file.pth", "neither a file nor the name"),
        ("resnet18", "x" * 5000, "neither a file nor the name"),
        ("resnet18", ".", "neither a file nor the name"),
        ("resnet181", "default", "did you mean 'resnet18'"),
    ],
)
def test_wrong_names(backbone: str, weights: str, message: str) -> None:
    with pytest.raises(WeightsError, match=message) as raised:
        weights_for(backbone, weights)
    assert "\n" not in str(raised.value)


def test_wrong_names_of_files() -> None:
    with pytest.raises(WeightsError, match="did you mean 'resnet18-places365'"):
        locate("resnet18-places")
    with pytest.raises(WeightsError, match="are no file"):
        locate(weights_for("resnet18", "random"))
    with pytest.raises(WeightsError, match="no address"):
        fetch("efficientnet-lite0")


# --- the cache


def test_cache_folder_follows_the_environment(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache_folder() == cache
    monkeypatch.delenv("LOOPCLOSURE_CACHE")
    assert cache_folder().parts[-2:] == ("loopclosure", "weights")


def test_downloaded_once(server: Server, cache: Path) -> None:
    row = record(server.server_port)
    assert not is_cached(row)
    with pytest.raises(WeightsError, match=f"tiny.pth is not in {cache}"):
        locate(row, download=False)
    told: list[tuple[int, int]] = []
    path = locate(row, progress=lambda *bytes_: told.append(bytes_))
    assert path == cache / "tiny.pth"
    assert path.read_bytes() == CONTENT
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert told == sorted(told)
    assert len(told) > 2
    assert is_cached(row)
    assert locate(row) == locate(row, download=False) == path
    assert server.requests == 1
    assert [file.name for file in cache.iterdir()] == ["tiny.pth"]


def test_short_and_unknown_hashes(server: Server) -> None:
    assert locate(record(server.server_port, "a.pth", DIGEST[:8])).is_file()
    path = locate(record(server.server_port, "b.pth", None))
    assert file_sha256(path) == DIGEST


def assert_nothing_kept(cache: Path) -> None:
    assert not cache.exists() or not list(cache.iterdir())


def test_wrong_hash_keeps_nothing(server: Server, cache: Path) -> None:
    with pytest.raises(WeightsError, match="sent another file; nothing was kept") as raised:
        locate(record(server.server_port, sha256="0" * 64))
    assert DIGEST in str(raised.value)
    assert_nothing_kept(cache)


@pytest.mark.parametrize(("file", "reason"), [("broken.pth", "Error"), ("absent.pth", "HTTP 404")])
def test_failed_download_keeps_nothing(server: Server, cache: Path, file: str, reason: str) -> None:
    with pytest.raises(WeightsError, match=f"cannot download {file} .*{reason}"):
        locate(record(server.server_port, file, None))
    assert_nothing_kept(cache)


def test_interrupted_download_keeps_nothing(server: Server, cache: Path) -> None:
    def interrupt(arrived: int, in_all: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(record(server.server_port), progress=interrupt)
    assert_nothing_kept(cache)


def test_no_network_names_file_address_and_folder(cache: Path) -> None:
    row = record(closed_port())
    with pytest.raises(WeightsError) as raised:
        locate(row)
    for part in ("tiny.pth", row.url, str(cache)):
        assert part in str(raised.value)
    assert "\n" not in str(raised.value)
    assert_nothing_kept(cache)


def test_unwritable_cache(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "file"))
    with pytest.raises(WeightsError, match="cannot download"):
        fetch(record(server.server_port))


def test_damaged_file_is_named_and_can_be_fetched_again(server: Server, cache: Path) -> None:
    row = record(server.server_port)
    path = fetch(row)
    path.write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError, match=f"{path} is damaged; delete it"):
        locate(row)
    assert fetch(row).read_bytes() == CONTENT
    assert locate(row) == path


def test_processes_that_fetch_at_once(server: Server, cache: Path) -> None:
    code = (
        "from loopclosure.weights import Weights, fetch\n"
        f"fetch(Weights(name='tiny', backbone='resnet18', sha256='{DIGEST}', size_mb=3, licence='', source='',"
        f" url='http://127.0.0.1:{server.server_port}/tiny.pth'))"
    )
    running = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(3)]
    assert [process.wait(60) for process in running] == [0, 0, 0]
    assert server.requests == 3
    assert [(file.name, file_sha256(file)) for file in cache.iterdir()] == [("tiny.pth", DIGEST)]


def test_import_loads_no_torch() -> None:
    code = "import sys, loopclosure.weights; sys.exit('torch' in sys.modules or 'requests' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=dict(os.environ), check=False).returncode == 0


# --- imported weights


@pytest.fixture
def imported(cache: Path) -> Weights:
    cache.mkdir(parents=True)
    (cache / "mine.safetensors").write_bytes(CONTENT)
    row = Weights(
        name="mine",
        backbone="resnet50",
        sha256=DIGEST,
        size_mb=3.0,
        licence="CC BY",
        source="x.caffemodel",
        path=cache / "mine.safetensors",
        mean=(0.1, 0.2, 0.3),
        variant="caffe",
    )
    write_record(cache, row, source_sha256="0" * 64)
    return row


def test_imported_weights_are_found_by_name(imported: Weights, cache: Path) -> None:
    assert weights_for("resnet50", "mine") == imported
    assert all_weights() == [*WEIGHTS.values(), imported]
    assert is_cached("mine")
    assert locate("mine") == cache / "mine.safetensors"
    with pytest.raises(WeightsError, match="the weights 'mine' are for resnet50, the backbone is vgg16"):
        weights_for("vgg16", "mine")
    with pytest.raises(WeightsError, match="did you mean 'mine'"):
        weights_for("resnet50", "mines")
    with pytest.raises(WeightsError, match="did you mean 'mine'"):
        locate("mines")
    with pytest.raises(WeightsError, match="no address"):
        fetch("mine")
    (cache / "mine.safetensors").write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError, match=r"mine\.safetensors is damaged; import it again"):
        locate("mine")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"format": 1', '"format": 2'),
        ('"RGB"', '"BGR"'),
        ('"resnet50"', '"resnet51"'),
        (f'"{DIGEST}"', "null"),
        ('"sha256"', '"sha1"'),
        ("0.2,", ""),
        ("0.3", '"red"'),
        ("{", "["),
        ("{", " " * 70_000 + "{"),
    ],
)
def test_damaged_records_are_one_line(imported: Weights, cache: Path, old: str, new: str) -> None:
    file = cache / "mine.json"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    for ask in (lambda: weights_for("resnet50", "mine"), all_weights):
        with pytest.raises(WeightsError, match=r"mine\.json is damaged .*; delete it and import") as raised:
            ask()
        assert "\n" not in str(raised.value)
    assert weights_for("resnet50").name == "resnet50-imagenet1k-v2"
