"""Fixtures that every test file shares."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from rgbd_calib.cli.main import main


@dataclass(frozen=True)
class Outcome:
    """What a command left behind: its exit status, and what it printed."""

    status: int
    stdout: str
    stderr: str


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Call `rgbd-calib` in this process, as `run("fuse", folder, "-o", path)`, through the real entry point."""

    def call(*args: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["rgbd-calib", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        code = stop.value.code
        return Outcome(code if isinstance(code, int) else int(code is not None), captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """Folder of a real recording by name; skips the test where it is absent."""

    def folder(name: str) -> Path:
        default = Path(__file__).parents[2] / "shared" / "data"
        path = Path(os.environ.get("RGBD_CALIB_TEST_DATA", default)) / name
        if not path.exists():
            pytest.skip(f"{path} is not there; set RGBD_CALIB_TEST_DATA to the folder of the real recordings")
        return path

    return folder
