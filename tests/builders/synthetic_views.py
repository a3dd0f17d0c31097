"""Rigs with known truth, what a detector would give of a board before them, and small recordings of it on disk.

No image is rendered: corners are projected, with noise. A recording's images are blank, and its corners are in the
corners.csv beside it, for `--corners`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import CameraInfo, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import write_depth_bias, write_intrinsics, write_rig
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.types import Board, BoardView, DepthBias, PlacedView, Rig, RigCamera

WIDTH, HEIGHT = 640, 480
BOARD = Board(9, 6, 0.06)
"""cols + rows odd: no half turn."""
EVEN_BOARD = Board(10, 6, 0.05)
TWO_SIDED = Board(9, 6, 0.06, True, 0.006)
DISTANCE_M = 2.0
"""From every camera to the middle of what all look at."""

EXACT = ViewNoise(0.0, 0.0, 0.0)
CORNER_NOISE = ViewNoise(0.1, 0.7e-3, 0.0)
"""Independent from corner to corner, so that tolerances can be derived: 0.1 px, and 2.8 mm of depth at 2 m."""


def lens_of(i: int) -> Intrinsics:
    """A distorted lens, another one for each camera."""
    return Intrinsics(
        WIDTH, HEIGHT, 540.0 + 9 * i, 542.0 + 8 * i, 322.0 - 2 * i, 236.0 + 3 * i, (0.05, -0.1, 1e-3, -5e-4, 0.0)
    )


def bias_of(i: int) -> DepthBias:
    """A few millimetres at 2 m, of another sign for every second camera."""
    sign = (-1.0) ** i
    return DepthBias((0.002 * sign, -0.004 * sign, 0.002 * sign), 0.5, 4.0, 0.0)


def around(angles_deg: Sequence[float], names: Sequence[str] | None = None, biased: bool = False) -> Rig:
    """Cameras on a circle, all looking at its middle; the first is the world."""
    names = names or [f"C{i + 1}" for i in range(len(angles_deg))]
    cameras = {}
    for i, (name, degrees) in enumerate(zip(names, angles_deg, strict=True)):
        R = so3.exp(np.array([0.0, np.radians(degrees), 0.0])) @ so3.exp(np.array([0.05 * (i % 3 - 1), 0.0, 0.03 * i]))
        T_middle_color = se3.make(R, -DISTANCE_M * R[:, 2])
        if i == 0:
            T_world_middle = se3.inverse(T_middle_color)
        T = T_world_middle @ T_middle_color if i else np.eye(4)
        cameras[name] = RigCamera(lens_of(i), T, np.zeros((6, 6)), bias_of(i) if biased else None)
    return Rig(names[0], cameras)


def arc(n: int, step_deg: float = 20.0, names: Sequence[str] | None = None, biased: bool = False) -> Rig:
    """Neighbours see the same side of a board."""
    return around([step_deg * (i - (n - 1) / 2) for i in range(n)], names, biased)


def ring(n: int, biased: bool = False) -> Rig:
    """All around: opposed cameras see opposite faces of a board."""
    return around([360.0 * i / n for i in range(n)], None, biased)


def board_poses(
    rig: Rig, board: Board, frames: int, rng: np.random.Generator, faces: int | None = None
) -> dict[str, np.ndarray]:
    """T_world_board (4, 4) by frame: near the middle of what the cameras look at, turned towards one of them in turn."""
    names = list(rig.cameras)
    out: dict[str, np.ndarray] = {}
    while len(out) < frames:
        towards = rig.cameras[names[len(out) % len(names)]].T_world_color
        tilt = so3.exp(rng.uniform(-0.5, 0.5, 3) * [1.0, 1.0, 0.6])
        middle = np.array([*rng.uniform(-0.25, 0.25, 2), DISTANCE_M + rng.uniform(-0.5, 0.4)])
        T_color_board = se3.make(tilt, middle - tilt @ board.corners_m().mean(axis=0))
        T_world_board = towards @ T_color_board
        seen = true_views(rig, {"x": T_world_board}, board, EXACT, rng)
        if len(seen) >= min(2, len(names)) if faces is None else len(seen) >= faces:
            out[f"{len(out):06d}"] = T_world_board
    return out


def half_turned(view: BoardView, board: Board) -> BoardView:
    """The same view as a detector reads it from the other end: corner k is called n - 1 - k."""
    return replace(view, ids=board.n_corners - 1 - view.ids)


def turn_some(
    views: Sequence[BoardView], board: Board, share: float, rng: np.random.Generator
) -> tuple[tuple[BoardView, ...], set[tuple[str, str]]]:
    """Views of which some are half turned, and which, as (camera, frame)."""
    turned = {(v.camera, v.frame) for v in views if rng.random() < share}
    return tuple(half_turned(v, board) if (v.camera, v.frame) in turned else v for v in views), turned


def without_depth(view: BoardView) -> BoardView:
    """As of a camera that has colour only."""
    return replace(view, depth_m=np.full(len(view.ids), np.nan), depth_pixels=np.zeros(len(view.ids), int))


def placed_truly(
    rig: Rig, boards: Mapping[str, np.ndarray], views: Sequence[BoardView], board: Board
) -> tuple[PlacedView, ...]:
    """The views, in the order of `true_views`, with true face and pose."""
    out = []
    for view in views:
        T = se3.inverse(rig.cameras[view.camera].T_world_color) @ boards[view.frame]
        # from behind: the board's z, into the board, points to the camera
        back = bool(T[:3, 2] @ (T[:3, :3] @ board.corners_m().mean(axis=0) + T[:3, 3]) < 0)
        out.append(PlacedView(view, back, False, T))
    return tuple(out)


def pose_errors(T: Mapping[str, np.ndarray], truth: Rig) -> dict[str, tuple[float, float]]:
    """Rotation, rad, and translation, m, by camera."""
    xi = {name: se3.difference(T[name], own.T_world_color) for name, own in truth.cameras.items()}
    return {name: (float(np.linalg.norm(x[:3])), float(np.linalg.norm(x[3:]))) for name, x in xi.items()}


@dataclass(frozen=True)
class Written:
    """A recording on disk, and what it was made from."""

    path: Path
    corners: Path
    intrinsics: Path
    depth_bias: Path
    truth: Path
    rig: Rig
    boards: dict[str, np.ndarray]
    views: tuple[BoardView, ...]


def write_recording(
    folder: Path,
    rig: Rig,
    board: Board,
    boards: dict[str, np.ndarray],
    views: Sequence[BoardView],
    color_only: Sequence[str] = (),
    intrinsics_in_dataset: bool = False,
) -> Written:
    """A folder with blank images of every view, and beside it corners.csv, the true intrinsics and biases, and the truth."""
    path = folder / "extrinsic"
    views = tuple(without_depth(v) if v.camera in color_only else v for v in views)
    for view in views:
        own = rig.cameras[view.camera].intrinsics
        save_color(path, view.camera, view.frame, np.zeros((own.height, own.width, 3), np.uint8))
        if view.camera not in color_only:
            save_depth(path, view.camera, view.frame, np.zeros((own.height, own.width), np.uint16))
    infos = {
        name: CameraInfo(
            own.intrinsics.width,
            own.intrinsics.height,
            intrinsics=own.intrinsics if intrinsics_in_dataset else None,
        )
        for name, own in rig.cameras.items()
    }
    write_dataset(path, infos, board)
    files = [folder / name for name in ("corners.csv", "intrinsics.yaml", "depth_bias.yaml", "truth.yaml")]
    write_corners(files[0], views)
    write_intrinsics(files[1], {name: own.intrinsics for name, own in rig.cameras.items()}, {}, {}, {})
    biases = {name: own.depth_bias for name, own in rig.cameras.items() if own.depth_bias is not None}
    if biases:
        write_depth_bias(files[2], biases, {}, {}, {})
    write_rig(files[3], rig, boards)
    return Written(path, *files, rig, boards, views)


def make_recording(
    folder: Path,
    rig: Rig | None = None,
    board: Board = BOARD,
    frames: int = 12,
    seed: int = 0,
    noise: ViewNoise = CORNER_NOISE,
    **options: object,
) -> Written:
    """A recording of drawn board poses; three cameras on an arc unless a rig is given."""
    rng = np.random.default_rng(seed)
    rig = rig or arc(3)
    boards = board_poses(rig, board, frames, rng)
    return write_recording(folder, rig, board, boards, true_views(rig, boards, board, noise, rng), **options)  # type: ignore[arg-type]
