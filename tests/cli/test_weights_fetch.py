"""`weights fetch` against a server in this process."""

from __future__ import annotations

import hashlib
import json
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from loopclosure.cli import main
from loopclosure.weights import WEIGHTS, Weights

CONTENT = b"weights"


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The record of a file that a local server has."""
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "tiny.pth").write_bytes(CONTENT)
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(SimpleHTTPRequestHandler, "log_message", lambda *_: None)
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path / "web")
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        url = f"http://127.0.0.1:{server.server_port}/tiny.pth"
        record = Weights(name="tiny", backbone="x", sha256=None, size_mb=0.0, licence="", source="", url=url)
        monkeypatch.setitem(WEIGHTS, "tiny", record)
        yield record
        server.shutdown()
        thread.join()


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["loopclosure", "weights", "fetch", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code or 0


def test_json_says_which_file_it_is(tiny, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "tiny", "--json") == 0
    file = tmp_path / "cache" / "weights" / tiny.file
    assert file.read_bytes() == CONTENT
    said = json.loads(capsys.readouterr().out)
    assert said == {"weights": "tiny", "file": str(file), "sha256": hashlib.sha256(CONTENT).hexdigest()}


def test_an_unknown_name_is_one_line(monkeypatch, capsys):
    assert run(monkeypatch, "efficientnet-lite", "--json") == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
