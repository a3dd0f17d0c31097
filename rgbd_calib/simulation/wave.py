"""A carried board before free-running cameras at the level of corners: what a detector would find, without images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import CameraInfo, write_dataset
from rgbd_calib.io.tables import write_table
from rgbd_calib.simulation.clocks import CameraClock, Exposures, WaveParams, draw_clocks, expose
from rgbd_calib.simulation.motion import HandMotion, MotionKind, hand_motion
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.simulation.session import TrueScene
from rgbd_calib.simulation.views import depth_of_board, may_be_found
from rgbd_calib.types import Board, BoardView, Rig, RigCamera

_ROUNDS = 4
"""Of the row that a corner is seen in and the instant of that row: each reduces the error to a hundredth."""
BLUR_LIMIT_PX = 7.0
"""A board that is blurred over more is not found."""
BLUR_NOISE_PX = 2.5
"""Blur that doubles the variance of a corner."""


@dataclass(frozen=True)
class WaveSession:
    """What is on disk of a carried board, and the truth."""

    truth: Rig
    board: Board
    """As dataset.yaml says."""
    views: tuple[BoardView, ...]
    """Frames are each camera's own stems."""
    stamps_us: dict[str, dict[str, tuple[float, float]]]
    """(colour, depth) by camera and frame, of all frames."""
    motion: HandMotion
    clocks: dict[str, CameraClock]
    t_s: dict[str, dict[str, float]]
    """True time of each frame."""

    def T_world_board(self, view: BoardView) -> FloatArray:
        """(4, 4), at the instant of a view."""
        return np.asarray(self.motion.poses(np.array([self.t_s[view.camera][view.frame]]))[0])


def film_wave(
    scene: TrueScene,
    params: WaveParams,
    rng: np.random.Generator,
    kind: MotionKind = "hand",
    stated: Board | None = None,
) -> WaveSession:
    """Carry the scene's board before its cameras."""
    of_motion, of_clocks, of_noise = rng.spawn(3)
    cameras = scene.rig.cameras
    T = [own.T_world_color for own in cameras.values()]
    motion = hand_motion(T, scene.board, params.seconds, of_motion, kind)
    clocks = draw_clocks(list(cameras), params, of_clocks)
    views: list[BoardView] = []
    stamps, times = {}, {}
    for name, own in cameras.items():
        taken = expose(clocks[name], params, of_clocks)
        views += _film(name, own, clocks[name], taken, motion, scene, params, of_noise)
        stamps[name] = {s: (float(u), float(u)) for s, u in zip(taken.stems, taken.stamps_us, strict=True)}
        times[name] = dict(zip(taken.stems, taken.t_s.tolist(), strict=True))
    board = replace(stated or scene.board, shape=None)
    return WaveSession(scene.rig, board, tuple(views), stamps, motion, clocks, times)


def _film(
    name: str,
    own: RigCamera,
    clock: CameraClock,
    taken: Exposures,
    motion: HandMotion,
    scene: TrueScene,
    params: WaveParams,
    rng: np.random.Generator,
) -> list[BoardView]:
    """Views of one camera that show the whole board, sharp enough."""
    board, noise, T_color_world = scene.board, scene.noise, se3.inverse(own.T_world_color)
    T = T_color_world @ motion.poses(taken.t_s)
    seen = [k for k in range(len(T)) if may_be_found(own, T[k], board)]
    t_s, T = taken.t_s[seen], T[seen]
    corners = np.stack([board.corners_m(False), board.corners_m(True)])[looks_at_back(T, board).astype(int)]
    pixels = [_rolled(own, clock, T_color_world, motion, t_s + dt, corners) for dt in params.exposure_s * _ENDS]
    px, blur_px = pixels[0], np.linalg.norm(pixels[2] - pixels[1], axis=-1).mean(axis=1)
    T_depth = T_color_world @ motion.poses(t_s + clock.depth_delay_s)
    p_depth = corners @ T_depth[:, :3, :3].transpose(0, 2, 1) + T_depth[:, None, :3, 3]
    rays = own.intrinsics.rays(px)
    normal = T_depth[:, None, :3, 2]
    along = np.sum(p_depth * normal, axis=-1) / np.sum(rays * normal, axis=-1)
    out = []
    for k in np.flatnonzero(blur_px < BLUR_LIMIT_PX):
        z_m = depth_of_board(own, px[k], along[k, :, None] * rays[k], normal[k, 0], board, noise, rng)
        sigma_px = noise.sigma_2d_px * (np.exp(rng.normal(0, noise.spread)) if noise.spread else 1.0)
        sigma_px *= np.hypot(1.0, blur_px[k] / BLUR_NOISE_PX)
        found = px[k] + rng.normal(0, sigma_px, px[k].shape)
        n = len(found)
        out.append(BoardView(name, taken.stems[seen[k]], np.arange(n), found, z_m, np.full(n, 30)))
    return out


def write_wave(session: WaveSession, folder: Path) -> None:
    """A recording wave/ with empty image files, and its corners beside it as wave.csv."""
    path = folder / "wave"
    with_depth = {v.camera for v in session.views if np.isfinite(v.depth_m).any()}
    for camera, stamps in session.stamps_us.items():
        for kind in ("color", "depth") if camera in with_depth else ("color",):
            (path / camera / kind).mkdir(parents=True)
            for stem in stamps:
                (path / camera / kind / f"{stem}.png").touch()
        rows = ((stem, *own) for stem, own in stamps.items())
        write_table(path / camera / "timestamps.csv", ("frame", "color_us", "depth_us"), rows)
    lenses = {c: own.intrinsics for c, own in session.truth.cameras.items()}
    write_dataset(path, {c: CameraInfo(K.width, K.height) for c, K in lenses.items()}, session.board, synchronous=False)
    write_corners(folder / "wave.csv", session.views)


_ENDS = np.array([0.0, -0.5, 0.5])


def _rolled(
    own: RigCamera, clock: CameraClock, T_color_world: FloatArray, motion: HandMotion, t_s: FloatArray, X: FloatArray
) -> FloatArray:
    """Pixels (n, M, 2) of corners (n, M, 3) at times (n,) of the middle row, each at the instant of its own row."""
    n, M, _ = X.shape
    at = np.repeat(t_s[:, None], M, axis=1)
    px = np.zeros((n, M, 2))
    for _ in range(_ROUNDS if clock.readout_s else 1):
        if clock.readout_s and px.any():
            at = t_s[:, None] + clock.readout_s * ((px[..., 1] + 0.5) / own.intrinsics.height - 0.5)
        T = T_color_world @ (motion.poses(at.ravel()) if clock.readout_s else np.repeat(motion.poses(t_s), M, axis=0))
        p = np.einsum("nij,nj->ni", T[:, :3, :3], X.reshape(-1, 3)) + T[:, :3, 3]
        px = own.intrinsics.project(p).reshape(n, M, 2)
    return px
