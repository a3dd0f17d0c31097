"""Virtual cameras that play a drawn recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from small_recording import draw_recording
from virtual_rig import VirtualRig, feed

from rgbd_calib.io.recording import open_recording


@pytest.fixture(scope="session")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of four cameras, four frames, and the same as raw pictures beside it."""
    folder = draw_recording(tmp_path_factory.mktemp("drawn") / "recording", cameras=4, frames=4)
    feed(open_recording(folder), folder.parent / "raw")
    return folder


@pytest.fixture
def rig(redist: Path, played: Path, tmp_path: Path) -> Iterator[VirtualRig]:
    """Two cameras; tests change what they need."""
    rig = VirtualRig(redist, tmp_path)
    rig.settings(devices=2, data=played.parent / "raw")
    yield rig
    rig.close()
