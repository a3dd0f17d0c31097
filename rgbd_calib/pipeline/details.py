"""What a calibration leaves for its reader: residuals, the expected error over the working volume, where it started."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera as lens
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import Counted, ExpectedAlignment, ExpectedGrid, ExpectedPair, StartingCamera, StartingRig
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.rig.blocks import Scope
from rgbd_calib.rig.initialization import InitializationParams, initialize
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.uncertainty import JointCovariance, expected_alignment, volume
from rgbd_calib.types import Board, Correspondences, PlacedView, Rig, unposed
from rgbd_calib.views.corner_points import corner_points
from rgbd_calib.views.correspondence import correspond

GRID = 9
"""Points along each side of the working volume: 729 lines at most in a rig file."""


def joint_of_bundle(solved: Solution) -> JointCovariance:
    """Of all blocks of the cameras."""
    blocks = [b.name for b in solved.problem.blocks if b.scope is Scope.CAMERA]
    parameters = {name: {block: solved.index(block, name) for block in blocks} for name in solved.cameras}
    return JointCovariance(solved.covariance, parameters)


def joint_of_refinement(refined: RefinementResult) -> JointCovariance:
    """Poses alone."""
    parts = {name: {"pose": np.arange(6 * i, 6 * i + 6)} for i, name in enumerate(refined.cameras)}
    return JointCovariance(refined.joint_covariance, parts)


def expectation(
    rig: Rig, joint: JointCovariance, corners_m: FloatArray, cameras: Sequence[str]
) -> ExpectedAlignment | None:
    """Expected alignment error; None where no point of the box of `corners_m` is seen by two cameras."""
    expected = expected_alignment(rig, joint, volume(corners_m, GRID), cameras)
    if expected is None:
        return None
    T_reference_world = se3.inverse(rig.cameras[rig.reference].T_world_color)
    in_all = np.concatenate([e[np.isfinite(e)] for e in expected.pairs.values()])
    only_poses = all(set(own) == {"pose"} for own in joint.parameters.values())
    pairs = {
        " - ".join(pair): ExpectedPair(int(np.isfinite(e).sum()), _mm(np.nanmean(e)), _mm(np.nanmax(e)))
        for pair, e in expected.pairs.items()
    }
    grid = ExpectedGrid(
        np.round(se3.transform(T_reference_world, expected.points_m), 3), np.round(1e3 * expected.mean_m, 3)
    )
    counted = Counted.POSES if only_poses else Counted.ALL
    numbers = (_mm(in_all.mean()), _mm(np.percentile(in_all, 95)), _mm(in_all.max()))
    return ExpectedAlignment(counted, *numbers, pairs, grid, joint.kept())


def _mm(value_m: np.floating) -> float:
    return round(float(1e3 * value_m), 3)


def starting_rig(
    views: Sequence[PlacedView],
    rough: Mapping[str, FloatArray],
    intrinsics: Mapping[str, lens.Intrinsics],
    board: Board,
    reference: str,
    params: InitializationParams,
) -> StartingRig:
    """The rig before: first poses from depth as measured, intrinsics as given; what the fused cloud would look like."""
    try:
        data = correspond(views, board, unposed(intrinsics, {}))
        poses, how = initialize(data, dict(intrinsics), reference, params).T_world_color, "initialisation"
    except CalibrationError:
        poses, how = dict(rough), "single views of the board"
    return StartingRig(how, {name: StartingCamera(poses[name], own) for name, own in intrinsics.items()})


def residuals_of_bundle(solved: Solution, board: Board) -> Residuals:
    """Of every view, also of those that were dropped."""
    views, used = solved.course.views, solved.problem.obs
    there = np.arange(used.has_pixel.shape[1]) < np.array([len(placed.view.ids) for placed in views])[:, None]
    raw_m = np.full(there.shape, np.nan)
    for row, placed in zip(raw_m, views, strict=True):
        row[: len(placed.view.ids)] = placed.view.depth_m
    left_px, left_m = solved.problem.residuals(solved.state, used.keep(there, np.isfinite(raw_m)))
    names = [(p.view.camera, p.view.frame, str(k)) for p in views for k in p.front_corner(board)]
    camera, frame, feature = np.array(names, dtype=str).T
    predicted = np.array([p.view.predicted for p in views])
    return Residuals(
        camera,
        frame,
        feature,
        pixels_px=used.pixels_px[there],
        residual_px=np.where(predicted[:, None, None], np.nan, -left_px)[there],
        depth_m=raw_m[there],
        residual_depth_m=np.where(np.isfinite(raw_m), -left_m, np.nan)[there],
        used_pixel=used.has_pixel[there],
        used_depth=used.has_depth[there],
    )


def residuals_of_refinement(
    refined: RefinementResult, data: Correspondences, views: Sequence[PlacedView], board: Board
) -> Residuals:
    """Of every correspondence: against the free points of the paper."""
    left: dict[tuple[int, int], tuple[FloatArray, float]] = {}
    nothing = np.full(2, np.nan)
    for c, p, r in zip(data.pixel_camera, data.pixel_point, refined.residuals_2d_px, strict=True):
        left[int(c), int(p)] = (r, np.nan)
    for c, p, r in zip(data.xyz_camera, data.xyz_point, refined.residuals_3d_m, strict=True):
        left[int(c), int(p)] = (left.get((int(c), int(p)), (nothing, np.nan))[0], r[2])
    by_name = {(data.cameras[c], *data.labels[p]): value for (c, p), value in left.items()}
    return _of_views(views, board, lambda name: by_name.get(name, (nothing, np.nan)))


def residuals_of_rig(
    rig: Rig, views: Sequence[PlacedView], boards: Mapping[str, FloatArray], board: Board
) -> Residuals:
    """Against each frame's board, where nothing was refined."""
    left = {}
    for placed in views:
        view, own = placed.view, rig.cameras[placed.view.camera]
        p = se3.transform(se3.inverse(own.T_world_color) @ boards[view.frame], placed.points_m(board))
        r = view.corners_px - own.intrinsics.project(p)
        z_m = corner_points(view, placed.T_color_board, own.intrinsics, own.depth_sensor)[:, 2]
        for k, uv, z in zip(placed.front_corner(board), r, z_m - p[:, 2], strict=True):
            left[view.camera, view.frame, str(k)] = (uv, float(z))
    return _of_views(views, board, lambda name: left[name])


def _of_views(
    views: Sequence[PlacedView], board: Board, left: Callable[[tuple[str, str, str]], tuple[FloatArray, float]]
) -> Residuals:
    names = [(p.view.camera, p.view.frame, str(k)) for p in views for k in p.front_corner(board)]
    pairs = [left(name) for name in names]
    px, z = np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])
    camera, frame, feature = np.array(names, dtype=str).T
    return Residuals(
        camera,
        frame,
        feature,
        pixels_px=np.concatenate([p.view.corners_px for p in views]),
        residual_px=px,
        depth_m=np.concatenate([p.view.depth_m for p in views]),
        residual_depth_m=z,
        used_pixel=np.isfinite(px).all(axis=1),
        used_depth=np.isfinite(z),
    )
