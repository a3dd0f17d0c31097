"""Motion of a camera from tracked pixels and patches of depth together.

Unknowns: a left perturbation xi = (phi, rho) of T_old_new, a shift s of all tracks in common, and the drift e of the new depth
against the old,

    e(x, y, z) = a + b z + (c x + d y) (z / z0)^2,         x, y from -1 to 1 over the image

Rows, with Exp(xi) T_old_new p_new for the place of a new point in the old camera's frame:

    pixel    C (pi(T_new_old p_old) + s - q_new) = 0                  2 px rows a track, p_old from the old pixel and depth
    patch    n_old . (T_old_new (m_new + e ray) - m_old) = 0          1 row a patch, metres

The old depth's own error is in both depth images alike and cancels in the patches, but for what a patch loses by lying at
another pixel; a, b, c, d with their priors stand for that and for warm-up. A track needs the depth only for its parallax. Tracks
that move by part of a pixel are off by some hundredths, all alike: s, with a prior that is zero for an image that stays.

C makes the errors of a track independent and of one size: its covariance is what the images' noise gives (along an edge a track
tells little) and, across and down the image, a floor that all tracks share, since texture is sampled anew when a camera moves.
Both floors are estimated. Weights are Tukey's. Each kind of row has a variance component: sigma^2 from the residuals, times an
inflation for the weights and for what the rows of a cell of the image share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.linear import BoolArray, symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot import tukey
from rgbd_calib.trust.snapshot.pixels import Matches
from rgbd_calib.trust.snapshot.surfaces import Patches, Surface

DRIFT_SD = np.array([0.005, 0.003, 0.001, 0.001])
"""Priors of a (m), b, c and d (m): a time-of-flight camera warms up by 5 mm (Lachat et al. 2015), structured light by some
per mille; the tilts are those of a depth field seen at other pixels."""
_SHARED_PX = 0.04
"""Deviation of the tracks' shift in common: interpolation's bias, a few hundredths of a pixel."""
_MOVES_PX = 0.5
"""An image that moves by less has less of it."""
ANYWHERE = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
"""Deviations (rad, m) of directions that nothing determines: in the covariance only, they pull nowhere."""
_DRIFT_AT_M = 3.0
_CELLS = (5, 4)
_LEAST_SLOPE = 0.2
"""Of the weighted residuals, of their weights: 0.83 for normal errors."""
_LEAST = 0.3
"""Least scale of the rows, of what is expected of them."""
_FLOORS_PX = 0.003, 2.0
"""Between these, the tracks' errors beyond the noise."""
_ROUNDS, _STEPS = 8, 3
_SETTLED = 1e-4
"""Square of the last step of a round, in standard deviations, that ends them."""
_GATE_PX = 4.0


@dataclass(frozen=True)
class Tracks:
    """Points of the old camera's frame, and where the new image has them."""

    points_m: FloatArray
    """(n, 3)."""
    pixels: Matches
    noise_px2: FloatArray
    """(n, 2, 2), their covariance by the noise of the images, px^2."""


@dataclass(frozen=True)
class RowNoise:
    """The variance component of one kind of row."""

    rows: float
    """Sum of the weights."""
    sigma: float
    inflation: float

    @property
    def variance(self) -> float:
        return self.sigma**2 * self.inflation


@dataclass(frozen=True)
class Motion:
    """The estimate."""

    T_old_new: FloatArray
    """(4, 4), p_old = T_old_new p_new."""
    covariance: FloatArray
    """(6, 6) of the left perturbation (rad, m)."""
    drift: FloatArray
    """(4,), as :data:`DRIFT_SD`."""
    drift_sd: FloatArray
    tracks: RowNoise
    """In deviations expected of a track."""
    patches: RowNoise
    """In deviations expected of a patch."""
    correlation: FloatArray
    """(6, 4) between motion and drift."""


@dataclass(frozen=True)
class _Rows:
    J: FloatArray
    """(n, r, 12), by motion, drift and shift."""
    r: FloatArray
    """(n, r)."""
    cell: np.ndarray
    """(n,)."""


