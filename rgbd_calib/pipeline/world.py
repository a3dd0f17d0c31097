"""Another world for a rig: a board's frame, or the floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.calibrate import Calibration
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.pipeline.evaluate import place_views
from rgbd_calib.pipeline.fuse import clouds_of
from rgbd_calib.pipeline.rig_inputs import board_for, common_cameras
from rgbd_calib.pipeline.verify import fit_views
from rgbd_calib.quality import FloorFit
from rgbd_calib.rig.floor import find_floor, world_on_floor
from rgbd_calib.trust.displacement import board_poses
from rgbd_calib.trust.uncertainty import joint_of
from rgbd_calib.types import Rig

BOARD, FLOOR = "board:", "floor"
_FRAMES_FOR_FLOOR = 3


def world_motion(
    world: str, rig: Rig, boards: Mapping[str, FloatArray], recording: Recording, seed: int
) -> tuple[FloatArray, FloorFit | None]:
    """T_new_world (4, 4) for `board:FRAME`, `floor` or a camera's id, and the floor where it is that.

    Raises
    ------
    ConfigError
        Neither of these, or a frame in which no board was posed.
    CalibrationError
        No floor is seen.
    """
    if world.startswith(BOARD):
        frame = world.removeprefix(BOARD)
        if frame not in boards:
            near = get_close_matches(frame, boards, 3, 0.0)
            raise ConfigError(
                f"--world {world}: no board was posed in frame '{frame}'; {len(boards)} frames have one. "
                f"Nearest: {', '.join(near) or 'none'}"
            )
        return se3.inverse(boards[frame]), None
    if world == FLOOR:
        return _floor(rig, recording, seed)
    if world in rig.cameras:
        return se3.inverse(rig.cameras[world].T_world_color), None
    raise ConfigError(
        f"--world {world}: board:FRAME, floor, or a camera needed; cameras are {', '.join(rig.cameras)}. Correct it"
    )


@one_blas_thread
def in_world(result: Calibration, world: str, recording: Recording, seed: int) -> Calibration:
    """A calibration in another world: rig, board poses and joint covariance."""
    T, floor = world_motion(world, result.rig, result.boards, recording, seed)
    joint = result.joint
    if joint is not None:
        joint = joint.moved(T)
    boards = {frame: T @ T_world_board for frame, T_world_board in result.boards.items()}
    return replace(result, rig=moved_rig(result.rig, T, world, floor), boards=boards, joint=joint)


@one_blas_thread
def rig_in_world(
    rig: Rig, world: str, recording: Recording, detections: Detections | None, config: Config
) -> tuple[Rig, dict[str, FloatArray]]:
    """A finished rig in another world, and the board poses that the recording shows, in it; `detections` for a board.

    The boards are posed by all cameras that see them, through the rig as it is.
    """
    boards: dict[str, FloatArray] = {}
    if detections is not None:
        board = board_for(recording, rig)
        placed = place_views(rig, detections.views, board, common_cameras(recording, rig), config)
        boards = board_poses(
            {name: own.T_world_color for name, own in rig.cameras.items()}, fit_views(rig, placed, board)
        )
    T, floor = world_motion(world, rig, boards, recording, config.seed)
    return moved_rig(rig, T, world, floor), {frame: T @ T_world_board for frame, T_world_board in boards.items()}


def moved_rig(rig: Rig, T_new_world: FloatArray, world: str, floor: FloorFit | None) -> Rig:
    """The rig in another world.

    Covariances are carried along by the adjoint. They still are of each camera against the reference, written in the new
    world's axes: where the reference itself stands in the new world is not counted, and its own covariance stays zero.
    """
    Ad = se3.adjoint(T_new_world)
    cameras = {
        name: replace(own, T_world_color=T_new_world @ own.T_world_color, covariance=Ad @ own.covariance @ Ad.T)
        for name, own in rig.cameras.items()
    }
    expected = rig.quality.expected_alignment
    if expected is not None and (joint := joint_of(rig)) is not None:
        expected = replace(expected, joint=joint.moved(T_new_world).kept())
    quality = replace(rig.quality, world=world, floor=floor or rig.quality.floor, expected_alignment=expected)
    return replace(rig, cameras=cameras, quality=quality)


def _floor(rig: Rig, recording: Recording, seed: int) -> tuple[FloatArray, FloorFit]:
    cameras = common_cameras(recording, rig)
    with_depth = {f: sum(recording.has_depth(c, f) for c in cameras) for f in recording.frames}
    frames = sorted(with_depth, key=lambda f: (-with_depth[f], f))[:_FRAMES_FOR_FLOOR]
    if not frames or with_depth[frames[0]] == 0:
        raise CalibrationError(
            f"{recording.path}: --world floor needs depth images; there are none. Use --world board:FRAME"
        )
    points, eyes = [], []
    for frame in frames:
        for cloud in clouds_of(recording, rig, frame) if with_depth[frame] else ():
            thin = cloud.points_m[:: max(1, len(cloud.points_m) // 20000)]
            points.append(thin)
            eyes.append(np.broadcast_to(rig.cameras[cloud.camera].T_world_color[:3, 3], thin.shape))
    poses = [rig.cameras[c].T_world_color for c in cameras]
    floor = find_floor(np.concatenate(points), np.concatenate(eyes), poses, np.random.default_rng(seed))
    T = world_on_floor(floor, rig.cameras[rig.reference].T_world_color)
    height = float((T @ rig.cameras[rig.reference].T_world_color)[2, 3])
    return T, FloorFit(tuple(frames), floor.points, floor.rms_m, height)
