"""Small maps that grow as large ones do."""

from __future__ import annotations

import pytest

from loopclosure.matching import index


@pytest.fixture(scope="module")
def short_steps():
    """Let a small map go through all stages of the growth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(index, "_STEP", 128)
        patch.setattr(index, "_CODED", 2 * 128)
        patch.setattr(index, "_SURVIVORS", 200)
        patch.setattr(index, "_BLOCK", 16 * 1024)
        yield
