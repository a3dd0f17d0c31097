"""Weights of the observations: their sigmas, robust weights on top, and the split of a view's residuals into two parts.

Errors inside one view are not independent: a board that moved between two exposures, or a depth sensor's error that is
smooth over the image, shift all its corners together. So the residuals of a view are split into what a change of the
board's pose in this view alone would explain (the columns of Q, orthonormal) and the rest. The first part has variances of its
own, `ratio`^2 times the rest's. Depth is weighed by them: the weighted residuals of a view's depth have the weight matrix

    W = I - Q (1 - ratio^-2) Q'

the inverse of their covariance I + Q (ratio^2 - 1) Q' (generalised least squares; A. C. Aitken, Proc. Roy. Soc. Edinb. 55, 1936).
Pixels are weighed alike, W = I, and the covariance alone has their variances: boards that lie wrong in the pixels have moved, or
their camera has, and that is found or not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import IntArray, Rows
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.observations import Observations, Walls
from rgbd_calib.rig.setup import BundleParams

PIXEL_PARTS, DEPTH_PARTS = np.array([0, 1, 2, 3, 3, 3]), np.array([0, 1, 1])
"""What is alike in the pose part of a view: the board's shift along the camera's axes, each by itself, and its turns, in
the pixels; its offset, and its tilts, in the depth."""
SIZES_COUNT = 0.1
"""Share of a change of a variance component that counts: of a prior, it moves the estimate less than a sigma does."""
N_PIXEL, N_DEPTH = len(PIXEL_PARTS), len(DEPTH_PARTS)


@dataclass(frozen=True)
class Weights:
    """V views, N corners, C cameras."""

    sigma_2d_px: FloatArray
    """(C,)."""
    k_depth: FloatArray
    """(C,), 1/m: sigma_z = k z^2."""
    cell_exponent: float
    """Depth of a corner has the deviation k z^2 (cell_ratio)^(-cell_exponent / 2): 1 for white noise in its pixels, 0
    where they err together."""
    ratio_pixel: FloatArray
    """(6,), in the order of the columns of Q; equal within PIXEL_PARTS."""
    ratio_depth: FloatArray
    """(3,), equal within DEPTH_PARTS."""
    weighs_depth: bool
    """Depth is weighed by its ratio. Not before the outliers are found: their boards would put each other in."""
    robust_pixel: FloatArray
    """(V, N), 0 ... 1."""
    robust_depth: FloatArray
    """(V, N), and less in a view so near that its depth is rounded more than noisy."""
    Q_pixel: FloatArray
    """(V, 2 N, 6): along the camera's axes x, y, z, then turns; less than orthonormal where a view has less."""
    Q_depth: FloatArray
    """(V, N, 3): offset, then tilts."""
    k_wall: FloatArray
    """(C,), 1/m: sigma_z = k z^2 of a cell of a wall."""
    robust_wall: FloatArray
    """(W, N), 0 ... 1."""
    distance_factor: float
    """How good the walls' distances are, over what was said of them."""
    robust_distance: FloatArray
    """(W,), 0 ... 1."""
    wall_tilt: FloatArray
    """(C,), deviation of each wall's tilts from those of all walls of the camera, rad."""
    wall_bend: FloatArray
    """(C,), deviation of each of the walls' bends, a share of the distance."""
    sizes: Mapping[str, float]
    """Of the variance components of the unknowns, by name."""

    @classmethod
    def first(
        cls, obs: Observations, walls: Walls, n_cameras: int, sizes: Mapping[str, float], params: BundleParams
    ) -> Weights:
        """Equal weights, no pose part."""
        V, N = obs.has_pixel.shape
        sigma, k = np.full(n_cameras, params.sigma_2d_px), np.full(n_cameras, params.k_depth_per_m)
        one, ratios = np.ones((V, N)), (np.ones(N_PIXEL), np.ones(N_DEPTH))
        Q = np.zeros((V, 2 * N, N_PIXEL)), np.zeros((V, N, N_DEPTH))
        of_walls = params.k_wall_per_m, params.wall_tilt_sd_rad, params.wall_bend
        k_wall, tilt, bend = (np.full(n_cameras, usual) for usual in of_walls)
        return cls(
            sigma,
            k,
            0.0,
            *ratios,
            False,
            one,
            one,
            *Q,
            k_wall,
            np.ones(walls.seen.shape),
            1.0,
            np.ones(walls.n),
            tilt,
            bend,
            dict(sizes),
        )

    def parts(self, kind: Kind) -> tuple[FloatArray, FloatArray]:
        """Q (V, n, d) of the pose parts of pixels, or of depth, and the ratio (d,) that W has."""
        if kind is Kind.PIXEL:
            return self.Q_pixel, np.ones(N_PIXEL)
        return self.Q_depth, self.ratio_depth if self.weighs_depth else np.ones(N_DEPTH)

    @property
    def excess_pixel(self) -> FloatArray:
        """(6,), by how much the variance of the pixels' pose parts exceeds what they are weighed by."""
        return np.asarray(self.ratio_pixel**2 - 1)

    def taken_off(self, kind: Kind, views: IntArray, rows: Rows) -> Rows | None:
        """What the weight matrix W takes off the products of rows of some views; None where it takes nothing."""
        Q, ratio = self.parts(kind)
        if not np.any(ratio > 1):
            return None
        return rows.parts(Q[views]).times(np.sqrt(1 - ratio**-2))

    def squares(self, kind: Kind, r: FloatArray) -> float:
        """r' W r of weighted residuals (V, n)."""
        Q, ratio = self.parts(kind)
        return float(np.sum(r**2) - np.sum(split(r, Q)[1] ** 2 @ (1 - ratio**-2)))

    def depth_sigma_m(self, obs: Observations) -> FloatArray:
        """(V, N), metres, of a corner's depth."""
        return np.asarray(self.k_depth[obs.camera, None] * obs.cell_ratio ** (-self.cell_exponent / 2) * obs.depth_m**2)

    def scales(self, obs: Observations) -> tuple[FloatArray, FloatArray]:
        """Factors (V, N) of residuals in px and metres: 1 / sigma, times the root of the robust weight, zero where unseen."""
        w_pixel = np.sqrt(self.robust_pixel) * obs.has_pixel / self.sigma_2d_px[obs.camera, None]
        return w_pixel, np.sqrt(self.robust_depth) * obs.has_depth / self.depth_sigma_m(obs)

    def wall_scales(self, walls: Walls) -> FloatArray:
        """The same (W, N) of the cells of walls, for residuals in metres."""
        return np.sqrt(self.robust_wall) * walls.seen / (self.k_wall[walls.camera, None] * walls.depth_m**2)

    def change(self, other: Weights) -> float:
        """Largest relative difference of any sigma or ratio."""
        if abs(self.cell_exponent - other.cell_exponent) > 0.1:
            return 1.0
        names = "sigma_2d_px", "k_depth", "ratio_pixel", "ratio_depth"
        ratios = [getattr(self, n) / getattr(other, n) for n in (*names, "k_wall")]
        ratios.append(np.array([(self.distance_factor / other.distance_factor) ** SIZES_COUNT]))
        ratios += [(getattr(self, n) / getattr(other, n)) ** SIZES_COUNT for n in ("wall_tilt", "wall_bend")]
        ratios.append(np.array([1.0, *(size / other.sizes[name] for name, size in self.sizes.items())]) ** SIZES_COUNT)
        return max(float(np.max(np.abs(np.log(ratio)))) for ratio in ratios)


