"""A recording of a few pixels, for what is read of files."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_recording import tiny_recording


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tiny_recording(tmp_path / "recording")
