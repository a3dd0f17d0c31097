"""A whole session of a rig at the level of corners: what a detector would find in its recordings, without images.

It is what `scripts/study_silent_failures.py` spoils, and fast enough to try hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import CameraInfo, write_dataset
from rgbd_calib.io.tables import write_table
from rgbd_calib.quality import Quality
from rgbd_calib.simulation.depth_sensor import biased
from rgbd_calib.simulation.printed import printed
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.rig import Layout, true_rig, with_errors, with_lenses
from rgbd_calib.simulation.views import ViewNoise, sensor_reports, true_views
from rgbd_calib.simulation.wall import Wall, tilted
from rgbd_calib.types import Board, BoardView, Rig, RigCamera

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
WALLS_M = (0.6, 0.9, 1.2, 1.5, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0)
WALL_K_PER_M = 0.3e-3
"""Noise of a wall's distance, k z^2: the mean over a patch of a sensor with 1.6e-3, its window correlated."""
VIEW_SPREAD = 0.3
"""Relative variation of the corner noise between views, due to focus, exposure and light."""
WALL_SHARE = 0.6
"""Share of the image, in width and height, from which the single distance is estimated."""
CELL_PX = 16
CELL_K_PER_M = 0.8e-3
"""Noise of a cell mean, k z^2: a sensor with 1.6e-3 and noise correlated over 9 x 7 px has four independent values per cell."""
_SHARED_M, _CLOSE_M = (1.3, 2.9), (0.6, 1.4)
_TILT_RAD = 0.6


@dataclass(frozen=True)
class TrueScene:
    """A rig, a board and where it stood: what really was."""

    rig: Rig
    board: Board
    """With its true shape."""
    boards: dict[str, FloatArray]
    """T_world_board (4, 4) by frame, in order of time."""
    close: dict[str, dict[str, FloatArray]]
    """Of each camera alone."""
    noise: ViewNoise
    realism: Realism = IDEAL


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
    wall_cells: dict[str, FloatArray] | None = None
    """(n, cells, 3) by camera: u and v, px, and mean measured depth of each image cell of each wall. None: no bias recording, or
    an ideal one."""
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
    realism: Realism | None = None,
    lenses: Sequence[LensKind] = ("brown",),
    size: tuple[int, int] = (640, 480),
    shared_m: tuple[float, float] = _SHARED_M,
) -> TrueScene:
    """Draw a rig as `simulate` does, and boards anywhere in the images of two cameras at least.

    `realism` None: lens distortion, depth bias and noise only. Lenses and poses do not depend on it. `size` is of the images, px,
    in multiples of `CELL_PX`; `shared_m` the distances of the boards that the cameras share.
    """
    sizes = realism or IDEAL
    of_print, of_sensors, of_lenses = rng.spawn(3)
    drawn = with_lenses(true_rig(n_cameras, layout, *size, rng), lenses, of_lenses)
    rig = Rig(drawn.cameras[0], drawn.rig_cameras)
    boards: dict[str, FloatArray] = {}
    while len(boards) < frames:
        name = drawn.cameras[len(boards) % n_cameras]
        T = draw_board(rig, name, board, shared_m, rng)
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
    usual = ViewNoise(spread=VIEW_SPREAD if sizes.has("images") else 0.0)
    scene = TrueScene(rig, board, boards, close, noise or usual, sizes)
    cameras = with_errors(drawn, "structured-light", None, sizes, of_sensors).rig_cameras
    return reprinted(replace(scene, rig=replace(rig, cameras=cameras)), board, of_print)


def reprinted(scene: TrueScene, board: Board, rng: np.random.Generator) -> TrueScene:
    """The scene with another nominal board and newly drawn print errors."""
    if not scene.realism.has("print"):
        return replace(scene, board=board)
    made = printed(board, scene.realism, rng)
    return replace(scene, board=made.board, rig=replace(scene.rig, quality=Quality(board_shape=made.board.shape)))


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


def film(scene: TrueScene, rng: np.random.Generator, stated: Board | None = None) -> Session:
    """Every recording of a session; `stated` is the board that dataset.yaml has, None: the true one."""
    views = true_views(scene.rig, scene.boards, scene.board, scene.noise, rng)
    close = film_close(scene, rng)
    common_m = rng.spawn(1)[0].normal(0, scene.realism.tape_common_m)
    walls = {name: film_walls(own, rng, scene.realism, common_m) for name, own in scene.rig.cameras.items()}
    cells = {name: own.cells for name, own in walls.items() if own.cells is not None}
    return Session(
        scene.rig,
        replace(stated or scene.board, shape=None),
        scene.boards,
        views,
        close,
        {name: own.rows for name, own in walls.items()},
        cells or None,
    )