def fit_motion(tracks: Tracks, lens: Intrinsics, old: Surface, new: Surface, start: FloatArray) -> Motion:
    """The motion from `start` (4, 4), T_old_new."""
    pixels, planes = old.planes
    T, nuisance = start, np.zeros(6)
    flow_px = np.linalg.norm(tracks.pixels.new_px - tracks.pixels.old_px, axis=1)
    moves = min(float(np.median(flow_px)) / _MOVES_PX, 1.0) if len(flow_px) else 1.0
    nuisance_sd = np.concatenate([DRIFT_SD, np.full(2, max(_SHARED_PX * moves, 1e-3))])
    of_tracks, of_patches = RowNoise(0.0, 1.0, 1.0), RowNoise(0.0, 1.0, 1.0)
    prior = np.diag(np.concatenate([ANYWHERE, nuisance_sd]) ** -2.0)
    H = prior
    for _ in range(_ROUNDS):
        there, which = seen_again(planes, new, T)
        mine, cells = planes.only(which), _cells(pixels[which], old.shape)
        sigma_m = _expected(mine, old, new)
        for _ in range(_STEPS):
            rows_px, near = _pixel_rows(tracks, lens, T, nuisance[4:])
            rows_m = _patch_rows(mine, there, sigma_m, T, nuisance[:4], cells)
            of_tracks, w_px = _weigh(rows_px, of_tracks, near)
            of_patches, w_m = _weigh(rows_m, of_patches)
            H, g = prior.copy(), np.concatenate([np.zeros(6), nuisance / nuisance_sd**2])
            for rows, w, noise in ((rows_px, w_px, of_tracks), (rows_m, w_m, of_patches)):
                wJ = rows.J * (w / noise.variance)[:, None, None]
                H += np.einsum("nri,nrj->ij", wJ, rows.J)
                g += np.einsum("nri,nr->i", wJ, rows.r)
            step = -symmetric_inverse(H) @ g
            T, nuisance = se3.retract(T, step[:6]), nuisance + step[6:]
        if step @ H @ step < _SETTLED:
            break
    covariance = symmetric_inverse(H)
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance[:6, 6:10] / np.maximum(np.outer(sd[:6], sd[6:10]), 1e-30)
    return Motion(T, covariance[:6, :6], nuisance[:4], sd[6:10], of_tracks, of_patches, correlation)


def seen_again(planes: Patches, new: Surface, T_old_new: FloatArray) -> tuple[Patches, np.ndarray]:
    """The patches of the new surface where the old ones should be, and which of the old ones (m,) have one.

    A patch that is not in the new image, not measured there, or not on one plane there has none.
    """
    pixels, inside = new.pixels_of(se3.transform(se3.inverse(T_old_new), planes.points_m))
    which = np.flatnonzero(inside)
    there = new.patches(pixels[which])
    return there.only(there.good), which[there.good]


def _expected(planes: Patches, old: Surface, new: Surface) -> FloatArray:
    """(n,) deviation expected of a patch's row, metres, up to its variance component."""
    z, cos = planes.points_m[:, 2], -np.einsum("ij,ij->i", planes.normals, planes.points_m)
    cos = cos / np.linalg.norm(planes.points_m, axis=1)
    return np.asarray(np.hypot(np.hypot(old.k_per_m, new.k_per_m) * z**2 * cos, 0.2e-3))


def _pixel_rows(tracks: Tracks, lens: Intrinsics, T: FloatArray, shared_px: FloatArray) -> tuple[_Rows, BoolArray]:
    """Whitened, and which tracks (n,) are near where they are expected."""
    T_new_old = se3.inverse(T)
    p = se3.transform(T_new_old, tracks.points_m)
    ahead = p[:, 2] > 0.05
    at, by_point, _ = camera.project_jacobian(lens.vector, np.where(ahead[:, None], p, [0.0, 0.0, 1.0]), lens.model)
    J = np.zeros((len(p), 2, 12))
    J[..., 10:] = np.eye(2)
    J[..., :6] = -by_point @ T_new_old[:3, :3] @ se3.by_motion(tracks.points_m)
    left = np.where(ahead[:, None], at + shared_px - tracks.pixels.new_px, 1e3)
    near = np.linalg.norm(left, axis=1) < _GATE_PX
    whitening = _whitening(left, tracks.noise_px2, near)
    r = np.einsum("nij,nj->ni", whitening, left)
    return _Rows(whitening @ J, r, _cells(tracks.pixels.new_px, (lens.height, lens.width))), near


def _whitening(left_px: FloatArray, noise_px2: FloatArray, near: BoolArray) -> FloatArray:
    """(n, 2, 2), inverse roots of the tracks' covariance, the floors with which residuals (n, 2) are as large as expected."""
    used, whitening = near, np.tile(np.eye(2), (len(left_px), 1, 1))
    for _ in range(3):  # again without what is far out
        if np.count_nonzero(used) < tukey.FEWEST:
            break
        # with which half of the squares, over their variances, lie below the median of a normal variable's square
        beyond = (left_px[used] / tukey.MEDIAN_OF_SIZE[1]) ** 2 - np.einsum("nii->ni", noise_px2[used])
        floors = np.clip(np.median(beyond, axis=0), *np.square(_FLOORS_PX))
        variance, V = np.linalg.eigh(noise_px2 + np.diag(floors))
        whitening = V / np.sqrt(variance)[:, None] @ V.transpose(0, 2, 1)
        r = np.einsum("nij,nj->ni", whitening, left_px)
        used = near & (np.sqrt(np.mean(r**2, axis=1)) < tukey.LIMIT)
    return np.asarray(whitening)


