"""The virtual rig for tests: builds the driver, feeds it a recording, and runs the program against it in a child process.

Child processes matter: there is one runtime in a process, the driver reads its environment at start, and a mistake
here shows as a hang or a crash, not as an exception.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbd_calib.io.capture_log import FORMAT
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.recording import Recording, open_recording

SOURCES = Path(__file__).parent / "virtual_xtion"
HEADERS = Path("/usr/include/openni2")
QUICK = ("--settle", "0.3", "--interval", "0.1")
"""Options of `capture`: pictures as soon as there are some."""
TIMEOUT_S = 90.0
"""A capture of the tests takes some 5 s; many times that is a hang even on a busy machine."""


def system_runtime() -> Path:
    """Folder of the stock runtime; skips the test where something is missing that it needs."""
    folders = [*Path("/usr/lib").glob("*-linux-gnu"), Path("/usr/lib")]
    found = [f for f in folders if (f / "libOpenNI2.so.0").exists()]
    if sys.version_info >= (3, 13):
        pytest.skip("the OpenNI2 binding needs Python before 3.13")
    if not found:
        pytest.skip("no OpenNI2 runtime: apt-get install libopenni2-0")
    if not HEADERS.is_dir() or shutil.which("g++") is None:
        pytest.skip("the virtual driver cannot be built: apt-get install libopenni2-dev g++")
    return found[0]


def build_redist(folder: Path) -> Path:
    """A private folder with the stock runtime, the virtual driver and the driver for files."""
    runtime = system_runtime()
    drivers = folder / "OpenNI2" / "Drivers"
    drivers.mkdir(parents=True)
    (folder / "libOpenNI2.so").symlink_to(runtime / "libOpenNI2.so.0")
    (drivers / "libOniFile.so.0").symlink_to(runtime / "OpenNI2/Drivers/libOniFile.so.0")
    build(SOURCES / "virtual_xtion.cpp", drivers / "libVirtualXtion.so.0")
    return folder


def build(source: Path, library: Path) -> Path:
    """Compile a shared library."""
    flags = ["-std=c++17", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror", "-pthread"]
    subprocess.run(["g++", *flags, "-isystem", HEADERS, source, "-o", library, "-ldl"], check=True)
    return library


def feed(recording: Recording, folder: Path) -> Path:
    """The recording as raw pictures for the driver; device i is the recording's camera i."""
    for i, camera in enumerate(recording.cameras):
        (folder / str(i)).mkdir(parents=True)
        with (
            (folder / str(i) / "color_640x480.rgb").open("wb") as color,
            (folder / str(i) / "depth_640x480.u16").open("wb") as depth,
        ):
            for frame in recording.frames:
                color.write(np.ascontiguousarray(recording.color(camera, frame)[..., ::-1]).tobytes())
                depth.write(read_raw(recording.depth_files[camera][frame]).tobytes())
    return folder


