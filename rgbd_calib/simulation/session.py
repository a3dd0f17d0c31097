"""A whole session of a rig at the level of corners: what a detector would find in its recordings, without images.

It is what `scripts/study_silent_failures.py` spoils, and fast enough to try hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import CameraInfo, write_dataset
from rgbd_calib.io.tables import write_table
from rgbd_calib.simulation.depth_sensor import biased
from rgbd_calib.simulation.rig import Layout, true_rig
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.types import Board, BoardView, Rig, RigCamera

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
WALLS_M = (0.6, 0.9, 1.2, 1.5, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0)
WALL_K_PER_M = 0.3e-3
"""Noise of a wall's distance, k z^2: the mean over a patch of a sensor with 1.6e-3, its window correlated."""
_SHARED_M, _CLOSE_M = (1.3, 2.9), (0.6, 1.4)
_TILT_RAD = 0.6


@dataclass(frozen=True)
class Scene:
    """A rig, a board and where it stood: what really was."""

    rig: Rig
    board: Board
    boards: dict[str, FloatArray]
    """T_world_board (4, 4) by frame, in order of time."""
    close: dict[str, dict[str, FloatArray]]
    """Of each camera alone."""
    noise: ViewNoise


@dataclass(frozen=True)
class Session:
    """What is on disk of a session, and the truth."""

    truth: Rig
    board: Board
    """As dataset.yaml says."""
    boards: dict[str, FloatArray]
    views: tuple[BoardView, ...]
    close: tuple[BoardView, ...] | None
    """None: no intrinsic recording."""
    walls: dict[str, FloatArray] | None
    """(n, 3) by camera: depth as measured, distance as written down, standard error, metres. None: no bias recording."""
    lenses: dict[str, Intrinsics] = field(default_factory=dict)
    """A file of intrinsics in place of the intrinsic recording; empty: there is none."""
    late_stamps_us: float = 0.0
    """By how much the time stamps of the second camera are wrong; 0: there are none."""


def draw_scene(
    n_cameras: int,
    layout: Layout,
    frames: int,
    close_views: int,
    rng: np.random.Generator,
    board: Board = BOARD,
    noise: ViewNoise | None = None,
) -> Scene:
    """Draw a rig as `simulate` does, and boards anywhere in the images of two cameras at least."""
    drawn = true_rig(n_cameras, layout, 640, 480, rng)
    nothing = np.zeros((6, 6))
    cameras = {
        c: RigCamera(drawn.intrinsics[c], T, nothing, drawn.depth_bias[c]) for c, T in drawn.T_world_color.items()
    }
    rig = Rig(drawn.cameras[0], cameras)
    boards: dict[str, FloatArray] = {}
    while len(boards) < frames:
        name = drawn.cameras[len(boards) % n_cameras]
        T = draw_board(rig, name, board, _SHARED_M, rng)
        if len(_seen_by(rig, T, board)) >= 2:
            boards[f"{len(boards):06d}"] = T
    close: dict[str, dict[str, FloatArray]] = {}
    for i, name in enumerate(drawn.cameras):
        mine: dict[str, FloatArray] = {}
        while len(mine) < close_views:
            T = draw_board(rig, name, board, _CLOSE_M, rng)
            if name in _seen_by(rig, T, board):
                mine[f"{101 + i}{len(mine):03d}"] = T
        close[name] = mine
    return Scene(rig, board, boards, close, noise or ViewNoise())


def draw_board(
    rig: Rig,
    name: str,
    board: Board,
    range_m: tuple[float, float],
    rng: np.random.Generator,
    tilt_rad: float = _TILT_RAD,
) -> FloatArray:
    """T_world_board (4, 4) of a board somewhere in the image of a camera, turned towards it but for a tilt."""
    own = rig.cameras[name]
    z = rng.uniform(*range_m)
    R = so3.exp(np.array([*rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.5, 0.5)]))
    at = rng.uniform(-0.42, 0.42, 2) * [
        own.intrinsics.width / own.intrinsics.fx,
        own.intrinsics.height / own.intrinsics.fy,
    ]
    middle = z * np.array([*at, 1.0])
    T: FloatArray = own.T_world_color @ se3.make(R, middle - R @ board.corners_m().mean(axis=0))
    return T


def film(scene: Scene, rng: np.random.Generator, stated: Board | None = None) -> Session:
    """Every recording of a session; `stated` is the board that dataset.yaml has, None: the true one."""
    views = true_views(scene.rig, scene.boards, scene.board, scene.noise, rng)
    return Session(
        scene.rig,
        stated or scene.board,
        scene.boards,
        views,
        film_close(scene, rng),
        {name: film_walls(own, rng) for name, own in scene.rig.cameras.items()},
    )


def film_close(scene: Scene, rng: np.random.Generator) -> tuple[BoardView, ...]:
    """The intrinsic recording."""
    out: list[BoardView] = []
    for name, boards in scene.close.items():
        alone = replace(scene.rig, cameras={name: scene.rig.cameras[name]})
        out += true_views(alone, boards, scene.board, scene.noise, rng)
    return tuple(out)


def film_walls(camera: RigCamera, rng: np.random.Generator) -> FloatArray:
    """Walls of a bias recording, (n, 3)."""
    z = np.array(WALLS_M)
    measured = z if camera.depth_bias is None else biased(z, camera.depth_bias)
    sigma = WALL_K_PER_M * z**2
    return np.stack([measured + rng.normal(0, sigma), z, sigma], axis=1)


def write_session(session: Session, folder: Path) -> None:
    """Recordings extrinsic/ and intrinsic/ with empty image files, and their corners beside them as NAME.csv."""
    _write(folder, "extrinsic", session, session.views)
    if session.close is not None:
        _write(folder, "intrinsic", session, session.close)


def _write(folder: Path, name: str, session: Session, views: Sequence[BoardView]) -> None:
    path = folder / name
    with_depth = {v.camera for v in views if np.isfinite(v.depth_m).any()}
    for view in views:
        for kind in ("color", "depth") if view.camera in with_depth else ("color",):
            image = path / view.camera / kind / f"{view.frame}.png"
            image.parent.mkdir(parents=True, exist_ok=True)
            image.touch()
    sizes = {c: (own.intrinsics.width, own.intrinsics.height) for c, own in session.truth.cameras.items()}
    board = replace(session.board, square_m=min(session.board.square_m, 1.0))  # larger ones are refused here too
    write_dataset(path, {c: CameraInfo(*size) for c, size in sizes.items()}, board)
    write_corners(folder / f"{name}.csv", views)
    for i, camera in enumerate(sizes if session.late_stamps_us else ()):
        frames = sorted({v.frame for v in views if v.camera == camera})
        stamps = [1e5 * k + (session.late_stamps_us if i == 1 else 0.0) for k in range(len(frames))]
        rows = zip(frames, stamps, stamps, strict=True)
        write_table(path / camera / "timestamps.csv", ("frame", "color_us", "depth_us"), rows)


def _seen_by(rig: Rig, T_world_board: FloatArray, board: Board) -> set[str]:
    exact = ViewNoise(0.0, 0.0, 0.0)
    return {v.camera for v in true_views(rig, {"x": T_world_board}, board, exact, np.random.default_rng(0))}
