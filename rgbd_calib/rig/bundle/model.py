"""Unknowns, residuals and derivatives of the joint bundle.

A view v is one board image of camera l in frame f. With X the board's corners (rigid, with an optional bow), the point
in the colour camera is p = T_color_world T_world_board X, and

    r_pixel = (psi(K_l, p) - q) / sigma_2d[l]                                  two for each corner      (eq. 2.3)
    r_depth = ([p]_z - (z + c0_l + c1_l z + ...)) / (k_l z^2)                  one, where depth was measured
    r_prior = L (theta - theta_0)                                              L'L = inverse prior covariance

A depth pixel measures z alone: its lateral error is the pixel's, twenty times smaller, so r_depth has one row. A
triangulating sensor has sigma_z = k z^2; k is estimated, and stands for the mean over a corner's cell of median size;
how it falls with the cell's size is estimated too (:mod:`.variance`).

Unknowns: for each camera 6 of its pose (left perturbation in the world; the reference's are held), 9 intrinsics, the
coefficients of its depth bias; for each frame 6 of the board's pose; 3 of the board's bow. A frame that only one camera
sees is posed in that camera, so that it does not tie its intrinsics to its pose.

The structure may be freed (:func:`free`): then each corner of a frame that several cameras see is a point of its own (the
paper's eq. 4.5), in place of the board's pose; views of one camera alone keep the board, which alone makes them say something.

Derivatives: T_world_color <- Exp(xi) T_world_color moves p by R_color_world (p_w x phi - rho); T_world_board <- Exp(xi)
T_world_board by the opposite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.polynomial import polynomial

from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.camera import N_INTRINSICS
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray, PlacedView

N_BOW = 3
POSE, INTRINSICS = slice(0, 6), slice(6, 6 + N_INTRINSICS)


@dataclass(frozen=True)
class Observations:
    """All views, padded to the same number of corners; V views, N corners, C cameras, F frames."""

    camera: IntArray
    """(V,)."""
    frame: IntArray
    """(V,) number of the board's pose."""
    shared: IntArray
    """(V,) bool: the frame is seen by several cameras, and its board is posed in the world."""
    points_m: FloatArray
    """(V, N, 3), in the board's frame."""
    corner: IntArray
    """(V, N), number of the front's corner at each, or before it."""
    pixels_px: FloatArray
    """(V, N, 2)."""
    depth_m: FloatArray
    """(V, N), as measured; 1 where there is none."""
    cell_ratio: FloatArray
    """(V, N), depth pixels that a corner rests on, over the median of its camera; 1 where there are none."""
    rounding_m: FloatArray
    """(V,), deviation of a depth that is rounded to the camera's unit, unit / sqrt(12)."""
    powers: FloatArray
    """(V, N, B), 1, z, z^2, ... with z held to the range of the camera's depth bias."""
    has_pixel: IntArray
    """(V, N) bool."""
    has_depth: IntArray
    """(V, N) bool."""

    def keep(self, has_pixel: IntArray, has_depth: IntArray) -> Observations:
        """The same views with other masks."""
        return replace(self, has_pixel=has_pixel, has_depth=has_depth)

    def only(self, views: slice | IntArray) -> Observations:
        """Some of the views."""
        return Observations(**{field.name: getattr(self, field.name)[views] for field in fields(self)})


@dataclass(frozen=True)
class State:
    """The unknowns."""

    T_world_color: FloatArray
    """(C, 4, 4)."""
    intrinsics: FloatArray
    """(C, 9)."""
    bias: FloatArray
    """(C, B), coefficients c0, c1, ...; z_true = z + c0 + c1 z + ..."""
    T_parent_board: FloatArray
    """(F, 4, 4); the parent is the world, or the camera of a frame that only one sees."""
    bow_m: FloatArray
    """(3,), see :func:`bow_basis`."""
    freed: IntArray
    """(F,) bool: the frame's corners are points of their own; its board's pose stands still and tells the normal."""
    corners_m: FloatArray
    """(F, M, 3), the front's corners in the world, of freed frames; M = 0 where none is."""

    @property
    def n_camera(self) -> int:
        """Parameters of one camera."""
        return 6 + N_INTRINSICS + self.bias.shape[1]

    @property
    def n_global(self) -> int:
        """Parameters of all cameras and the bow."""
        return len(self.intrinsics) * self.n_camera + N_BOW

    @property
    def n_structure(self) -> int:
        """Parameters of one frame: of the board's pose, of which a freed frame uses none, or of its corners."""
        return max(6, 3 * self.corners_m.shape[1])

    def moved(self, step_global: FloatArray, step_structure: FloatArray) -> State:
        """The state after a step (n_global,) and (F, n_structure)."""
        F, M, _ = self.corners_m.shape
        per_camera = step_global[:-N_BOW].reshape(len(self.intrinsics), self.n_camera)
        return State(
            se3.retract(self.T_world_color, per_camera[:, POSE]),
            self.intrinsics + per_camera[:, INTRINSICS],
            self.bias + per_camera[:, INTRINSICS.stop :],
            se3.retract(self.T_parent_board, np.where(self.freed[:, None], 0.0, step_structure[:, :6])),
            self.bow_m + step_global[-N_BOW:],
            self.freed,
            self.corners_m + step_structure[:, : 3 * M].reshape(F, M, 3) * self.freed[:, None, None],
        )


