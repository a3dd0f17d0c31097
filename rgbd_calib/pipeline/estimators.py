"""From checked views to a rig: the joint bundle, or the paper's methods (section 6), which take lens, depth and board as given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline import depth_cameras, details, frame_selection
from rgbd_calib.pipeline.checked_views import Views
from rgbd_calib.pipeline.config import Config, Method
from rgbd_calib.pipeline.detection import board_of
from rgbd_calib.pipeline.quality import bundle_quality, finite, initial_quality
from rgbd_calib.quality import CameraStatistics
from rgbd_calib.rig.biobjective import RefinementResult, refine
from rgbd_calib.rig.bundle import bundle, free_structure
from rgbd_calib.rig.initialization import InitializationResult, initialize
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Board, Correspondences, PlacedView, Rig, RigCamera
from rgbd_calib.views.board_pose import pose_view, repose
from rgbd_calib.views.correspondence import correspond

NO_COVARIANCE = np.zeros((6, 6))


@dataclass(frozen=True)
class Estimate:
    """What each method gives."""

    rig: Rig
    """Its quality is what the method says of itself."""
    views: Views
    """With the faces that the method decided on."""
    board: Board
    """With the shape that the method found, or took."""
    placed: tuple[PlacedView, ...]
    """The views, the boards posed by the rig."""
    boards: dict[str, FloatArray]
    """T_world_board (4, 4) by frame."""
    correspondences: Correspondences
    residuals: Residuals
    solution: Solution | RefinementResult | None
    """What the self-checks test; None where nothing was refined."""
    joint: JointCovariance | None


@dataclass(frozen=True)
class Posed:
    """Poses of cameras whose lens and depth are given."""

    rig: Rig
    refined: RefinementResult | None = None

    @property
    def joint(self) -> JointCovariance | None:
        return None if self.refined is None else details.joint_of_refinement(self.refined)


def by_bundle(views: Views, recording: Recording, config: Config) -> Estimate:
    """The joint bundle over the recording's views and those of an intrinsic recording."""
    nominal, reference = board_of(recording), views.association.reference
    cameras = list(recording.cameras)
    priors = frame_selection.bundle_priors(views.lenses, views.depth, recording, config.bundle)
    start = views.association.T_world_color
    alone = frame_selection.views_alone(views.lenses, views.depth.biases, recording, start, nominal, config)
    walls = Walls.of(cameras, views.depth.walls)
    solved = bundle([*views.association.views, *alone], nominal, priors, start, reference, config.bundle, walls)
    if config.bundle.structure == "free":
        solved = free_structure(solved)
    views = views.read_as(solved.course.views)
    rig = replace(rig_of_bundle(solved, reference), quality=bundle_quality(solved))
    board = replace(nominal, shape=solved.board_shape)
    placed = depth_cameras.at_the_corners(
        pose_by_rig(rig, views.association.views, board, config), rig, recording.cameras, board
    )
    return Estimate(
        rig,
        views,
        board,
        placed,
        solved.board_poses(),
        correspond(views.association.views, nominal, views.given),
        details.residuals_of_bundle(solved, nominal),
        solved,
        details.joint_of_bundle(solved),
    )


def by_poses(views: Views, recording: Recording, config: Config) -> Estimate:
    """The paper's methods: poses alone, from lenses, depth and a board that are given, or that the bundle found."""
    board, cameras, start = board_of(recording), views.given, None
    if config.start == "bundle":
        found = by_bundle(views, recording, config)
        board, cameras, views = found.board, found.rig.cameras, found.views
        start = InitializationResult({name: own.T_world_color for name, own in cameras.items()}, ())
    own = views.association.views
    data = correspond(own, board, cameras)
    posed = pose_cameras(data, cameras, views.association.reference, config, start)
    taken = f"lenses, depth and board {'of the bundle' if config.start == 'bundle' else 'as given'}, taken as exact"
    quality = replace(posed.rig.quality, message=f"{posed.rig.quality.message or 'first poses'}; {taken}")
    rig, refined = replace(posed.rig, quality=quality), posed.refined
    placed = pose_by_rig(rig, own, board, config)
    boards = {p.view.frame: rig.cameras[p.view.camera].T_world_color @ p.T_color_board for p in placed}
    if refined is None:
        residuals = details.residuals_of_rig(rig, placed, boards, board)
    else:
        residuals = details.residuals_of_refinement(refined, data, own, board)
    return Estimate(rig, views, board, placed, boards, data, residuals, refined, posed.joint)


def pose_cameras(
    data: Correspondences,
    cameras: Mapping[str, RigCamera],
    reference: str,
    config: Config,
    start: InitializationResult | None = None,
) -> Posed:
    """Poses by a method of the paper, from bare correspondences; `cameras` give lens and depth, `start` the first poses.

    Raises
    ------
    CalibrationError
        The correspondences do not determine the poses.
    """
    lenses = {name: own.intrinsics for name, own in cameras.items()}
    start = start or initialize(data, lenses, reference, config.initialization)
    at = {
        name: replace(cameras[name], T_world_color=T, covariance=NO_COVARIANCE)
        for name, T in start.T_world_color.items()
    }
    if config.method == "init":
        return Posed(Rig(reference, at, initial_quality(start)))
    assert config.method != "bundle"  # which poses no bare correspondences
    params = replace(config.refinement, method=config.method)
    refined = refine(data, lenses, start.T_world_color, reference, params)
    for name, T in refined.T_world_color.items():
        pixel, point = finite(refined.sigmas_2d_px[name]), finite(refined.sigmas_3d_m[name])
        model = None if point is None else "isotropic, for each coordinate"
        statistics = CameraStatistics(sigma_2d_px=pixel, sigma_3d_m=point, sigma_3d_model=model)
        covariance = refined.covariance.get(name, NO_COVARIANCE)
        at[name] = replace(cameras[name], T_world_color=T, covariance=covariance, statistics=statistics)
    return Posed(Rig(reference, at, initial_quality(start, refined)), refined)


ESTIMATORS: Mapping[Method, Callable[[Views, Recording, Config], Estimate]] = {
    "init": by_poses,
    "ba": by_poses,
    "icp": by_poses,
    "baicp+": by_poses,
    "biobjective": by_poses,
    "bundle": by_bundle,
}


def rig_of_bundle(solved: Solution, reference: str) -> Rig:
    cameras = {}
    for name in solved.cameras:
        cameras[name] = RigCamera(
            solved.intrinsics(name),
            solved.T_world_color(name),
            solved.pose_covariance(name),
            solved.depth_bias(name),
            solved.camera_statistics(name),
            solved.depth_field(name),
            solved.depth_camera(name),
        )
    return Rig(reference, cameras)


def pose_by_rig(rig: Rig, views: Sequence[PlacedView], board: Board, config: Config) -> tuple[PlacedView, ...]:
    """The same views, each board posed by its own pixels through the rig's intrinsics."""
    out = []
    for placed in views:
        own = rig.cameras[placed.view.camera]
        posed = pose_view(placed.view, board, own.intrinsics, own.depth_bias, config.board_pose)
        flat = replace(placed, T_color_board=posed.T_color_face @ board.T_face_board(placed.back, placed.turned))
        out.append(repose(flat, board, own.intrinsics))
    return tuple(out)