def split(r: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (V, n) off the pose part (V, n), and that part in Q's coordinates (V, d)."""
    pose = np.einsum("vnd,vn->vd", Q, r)
    return r - np.einsum("vnd,vd->vn", Q, pose), pose


def huber(r_sigma: FloatArray, limit: float) -> FloatArray:
    """Weights (V, N) of residuals (V, N, m) in sigmas for each coordinate."""
    norm = np.linalg.norm(r_sigma, axis=-1) / np.sqrt(r_sigma.shape[-1])
    return np.minimum(1.0, limit / np.maximum(norm, 1e-12))


def in_order(Q: FloatArray, first: FloatArray) -> FloatArray:
    """The same spaces with bases that begin with the columns of `first`, (V, n, k), one after the other."""
    turned, _ = np.linalg.qr(Q.transpose(0, 2, 1) @ first, mode="complete")
    return Q @ turned


def orthonormal(A: FloatArray) -> FloatArray:
    """Orthonormal columns that span those of A (V, n, d); zero columns beyond its rank.

    From the eigenvectors of A'A: ten times faster than the singular values of A, and of the few columns of a pose, that
    are scaled to one length, good to 1e-8.
    """
    A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    values, vectors = np.linalg.eigh(A.transpose(0, 2, 1) @ A)
    kept = values > 1e-10 * np.maximum(values[:, -1:], 1e-300)
    return A @ (vectors * np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :])


def kinds_of(parts: IntArray, values: FloatArray) -> FloatArray:
    """Sums (kinds,) of values (d, ...) of pose parts of one kind."""
    return np.asarray(np.bincount(parts, values.reshape(len(parts), -1).sum(axis=1)), float)