@dataclass(frozen=True)
class Linearized:
    """Unweighted residuals and derivatives; G = 6 + 9 + B + 3 + D: camera, bow, structure (the board's pose, or corners)."""

    residual: FloatArray
    """(V, N, 3): u and v in px, and depth in metres over z^2, r_depth times k; zero where there is no observation."""
    J: FloatArray
    """(V, N, 3, G)."""
    by_pose: FloatArray
    """(V, N, 3, 6), by a motion of all points of the view."""


def observe(
    views: Sequence[PlacedView], board: Board, units_m: Mapping[str, float], bias_range_m: FloatArray, n_bias: int
) -> tuple[Observations, tuple[str, ...]]:
    """Views as padded arrays, and the frame of each board pose; the depth's unit by camera; `bias_range_m` is (C, 2)."""
    cameras, units = list(units_m), np.array(list(units_m.values()))
    frames = sorted({placed.view.frame for placed in views})
    n = max(len(placed.view.ids) for placed in views)
    V = len(views)
    pixels, depth, points, corner = np.zeros((V, n, 2)), np.ones((V, n)), np.zeros((V, n, 3)), np.zeros((V, n), int)
    has_pixel, has_depth = np.zeros((V, n), bool), np.zeros((V, n), bool)
    cells = np.full((V, n), np.nan)
    for i, placed in enumerate(views):
        m = len(placed.view.ids)
        measured = np.isfinite(placed.view.depth_m)
        pixels[i, :m], points[i, :m] = placed.view.corners_px, placed.points_m(board)
        corner[i, :m] = placed.front_corner(board)
        has_pixel[i, :m], has_depth[i, :m] = True, measured
        depth[i, :m][measured] = placed.view.depth_m[measured]
        cells[i, :m][measured] = np.maximum(placed.view.depth_pixels[measured], 1)
    camera_of = np.array([cameras.index(placed.view.camera) for placed in views])
    frame_of = np.array([frames.index(placed.view.frame) for placed in views])
    shared = np.bincount(frame_of)[frame_of] > 1
    low, high = bias_range_m[camera_of, None].transpose(2, 0, 1)
    powers = np.asarray(polynomial.polyvander(np.clip(depth, low, high), n_bias - 1), np.float64)
    cell_ratio = _over_median(cells, camera_of)
    observations = Observations(
        camera_of,
        frame_of,
        shared,
        points,
        corner,
        pixels,
        depth,
        cell_ratio,
        units[camera_of] / np.sqrt(12),
        powers,
        has_pixel,
        has_depth,
    )
    return observations, tuple(frames)


def _over_median(cells: FloatArray, camera_of: IntArray) -> FloatArray:
    """Pixels of each cell over the median of its camera's, (V, N), 1 where there are none."""
    out = np.ones_like(cells)
    for c in np.unique(camera_of):
        mine = (camera_of == c)[:, None] & np.isfinite(cells)
        if mine.any():
            out[mine] = cells[mine] / np.median(cells[mine])
    return out


def bow_basis(points_m: FloatArray, board: Board) -> FloatArray:
    """(..., 3) shapes of a bent board by which z changes: x^2 - 1/3, x y, y^2 - 1/3, with x, y from -1 to 1 over it."""
    x = 2 * points_m[..., 0] / ((board.cols - 1) * board.square_m) - 1
    y = 2 * points_m[..., 1] / ((board.rows - 1) * board.square_m) - 1
    return np.stack([x * x - 1 / 3, x * y, y * y - 1 / 3], axis=-1)


def points_in_color(state: State, obs: Observations, board: Board) -> tuple[FloatArray, FloatArray]:
    """Corners (V, N, 3) in the parent's frame and in the colour camera's, metres."""
    points = obs.points_m.copy()
    points[..., 2] += bow_basis(obs.points_m, board) @ state.bow_m
    T = state.T_parent_board[obs.frame]
    freed = state.freed[obs.frame]
    if freed.any():
        points[freed] = obs.points_m[freed] * [0, 0, 1]  # from the front's corner to the one behind it
    p_parent = points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    if freed.any():
        p_parent[freed] += state.corners_m[obs.frame[freed, None], obs.corner[freed]] - T[freed, None, :3, 3]
    T_color_parent = color_parent(state, obs)
    p_color = p_parent @ T_color_parent[:, :3, :3].transpose(0, 2, 1) + T_color_parent[:, None, :3, 3]
    return p_parent, p_color


