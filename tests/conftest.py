"""Fixtures that every test file shares."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from dask_cluster import Cluster
from hypothesis import settings
from virtual_rig import build_redist

from rgbd_calib.cli.main import main
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, rays
from rgbd_calib.io.recording import CameraInfo, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import write_rig
from rgbd_calib.quality import CameraStatistics, Quality
from rgbd_calib.types import Board, DepthBias, Rig, RigCamera

# the same examples on every run, and no time limit for one: machines that run tests are busy
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest test first: begun last, it would keep one process busy while the others have nothing left."""
    items.sort(key=lambda item: item.name != "test_every_printed_command_ends_as_it_says")


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


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Detections of tests are kept where the tests are, never with the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RGBD_CALIB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def redist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with OpenNI2's runtime and the virtual driver; skips the test where something is missing that it needs."""
    return build_redist(tmp_path_factory.mktemp("openni2") / "redist")


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


@dataclass(frozen=True)
class Tiny:
    """A recording of 64x48 px of the plane normal . p = offset_m in the world, and the rig that made it.

    C1 and C2 have distorted lenses, biased depth and two frames, of which C2 lacks the depth of the second; C3 has
    colour only. Colours are one for each camera. Columns 0 to 15 of C1 see a second plane, half as far away.
    """

    recording: Path
    rig_path: Path
    rig: Rig
    normal: np.ndarray
    offset_m: float
    colors_bgr: dict[str, tuple[int, int, int]]


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Tiny:
    """A recording so small that a test may do anything with it; nobody writes into it."""
    path = tmp_path_factory.mktemp("tiny") / "recording"
    width, height = 64, 48
    lens = Intrinsics(width, height, 60.0, 61.0, 31.3, 23.8, (0.05, -0.02, 0.001, -0.002, 0.003))
    bias = DepthBias((0.01, 0.02), 0.3, 4.0, 0.001)
    poses = {
        "C1": np.eye(4),
        "C2": se3.make(so3.exp(np.array([0.02, -0.4, 0.03])), np.array([0.6, 0.05, 0.1])),
        "C3": se3.make(so3.exp(np.array([-0.1, 0.3, 0.0])), np.array([-0.5, 0.0, 0.1])),
    }
    biases = {"C1": bias, "C2": bias, "C3": None}
    cameras = {
        n: RigCamera(lens, T, np.zeros((6, 6)), biases[n], CameraStatistics(sigma_2d_px=0.3)) for n, T in poses.items()
    }
    rig = Rig("C1", cameras, Quality(other={"views": 2}), {"seed": 0})
    normal, offset_m = np.array([0.1, -0.2, 0.9]) / np.linalg.norm([0.1, -0.2, 0.9]), 1.5
    colors_bgr = {"C1": (10, 20, 200), "C2": (20, 200, 10), "C3": (200, 20, 10)}

    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    for name, T in poses.items():
        directions = rays(lens.vector, pixels) @ T[:3, :3].T
        z_m = (offset_m - normal @ T[:3, 3]) / (directions @ normal)
        if name == "C1":
            z_m[:, :16] /= 2
        measured_m = (z_m - bias.coefficients[0]) / (1 + bias.coefficients[1])
        for frame in ("000000", "000001"):
            save_color(path, name, frame, np.full((height, width, 3), colors_bgr[name], np.uint8))
            if name == "C1" or (name == "C2" and frame == "000000"):
                save_depth(path, name, frame, np.rint(measured_m / 0.0005).astype(np.uint16))
    infos = {name: CameraInfo(width, height, *([] if name == "C3" else [0.0005])) for name in poses}
    write_dataset(path, infos, Board(9, 6, 0.06), {"notes": "kept"})
    write_rig(path.parent / "rig.yaml", rig)
    return Tiny(path, path.parent / "rig.yaml", rig, normal, offset_m, colors_bgr)


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A Dask scheduler with two workers."""
    pytest.importorskip("distributed", reason="pip install 'rgbd-calib[dask]'")
    with closing(Cluster(tmp_path_factory.mktemp("cluster"))) as running:
        yield running


@pytest.fixture
def browser(tmp_path: Path):
    """Headless Chromium that may talk to this computer only; 3D is drawn in software."""
    chromium, driver_path = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver_path):
        pytest.skip("no Chromium: apt-get install chromium chromium-driver")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--enable-unsafe-swiftshader",
        "--window-size=1280,1000",
        "--proxy-server=127.0.0.1:9",
        f"--user-data-dir={tmp_path / 'profile'}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver_path))
    yield driver
    driver.quit()
