"""A recording laid out as other programs and people's scripts lay theirs out: the same pixels under other names."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
from april_views import GRID, photograph, pose
from foreign_files import bag2, save, write_video

from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.recording import Recording


def stems_and_tiff(drawn: Recording, folder: Path) -> Path:
    """rgb_C1_0001.jpg in one folder, C1/depth_0001.tiff of floating-point metres."""
    for camera in drawn.cameras:
        for i, frame in enumerate(drawn.frames, 1):
            save(folder / f"rgb_{camera}_{i:04d}.jpg", drawn.color(camera, frame))
            depth_m = np.nan_to_num(drawn.depth_m(camera, frame)).astype(np.float32)
            save(folder / camera / f"depth_{i:04d}.tiff", depth_m)
    return folder


def videos_and_depth(drawn: Recording, folder: Path) -> Path:
    """A lossless video for each camera, beside a folder of depth images."""
    for camera in drawn.cameras:
        write_video(folder / camera / "color.mkv", np.stack([drawn.color(camera, f) for f in drawn.frames]))
        for i, frame in enumerate(drawn.frames):
            path = folder / camera / "depth" / f"{i:05d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(drawn.depth_files[camera][frame], path)
    return folder


def iai(kinect2: Recording, folder: Path) -> Path:
    """iai_kinect2's calibration folder, of the recording of one Kinect v2."""
    folder.mkdir(parents=True)
    for i, frame in enumerate(kinect2.frames):
        for kind, files in (("color", kinect2.color_files), ("ir", kinect2.ir_files), ("depth", kinect2.depth_files)):
            path = files["kinect2"][frame]
            shutil.copyfile(path, folder / f"{i:04d}_sync_{kind}{path.suffix}")
    return folder


RATIONAL = [0.05, -0.1, 0.0, 0.0, 0.0, 0.05, -0.1, 0.0]
"""A pinhole, as a quotient of two equal polynomials."""


def ros2_bag(drawn: Recording, folder: Path) -> Path:
    """A ROS 2 bag of cameras with rational lenses and registered depth."""
    with bag2(folder) as bag:
        for camera, info in drawn.cameras.items():
            k = [575.0, 0, (info.width - 1) / 2, 0, 575.0, (info.height - 1) / 2, 0, 0, 1]
            bag.info(
                f"/{camera}/color/camera_info",
                (info.width, info.height),
                "rational_polynomial",
                RATIONAL,
                list(map(float, k)),
            )
        for i, frame in enumerate(drawn.frames):
            for n, camera in enumerate(drawn.cameras):
                time_us = 2_000_000 + 100_000 * i + 3000 * n
                bag.image(f"/{camera}/color/image_raw", time_us, drawn.color(camera, frame), "bgr8", f"{camera}_color")
                depth = cv2.imread(str(drawn.depth_files[camera][frame]), cv2.IMREAD_UNCHANGED)
                bag.image(f"/{camera}/aligned_depth_to_color/image_raw", time_us, depth, "16UC1", f"{camera}_color")
    return folder


T_CAM0_CAM1 = se3.make(so3.exp(np.array([0.0, -0.25, 0.0])), np.array([0.18, 0.01, 0.03]))


def kalibr(folder: Path, frames: int = 14) -> Path:
    """Kalibr's dataset of two cameras: cam0/TIME_NS.png, an AprilGrid in front of them, and its target.yaml."""
    rng = np.random.default_rng(6)
    for i in range(frames):
        T_cam0_board = pose(rng, GRID, rng.uniform(-3, 3), rng.uniform(0.6, 1.0))
        for camera, T in (("cam0", T_cam0_board), ("cam1", se3.inverse(T_CAM0_CAM1) @ T_cam0_board)):
            save(folder / camera / f"{1_520_530_308_199_447_626 + 50_000_000 * i}.png", photograph(GRID, T, rng))
    target = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 4\ntagSize: 0.06\ntagSpacing: 0.3\n"
    (folder / "april_6x4.yaml").write_text(target)
    return folder


def half_depth(drawn: Recording, folder: Path) -> Path:
    """Depth at half the size of colour, the same view."""
    for camera in drawn.cameras:
        for frame in drawn.frames:
            save(folder / camera / "color" / f"{frame}.png", drawn.color(camera, frame))
            depth = cv2.imread(str(drawn.depth_files[camera][frame]), cv2.IMREAD_UNCHANGED)
            save(folder / camera / "depth" / f"{frame}.png", np.ascontiguousarray(depth[::2, ::2]))
    return folder


def caliscope(drawn: Recording, folder: Path) -> Path:
    """A session of caliscope: videos of both cameras, and the times of their frames."""
    videos = folder / "calibration" / "extrinsic"
    rows = ["sync_index,cam_id,frame_index,frame_time"]
    for n, camera in enumerate(drawn.cameras):
        pixels = np.stack([drawn.color(camera, f) for f in drawn.frames])[..., ::-1]
        write_video(videos / f"cam_{n}.mp4", np.ascontiguousarray(pixels[..., ::-1]), "libx264rgb", "rgb24")
        rows += [f"{i},{n},{i},{50 + 0.1 * i + 0.003 * n}" for i in range(len(drawn.frames))]
    (videos / "timestamps.csv").write_text("\n".join(rows) + "\n")
    return folder