def residuals(state: State, obs: Observations, board: Board) -> tuple[FloatArray, FloatArray]:
    """Unweighted residuals of pixels (V, N, 2) and depth (V, N), as :class:`Linearized` has them."""
    _, p = points_in_color(state, obs, board)
    return _pixel_residual(state, obs, p), _depth_residual(state, obs, p)


def in_front(state: State, obs: Observations, board: Board) -> bool:
    """True where every observed corner lies before its camera."""
    return bool(np.all(points_in_color(state, obs, board)[1][obs.has_pixel][:, 2] > 0.01))


def linearize(state: State, obs: Observations, board: Board) -> Linearized:
    """Residuals and their derivatives by camera, bow and board."""
    p_parent, p = points_in_color(state, obs, board)
    V, N = obs.has_pixel.shape
    vector = np.repeat(state.intrinsics[obs.camera], N, axis=0)
    safe = np.where(obs.has_pixel[..., None], p, [0.0, 0.0, 1.0]).reshape(-1, 3)
    _, d_point, d_intrinsics = camera.project_jacobian(vector, safe)
    R_color_parent = color_parent(state, obs)[:, :3, :3]
    by_point = np.empty((V, N, 3, 3))  # of u, v, z by the point in the parent's frame
    by_point[:, :, :2] = (d_point.reshape(V, 2 * N, 3) @ R_color_parent).reshape(V, N, 2, 3)
    by_point[:, :, 2] = R_color_parent[:, None, 2]

    by_pose = np.concatenate([np.cross(p_parent[:, :, None], by_point), by_point], axis=-1)
    first = state.n_camera + N_BOW
    J = np.zeros((V, N, 3, first + state.n_structure))
    J[..., POSE] = np.where(obs.shared[:, None, None, None], -by_pose, 0.0)
    J[:, :, :2, INTRINSICS] = d_intrinsics.reshape(V, N, 2, N_INTRINSICS)
    J[:, :, 2, INTRINSICS.stop : state.n_camera] = -obs.powers
    freed = state.freed[obs.frame]
    normal_parent = np.where(freed[:, None], 0.0, state.T_parent_board[obs.frame][:, :3, 2])
    along_normal = np.einsum("vnij,vj->vni", by_point, normal_parent)
    J[..., state.n_camera : first] = along_normal[..., None] * bow_basis(obs.points_m, board)[:, :, None]
    J[..., first : first + 6] = np.where(freed[:, None, None, None], 0.0, by_pose)
    view, n = np.nonzero(freed[:, None] & obs.has_pixel)
    own = first + 3 * obs.corner[view, n, None] + np.arange(3)
    J[view[:, None], n[:, None], :, own] = by_point[view, n].transpose(0, 2, 1)
    for derivative in (J, by_pose):
        derivative[:, :, 2] /= (obs.depth_m**2)[..., None]
        derivative[:, :, :2] *= obs.has_pixel[:, :, None, None]
        derivative[:, :, 2] *= obs.has_depth[..., None]
    residual = np.concatenate([_pixel_residual(state, obs, p), _depth_residual(state, obs, p)[..., None]], axis=-1)
    return Linearized(residual, J, by_pose)


def free(state: State, obs: Observations, board: Board) -> tuple[State, Observations]:
    """The corners of frames that several cameras see as points of their own, and what can pose them.

    Corners that only one camera sees say nothing any more, and are left out.
    """
    freed = np.isin(np.arange(len(state.T_parent_board)), obs.frame[obs.shared])
    front = board.corners_m() + np.array([0.0, 0.0, 1.0]) * (bow_basis(board.corners_m(), board) @ state.bow_m)[:, None]
    corners_m = se3.transform(state.T_parent_board[:, None], front)
    number = obs.frame[:, None] * board.n_corners + obs.corner
    seen = np.bincount(number[obs.has_pixel], minlength=len(freed) * board.n_corners)[number]
    told = ~obs.shared[:, None] | (seen >= 2)
    return replace(state, freed=freed, corners_m=corners_m), obs.keep(obs.has_pixel & told, obs.has_depth & told)


def color_parent(state: State, obs: Observations) -> FloatArray:
    """T_color_parent (V, 4, 4): from the frame in which a view's board is posed to its camera's."""
    T_color_world = se3.inverse(state.T_world_color)[obs.camera]
    return np.where(obs.shared[:, None, None], T_color_world, np.eye(4))


def _pixel_residual(state: State, obs: Observations, p_color: FloatArray) -> FloatArray:
    vector = state.intrinsics[obs.camera][:, None, :]
    with np.errstate(all="ignore"):
        r = camera.project(np.broadcast_to(vector, (*p_color.shape[:2], N_INTRINSICS)), p_color) - obs.pixels_px
    return np.where(obs.has_pixel[..., None], r, 0.0)


def _depth_residual(state: State, obs: Observations, p_color: FloatArray) -> FloatArray:
    corrected = obs.depth_m + np.einsum("vnb,vb->vn", obs.powers, state.bias[obs.camera])
    return np.where(obs.has_depth, (p_color[..., 2] - corrected) / obs.depth_m**2, 0.0)
