"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of real photographs; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("LOOPCLOSURE_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real photographs at {folder}; set LOOPCLOSURE_TEST_DATA to their folder")
    return folder
