"""What printed commands take as given: small recordings and files under the names that README, docs and --help use."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import other_layouts
from small_recording import BOARD, FOCAL_PX, K, camera_pose, draw_recording
from small_recording import HEIGHT as DRAWN_HEIGHT
from small_recording import WIDTH as DRAWN_WIDTH

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import CameraInfo, open_recording, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import write_rig
from rgbd_calib.io.tables import write_table
from rgbd_calib.types import Rig, RigCamera

CAMERAS = 3
WALLS_M = (0.8, 1.6, 2.4)
WIDTH, HEIGHT = DRAWN_WIDTH // 2, DRAWN_HEIGHT // 2
"""Px: clouds, corrections and reports take a quarter of the time."""


def build(root: Path, run: Callable[..., object]) -> Path:
    """Make the world in `root`; `run` calls rgbd-calib. Paths below `root` are those that the commands name."""
    for name, frames, seed in (("demo/extrinsic", 6, 0), ("demo/intrinsic", 6, 1), ("monday", 5, 2)):
        _halve(draw_recording(root / name, CAMERAS, frames, seed))
    _walls(root / "demo/depth_bias")
    _truth(root / "demo/truth.yaml")
    bare = root / "photos"
    shutil.copytree(root / "monday", bare)
    (bare / "dataset.yaml").unlink()
    shutil.copytree(bare, root / "scans")
    shutil.copytree(root / "demo", root / "rig1")
    shutil.copytree(root / "demo/extrinsic", root / "rig1", dirs_exist_ok=True)
    for name in (
        "extrinsic",
        "intrinsic",
        "depth_bias",
        "truth.yaml",
    ):  # scripts/demo keeps them one folder further down
        source = root / "demo" / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, root / "demo/recording" / name)  # type: ignore[operator]
    two = open_recording(draw_recording(root / "two", cameras=2, frames=4))
    other_layouts.stems_and_tiff(two, root / "mixed")

    start = "calibrate", root / "demo/extrinsic"
    run(*start, "-o", root / "rig.yaml", "--correspondences", root / "c.csv", "--intrinsics", root / "demo/truth.yaml")
    for copy in ("demo/rig", "rig1/rig"):
        for end in (".yaml", ".residuals.csv"):
            shutil.copy(root / f"rig{end}", root / f"{copy}{end}")
    run("intrinsics", root / "demo/intrinsic", "-o", root / "intrinsics.yaml")
    run("export", root / "rig.yaml", "--to", "kalibr", root / "camchain.yaml")
    run("export", root / "rig.yaml", "--to", "ros", root / "ros")
    for name, camera in (("left", "C1"), ("right", "C2")):
        shutil.copy(next((root / "ros").rglob(f"*{camera}*.yaml")), root / f"{name}.yaml")
    written = cv2.FileStorage(str(root / "calib.xml"), cv2.FILE_STORAGE_WRITE)
    written.write("camera_matrix", K)
    written.write("distortion_coefficients", np.zeros(5))
    written.release()
    return root


def _halve(folder: Path) -> None:
    """Bring a drawn recording to WIDTH x HEIGHT px."""
    drawn = open_recording(folder)
    for camera, files in drawn.color_files.items():
        for frame in files:
            color = cv2.resize(drawn.color(camera, frame), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            depth_m = cv2.resize(drawn.depth_m(camera, frame), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            save_color(folder, camera, frame, color)
            save_depth(folder, camera, frame, np.rint(depth_m * 1000).astype(np.uint16))
    write_dataset(folder, _infos(list(drawn.cameras)), BOARD)


def _infos(names: list[str]) -> dict[str, CameraInfo]:
    return {name: CameraInfo(WIDTH, HEIGHT, serial=f"drawn-{name}") for name in names}


def _walls(folder: Path) -> None:
    """Flat walls square to each camera, colour without a board."""
    rng = np.random.default_rng(3)
    rows = [(f"{n:06d}", repr(z_m)) for n, z_m in enumerate(WALLS_M)]
    names = [f"C{i + 1}" for i in range(CAMERAS)]
    for name in names:
        for (frame, _), z_m in zip(rows, WALLS_M, strict=True):
            save_color(folder, name, frame, np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
            noisy_m = z_m + rng.normal(0, 0.0016 * z_m**2, (HEIGHT, WIDTH))
            save_depth(folder, name, frame, np.rint(noisy_m * 1000).astype(np.uint16))
        write_table(folder / name / "distances.csv", ("frame", "distance_m"), rows)
    write_dataset(folder, _infos(names), BOARD)


def _truth(path: Path) -> None:
    lens = Intrinsics(WIDTH, HEIGHT, FOCAL_PX / 2, FOCAL_PX / 2, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, (0.0,) * 5)
    cameras = {f"C{i + 1}": RigCamera(lens, camera_pose(i, CAMERAS), np.zeros((6, 6))) for i in range(CAMERAS)}
    write_rig(path, Rig("C1", cameras))