def film_close(scene: TrueScene, rng: np.random.Generator) -> tuple[BoardView, ...]:
    """The intrinsic recording."""
    out: list[BoardView] = []
    for name, boards in scene.close.items():
        alone = replace(scene.rig, cameras={name: scene.rig.cameras[name]})
        out += true_views(alone, boards, scene.board, scene.noise, rng)
    return tuple(out)


@dataclass(frozen=True)
class FilmedWalls:
    """The bias recording of one camera."""

    rows: FloatArray
    """(n, 3), as :attr:`Session.walls`."""
    cells: FloatArray | None = None
    """(n, cells, 3), as :attr:`Session.wall_cells`."""


def film_walls(
    camera: RigCamera, rng: np.random.Generator, realism: Realism = IDEAL, common_m: float = 0.0
) -> FilmedWalls:
    """Walls of a bias recording; `common_m` is the error common to all written distances."""
    z = np.array(WALLS_M)
    sigma = WALL_K_PER_M * z**2
    if not (realism.has("depth_field") or realism.has("registration") or realism.has("walls")):
        measured = z if camera.depth_bias is None else biased(z, camera.depth_bias)
        return FilmedWalls(np.stack([measured + rng.normal(0, sigma), z, sigma], axis=1))
    cells = np.stack([_wall_cells(camera, Wall(d, tilted(realism.wall_tilt_rad, rng)), rng) for d in z])
    measured = np.array([_at_centre(own, camera.intrinsics) for own in cells])
    written = z + common_m + rng.normal(0, realism.tape_m, len(z))
    return FilmedWalls(np.stack([measured, written, np.hypot(sigma, realism.tape_m)], axis=1), cells)


def _wall_cells(camera: RigCamera, wall: Wall, rng: np.random.Generator) -> FloatArray:
    """(cells, 3): u, v and measured depth of the cells of a depth image of this wall."""
    sensor = camera.depth_sensor
    seen, lens = wall.moved(se3.inverse(sensor.camera.T_color_depth)), sensor.camera.intrinsics
    u, v = (np.arange(CELL_PX / 2 - 0.5, side, CELL_PX) for side in (lens.width, lens.height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    z_m = sensor_reports(sensor, pixels, seen.along(lens.rays(pixels)))
    return np.column_stack([pixels, z_m + CELL_K_PER_M * z_m**2 * rng.standard_normal(len(z_m))])


def _at_centre(cells: FloatArray, lens: Intrinsics) -> float:
    """Depth at the principal point by a plane (affine 1 / z) through the central cells."""
    u, v, z_m = cells.T
    middle = (np.abs(2 * u / lens.width - 1) < WALL_SHARE) & (np.abs(2 * v / lens.height - 1) < WALL_SHARE)
    A = np.column_stack([u - lens.cx, v - lens.cy, np.ones_like(u)])[middle]
    return float(1 / np.linalg.lstsq(A, 1 / z_m[middle], rcond=None)[0][2])


def write_session(session: Session, folder: Path) -> None:
    """Recordings extrinsic/ and intrinsic/ with empty image files, their corners beside them as NAME.csv, and depth_bias/ with
    the depth images of walls, where they have cells."""
    _write(folder, "extrinsic", session, session.views)
    if session.close is not None:
        _write(folder, "intrinsic", session, session.close)
    if session.walls is not None and session.wall_cells is not None:
        _write_walls(folder / "depth_bias", session, session.walls, session.wall_cells)


def _write_walls(path: Path, session: Session, walls: dict[str, FloatArray], cells: dict[str, FloatArray]) -> None:
    """A bias recording: each cell's mean at all of its pixels, in metres (the noise of single pixels is in the means)."""
    infos = {c: CameraInfo(own.intrinsics.width, own.intrinsics.height) for c, own in session.truth.cameras.items()}
    path.mkdir(parents=True)
    write_dataset(path, infos, replace(session.board, square_m=min(session.board.square_m, 1.0)))
    for camera, rows in walls.items():
        width, height = infos[camera].width, infos[camera].height
        for kind in ("color", "depth"):
            (path / camera / kind).mkdir(parents=True)
        frames = [f"{k:06d}" for k in range(len(rows))]
        for frame, own in zip(frames, cells[camera], strict=True):
            means = own[:, 2].reshape(height // CELL_PX, width // CELL_PX).astype(np.float32)
            (path / camera / "color" / f"{frame}.png").touch()
            np.save(path / camera / "depth" / f"{frame}.npy", means.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1))
        write_table(
            path / camera / "distances.csv", ("frame", "distance_m"), zip(frames, rows[:, 1].tolist(), strict=True)
        )


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
