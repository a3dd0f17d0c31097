"""From correspondences to terms and a start: what the estimator works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective import checks, groups, start
from rgbd_calib.rig.biobjective.groups import Grouping
from rgbd_calib.rig.biobjective.loss import Loss
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.params import RefinementParams
from rgbd_calib.rig.biobjective.solver import RefinementState, Term
from rgbd_calib.rig.biobjective.terms import MeasuredPointTerm, PixelTerm
from rgbd_calib.types import Correspondences, IntArray


@dataclass(frozen=True)
class RefinementProblem:
    """Cameras in the solver's order (the reference first), terms and their start."""

    cameras: tuple[str, ...]
    pixels: PixelTerm | None
    xyz: MomentTerm | MeasuredPointTerm | None
    start: RefinementState
    pixel_rows: IntArray
    """Rows of the table of pixels that the term was given."""
    dropped: dict[str, int]

    mean_focal_px: float

    def kind(self, term: Term) -> int:
        """0 for the pixels, 1 for the 3D points."""
        return 0 if term is self.pixels else 1

    @property
    def terms(self) -> list[Term]:
        return [term for term in (self.pixels, self.xyz) if term is not None]


def build(
    data: Correspondences,
    intrinsics: dict[str, Intrinsics],
    T_world_color: dict[str, FloatArray],
    reference: str,
    params: RefinementParams,
) -> RefinementProblem:
    """Terms and start of checked data; raises CalibrationError where the data cannot carry them."""
    cameras = (reference, *(c for c in data.cameras if c != reference))
    number = np.array([cameras.index(c) for c in data.cameras])
    T = np.stack([np.asarray(T_world_color[c], float) for c in cameras])
    models = tuple(intrinsics[c] for c in cameras)
    dropped: dict[str, int] = {}
    pixels, xyz, points = None, None, []
    rows = np.empty(0, int)
    if params.method != "icp":
        pixels, X, rows = _pixel_term(data, number, models, T, params, dropped)
        points.append(X)
    if params.method != "ba":
        xyz, X = _xyz_term(data, number, T, params, dropped)
        points.append(X)
    problem = RefinementProblem(
        cameras, pixels, xyz, RefinementState(T, tuple(points)), rows, dropped, _mean_focal(models)
    )
    _check(problem, data, params)
    return problem


def _pixel_term(
    data: Correspondences,
    number: IntArray,
    models: tuple[Intrinsics, ...],
    T: FloatArray,
    params: RefinementParams,
    dropped: dict[str, int],
) -> tuple[PixelTerm, FloatArray, IntArray]:
    camera = number[data.pixel_camera]
    rays = start.rays(data.pixels_px, camera, models)
    good = np.isfinite(rays).all(axis=1)
    _count(dropped, "pixels beyond what the lens model can be inverted for", int((~good).sum()))
    while True:
        rows = np.flatnonzero(good)
        grouping = groups.by_visibility(camera[rows], data.pixel_point[rows], len(models))
        X, in_front = start.triangulate(grouping, rays[rows], T)
        if in_front.all():
            break
        behind = np.isin(data.pixel_point, grouping.labels[~in_front]) & good
        _count(dropped, "pixels of points that start behind a camera", int(behind.sum()))
        good &= ~behind
    _count(dropped, "pixels of points that no other camera sees", len(grouping.alone))
    if not len(grouping.labels):
        raise CalibrationError(
            f"refinement ({params.method}): no pixel feature is seen by two cameras. Record views that cameras share, or use icp"
        )
    return PixelTerm(grouping, data.pixels_px[rows], models, Loss(params.loss, params.loss_scale)), X, rows


def _xyz_term(
    data: Correspondences, number: IntArray, T: FloatArray, params: RefinementParams, dropped: dict[str, int]
) -> tuple[MomentTerm | MeasuredPointTerm, FloatArray]:
    grouping = groups.by_visibility(number[data.xyz_camera], data.xyz_point, len(T))
    _count(dropped, "3D measurements of points that no other camera measures", len(grouping.alone))
    if not len(grouping.labels):
        raise CalibrationError(
            f"refinement ({params.method}): no 3D point is measured by two cameras. Record views that cameras share, or use ba"
        )
    pairs = params.pairs == "paper" or params.method == "baicp+"
    if data.xyz_covariance is None and params.loss == "squared" and not params.per_camera_sigmas:
        return MomentTerm(grouping, data.xyz_m, T, pairs), np.empty((3, 0))
    if pairs:
        raise CalibrationError(
            "xyz_covariance: given with pairs of points (pairs paper or method baicp+), which eq. 2.6 weighs all alike. "
            "Use the latent form, or leave the covariances out"
        )
    loss = Loss(params.loss, params.loss_scale)
    term = MeasuredPointTerm(grouping, data.xyz_m, data.xyz_covariance, len(T), loss)
    return term, start.mean_points(grouping, data.xyz_m, T)


def _check(problem: RefinementProblem, data: Correspondences, params: RefinementParams) -> None:
    pixels = None if problem.pixels is None else problem.pixels.grouping
    xyz = None if problem.xyz is None else problem.xyz.grouping
    checks.structure(problem.cameras, pixels, xyz)
    checks.spread(problem.cameras, [(g, X, 0.0) for g, X in point_sets(problem, problem.start, data)])
    equations = sum(
        d * g.n_observations - 3 * len(g.labels) for d, g in ((2, pixels), (3, xyz)) if isinstance(g, Grouping)
    )
    checks.freedom(equations, 6 * (len(problem.cameras) - 1) - (params.method == "ba"), f"refinement ({params.method})")
    if params.per_camera_sigmas and len(problem.cameras) < 3:
        raise CalibrationError(
            "per_camera_sigmas: two cameras see only the sum of their noise. Use three cameras or more, or one sigma for all"
        )


def point_sets(
    problem: RefinementProblem, state: RefinementState, data: Correspondences
) -> list[tuple[Grouping, FloatArray]]:
    """Groupings and their points (3, h) in the world, of the pixels and of the 3D measurements, where there are any."""
    sets = []
    if problem.pixels is not None:
        sets.append((problem.pixels.grouping, state.points[0]))
    if isinstance(problem.xyz, MomentTerm):
        sets.append((problem.xyz.grouping, start.mean_points(problem.xyz.grouping, data.xyz_m, state.T)))
    elif problem.xyz is not None:
        sets.append((problem.xyz.grouping, state.points[-1]))
    return sets


def known_sigmas(params: RefinementParams) -> tuple[float | None, float | None]:
    """sigma_2D and sigma_3D where they were given."""
    return params.sigma_2d_px, params.sigma_3d_m


def _count(dropped: dict[str, int], reason: str, n: int) -> None:
    if n:
        dropped[reason] = dropped.get(reason, 0) + n


def _mean_focal(models: tuple[Intrinsics, ...]) -> float:
    return float(np.mean([(model.fx + model.fy) / 2 for model in models]))