def _patch_rows(
    planes: Patches,
    there: Patches,
    sigma_m: FloatArray,
    T: FloatArray,
    drift: FloatArray,
    cells: np.ndarray,
) -> _Rows:
    m = there.points_m
    ray, shapes = _drift_shapes(m)
    moved = se3.transform(T, undrifted(m, drift))
    r = np.einsum("ni,ni->n", planes.normals, moved - planes.points_m)
    J = np.zeros((len(m), 1, 12))
    J[:, 0, :6] = np.einsum("ni,nij->nj", planes.normals, se3.by_motion(moved))
    J[:, 0, 6:10] = np.einsum("ni,ni->n", planes.normals, ray @ T[:3, :3].T)[:, None] * shapes
    return _Rows(J / sigma_m[:, None, None], (r / sigma_m)[:, None], cells)


def undrifted(points_m: FloatArray, drift: FloatArray) -> FloatArray:
    """New points (n, 3), metres, with the drift (4,) of their depth against the old taken off."""
    ray, shapes = _drift_shapes(points_m)
    return points_m + (shapes @ drift)[:, None] * ray


def _drift_shapes(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rays (n, 3) with z = 1, and derivatives (n, 4) of the depth's error by the drift."""
    z = np.maximum(points_m[:, 2], 0.05)
    ray = points_m / z[:, None]
    far = (z / _DRIFT_AT_M) ** 2
    # x, y by the ray: half the image is about half a focal length
    return ray, np.stack([np.ones_like(z), z, 2 * ray[:, 0] * far, 2 * ray[:, 1] * far], axis=1)


def _cells(pixels: FloatArray, shape: tuple[int, int]) -> np.ndarray:
    """Number (n,) of the cell of the image (h, w) that pixels (n, 2) are in."""
    h, w = shape
    columns, rows = _CELLS
    u = np.clip((pixels[:, 0] + 0.5) * columns / w, 0, columns - 1).astype(int)
    v = np.clip((pixels[:, 1] + 0.5) * rows / h, 0, rows - 1).astype(int)
    return np.asarray(v * columns + u)


def _weigh(rows: _Rows, before: RowNoise, near: BoolArray | None = None) -> tuple[RowNoise, FloatArray]:
    """Scale, inflation and Tukey's weights (n,) of one kind of row; only those that are `near` (n,) count for the scale."""
    n, r = rows.r.shape
    size = np.sqrt(np.mean(rows.r**2, axis=1))
    near = np.ones(n, bool) if near is None else near
    if np.count_nonzero(near) < tukey.FEWEST:
        return replace(before, rows=0.0), np.zeros(n)
    sigma = tukey.scale(size, r, _LEAST, near)
    u, w = tukey.weights(size, sigma)
    return RowNoise(float(w.sum()), sigma, _inflation(rows, u, sigma)), w


def _inflation(rows: _Rows, u: FloatArray, sigma: float) -> float:
    """How many times sigma^2 / sum(w) is the variance of a mean, for what cells share and for the weights.

    M-estimates have the covariance A^-1 B A^-1, A the slope of the weighted residuals psi = w r and B their covariance
    (P. Huber, Robust Statistics, 1981, 6.3): that of the cells' sums, at least that of independent rows.

    Parameters
    ----------
    u : (n,), squares of the rows' sizes over those that weigh nothing, w = (1 - u)^2.
    """
    w, per = (1 - u) ** 2, rows.r.shape[1]
    slope = float(np.sum(w - 4 / per * (1 - u) * u))
    shared = float(np.sum(w**2 * np.mean(rows.r**2, axis=1))) / float(w.sum())
    count = np.bincount(rows.cell, w)
    used = count > 1
    if np.count_nonzero(used) >= 6:
        squares = 0.0
        for k in range(per):
            total = np.bincount(rows.cell, w * rows.r[:, k], minlength=len(count))
            squares += float(np.sum(total[used] ** 2 / count[used]))
        # six of the cells' means go into the motion
        shared = max(shared, squares / max(per * np.count_nonzero(used) - 6, 1))
    return shared / sigma**2 * (float(w.sum()) / max(slope, _LEAST_SLOPE * float(w.sum()))) ** 2