def read_raw(path: Path) -> np.ndarray:
    """Pixels of a PNG as they are stored; colour comes as R G B."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])


@dataclass
class Ended:
    """A program that has ended."""

    status: int
    stdout: str
    stderr: str


@dataclass
class VirtualRig:
    """Runs `rgbd-calib` against virtual cameras."""

    redist: Path
    folder: Path
    environment: dict[str, str] = field(default_factory=dict)
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def close(self) -> None:
        """End what a failed test left running."""
        for process in self.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                print("left running; it said:", *process.communicate())

    @property
    def control(self) -> Path:
        return self.folder / "control"

    def settings(self, **values: object) -> None:
        """Environment of the driver: devices=4 becomes VXTION_DEVICES=4."""
        self.environment.update({f"VXTION_{key.upper()}": str(value) for key, value in values.items()})

    def command(self, line: str) -> None:
        """Give the running driver a command."""
        with self.control.open("a") as stream:
            stream.write(line + "\n")

    def start(self, *args: object, python: str | None = None, **popen: object) -> subprocess.Popen[str]:
        """Start `rgbd-calib ARGS`, or a Python program, in its own session."""
        program = ["-c", python] if python else ["-m", "rgbd_calib"]
        environment = {
            **os.environ,
            "OPENNI2_REDIST64": str(self.redist),
            "VXTION_CONTROL": str(self.control),
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
            **self.environment,
        }
        process = subprocess.Popen(
            [sys.executable, *program, *map(str, args)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            **popen,  # type: ignore[call-overload]
        )
        self.processes.append(process)
        return process

    def capturing(self, *options: object, sets: int = 2) -> tuple[Path, subprocess.Popen[str]]:
        """A `capture` that has written some frame sets, and where to."""
        out = self.folder / "out"
        process = self.start("capture", out, *options)
        self.wait_for_frame_sets(out, sets)
        return out, process

    def wait_for_frame_sets(self, folder: Path, n: int) -> None:
        """Wait until the capture has finished `n` frame sets."""
        table = folder / "frame_sets.csv"
        self._wait(lambda: table.exists() and len(table.read_text().splitlines()) > n, f"{n} frame sets in {table}")

    def wait_for_text(self, path: Path, text: str) -> None:
        """Wait until a file holds a text."""
        self._wait(lambda: path.exists() and text in path.read_text(), f"{text!r} in {path}")

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        process = self.processes[-1]
        while not condition():
            ended = process.poll() is not None
            if ended or time.monotonic() > deadline:
                os.killpg(process.pid, signal.SIGABRT) if not ended else None  # faulthandler says where it stands
                said = "\n".join(process.communicate())
                pytest.fail(f"no {what}; the program {'ended' if ended else 'went on'}:\n{said}")
            time.sleep(0.05)

    def run(self, *args: object, **options: object) -> Ended:
        """Run it to its end."""
        return finish(self.start(*args, **options))  # type: ignore[arg-type]


def interrupted(process: subprocess.Popen[str]) -> Ended:
    """The end after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    return finish(process)


def finish(process: subprocess.Popen[str], timeout_s: float = TIMEOUT_S) -> Ended:
    """Wait for the end of a program; one that hangs is killed and fails the test with what it said."""
    try:
        stdout, stderr = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        stdout, stderr = process.communicate()
        pytest.fail(f"hangs after {timeout_s} s\n{stdout}\n{stderr}")
    assert process.returncode >= 0, f"died of signal {-process.returncode}\n{stdout}\n{stderr}"
    assert "Traceback" not in stderr, stderr
    return Ended(process.returncode, stdout, stderr)


def stamps(folder: Path, camera: str, kind: str) -> dict[str, int]:
    """{frame: the driver's true number of the exposure} of images that carry it (VXTION_STAMP)."""
    files = sorted((folder / camera / kind).glob("*.png"))
    return {p.stem: int(np.frombuffer(read_raw(p)[0].tobytes()[:8], "<u8")[0]) for p in files}


def last_session(folder: Path) -> dict:
    """The last session of capture.yaml."""
    data = load_yaml(folder / "capture.yaml")
    assert data["format"] == FORMAT
    return data["sessions"][-1]


def check_whole(folder: Path) -> Recording:
    """The recording opens, every image in it can be read, and every line of frame_sets.csv has its images."""
    recording = open_recording(folder)
    for camera in recording.cameras:
        for frame in recording.color_files[camera]:
            recording.color(camera, frame)
        for frame in recording.depth_files[camera]:
            recording.depth_m(camera, frame)
        assert set(recording.timestamps_us(camera)) <= set(recording.color_files[camera])
    for line in (folder / "frame_sets.csv").read_text().splitlines()[1:]:
        frame, *_, cameras = line.split(",")
        assert all(frame in recording.color_files[c] for c in cameras.split()), line
    assert not list(folder.glob("**/.*.png"))
    return recording
