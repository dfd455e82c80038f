"""Saved arrays: strict, bounded, whole or absent."""

from __future__ import annotations

import json

import numpy as np
import pytest

from loopclosure.errors import ModelError
from loopclosure.store import ARRAYS, HEADER, MAX_HEADER_BYTES, load_arrays, part, save_arrays


@pytest.fixture
def folder(tmp_path):
    return save_arrays(tmp_path / "x", kind="model", header={"a": 1}, arrays={"m": np.arange(6.0).reshape(2, 3).T})


def test_round_trip(folder):
    header, arrays = load_arrays(folder, kind="model")
    assert header["a"] == 1
    np.testing.assert_array_equal(arrays["m"], np.arange(6.0).reshape(2, 3).T)
    assert not list(folder.glob("*.part"))


def test_wrong_kind_and_format(folder):
    with pytest.raises(ModelError, match="holds 'model', wanted 'detector'"):
        load_arrays(folder, kind="detector")
    header = json.loads((folder / HEADER).read_text())
    (folder / HEADER).write_text(json.dumps(header | {"format": 99}))
    with pytest.raises(ModelError, match="format 99"):
        load_arrays(folder, kind="model")


def test_parts_of_two_savings_do_not_go_together(folder, tmp_path):
    other = save_arrays(tmp_path / "y", kind="model", header={}, arrays={"m": np.ones(3)})
    (folder / ARRAYS).write_bytes((other / ARRAYS).read_bytes())
    with pytest.raises(ModelError, match="do not belong together"):
        load_arrays(folder, kind="model")


@pytest.mark.parametrize("text", ["", "[" * 100_000, "not json", "[]", "\u0000", "x" * (MAX_HEADER_BYTES + 1)])
def test_damaged_header(folder, text):
    (folder / HEADER).write_text(text)
    with pytest.raises(ModelError):
        load_arrays(folder, kind="model")


def test_damaged_or_missing_arrays(folder):
    (folder / ARRAYS).write_bytes((folder / ARRAYS).read_bytes()[:-8])
    with pytest.raises(ModelError, match="do not belong together"):
        load_arrays(folder, kind="model")
    (folder / ARRAYS).unlink()
    with pytest.raises(ModelError, match="missing or damaged"):
        load_arrays(folder, kind="model")
    with pytest.raises(ModelError, match="not a folder that loopclosure saved"):
        load_arrays(folder / "nowhere", kind="model")


def test_part():
    assert set(part({"a.x": np.zeros(1), "a.y.z": np.zeros(1), "ab.x": np.zeros(1)}, "a")) == {"x", "y.z"}
