"""The examples run, and the examples in the docstrings are true."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import loopclosure

EXAMPLES = Path(__file__).parents[1] / "examples"
MODULES = [
    module.name
    for module in pkgutil.walk_packages(loopclosure.__path__, "loopclosure.")
    if not module.name.startswith("loopclosure.cli")
]


def test_demo(tmp_path):
    command = [sys.executable, EXAMPLES / "demo.py", "--out", tmp_path, "--frames", "60", "--covered", "0"]
    done = subprocess.run([*map(str, command)], check=True, capture_output=True, text=True)
    assert "precision" in done.stdout
    assert {"loops.csv", "run.json", "metrics.json", "report.html"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    import numpy as np

    assert doctest.testmod(importlib.import_module(name), extraglobs={"np": np}).failed == 0
