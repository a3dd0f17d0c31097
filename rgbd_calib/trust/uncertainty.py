"""How far apart two cameras of a rig put the same point, as its covariance lets expect.

Camera l puts a pixel q with the reported depth z at

    P_l = T_world_color[l] (z_true ray(K_l, q)),        z_true = z + c0_l + c1_l z + ...

With the rig's parameters theta ~ N(theta^, Sigma), the two places of one point differ by d = P_a - P_b, to first order
Gaussian with covariance S = J Sigma J', J = [dP_a/dtheta_a, -dP_b/dtheta_b]. The poses, intrinsics and biases of the
two cameras are correlated; so Sigma is the joint covariance, not one matrix a camera. The mean distance is exactly

    E|d| = 2 sqrt(2 / pi) R_G(l_1, l_2, l_3)            l_i the eigenvalues of S, R_G Carlson's integral

(polar coordinates: a Gaussian's mean length, times the mean of sqrt(u' S u) over the sphere, which is R_G). It is the
error of the calibration alone: the noise of a single depth comes on top.

References
----------
B. C. Carlson, Numerical computation of real or complex elliptic integrals, Numerical Algorithms 10, 1995.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.polynomial import polynomial
from scipy.special import elliprg

from rgbd_calib.geometry import camera, se3, so3
from rgbd_calib.geometry.camera import N_INTRINSICS
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Rig

NEAREST_M, FARTHEST_M = 0.3, 4.0
"""Depths at which a camera of this kind measures."""

_N_POSE = 6
_MEAN_LENGTH = 2 * np.sqrt(2 / np.pi)  # of a Gaussian with three unit variances


@dataclass(frozen=True)
class Observed:
    """What the depth sensor of one camera of a rig would report of points (n, 3)."""

    pixels_px: FloatArray
    """(n, 2), of the depth image."""
    raw_m: FloatArray
    """(n,), the depth that the sensor would report without noise, its error included."""
    z_m: FloatArray
    """(n,), along the colour camera's axis."""
    seen: np.ndarray
    """(n,) bool: inside the image, at a depth that is measured."""


@dataclass(frozen=True)
class ExpectedAlignment:
    """Expected distance between the places where two cameras put the same point."""

    points_m: FloatArray
    """(n, 3), in the world: those of the volume that two cameras see."""
    pairs: dict[tuple[str, str], FloatArray]
    """(n,), metres; NaN where the two do not both see the point."""

    @property
    def mean_m(self) -> FloatArray:
        """(n,), mean over the pairs that see the point."""
        mean: FloatArray = np.nanmean(np.stack(list(self.pairs.values())), axis=0)
        return mean


def volume(corners_m: FloatArray, side: int) -> FloatArray:
    """Grid (side^3, 3) over the box of points (n, 3), metres, in the world."""
    sides = [np.linspace(lo, hi, side) for lo, hi in zip(corners_m.min(axis=0), corners_m.max(axis=0), strict=True)]
    points: FloatArray = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    return points


def observe(rig: Rig, name: str, points_m: FloatArray) -> Observed:
    """What a camera's depth sensor reports of points (n, 3), metres, in the world."""
    own = rig.cameras[name]
    sensor = own.depth_sensor
    p = se3.transform(se3.inverse(own.T_world_color), points_m)
    lens, T_color_depth = sensor.camera.intrinsics, sensor.camera.T_color_depth
    p_depth = se3.transform(se3.inverse(T_color_depth), p)
    with np.errstate(all="ignore"):
        pixels, raw = sensor.report(p)
        back = lens.unproject(pixels, p_depth[:, 2])
    inside = np.all((pixels >= 0) & (pixels <= lens.size_px - 1), axis=1)
    z = p_depth[:, 2]
    seen = inside & (z > NEAREST_M) & (z < FARTHEST_M) & (np.linalg.norm(back - p_depth, axis=1) < 1e-6)
    return Observed(pixels, raw, p[:, 2], seen)


def place(rig: Rig, name: str, pixels_px: FloatArray, raw_m: FloatArray) -> FloatArray:
    """Where a camera puts pixels (n, 2) of its depth image with reported depths (n,): points (n, 3), metres, in the world."""
    own = rig.cameras[name]
    return se3.transform(own.T_world_color, own.depth_sensor.points(pixels_px, raw_m))


def expected_alignment(
    rig: Rig,
    covariance: FloatArray,
    parameters: Mapping[str, slice],
    points_m: FloatArray,
    cameras: Sequence[str] | None = None,
) -> ExpectedAlignment | None:
    """Expected alignment error at points (n, 3), metres, in the world.

    Parameters
    ----------
    covariance : (P, P), joint, of all cameras.
    parameters : where each camera's parameters stand in it: 6 of the left perturbation (rad, m) of its pose in the
        world; or these, 9 intrinsics and any number of coefficients of its depth bias. What is not there is taken as
        exact.
    cameras : those with depth; None: all.

    Returns
    -------
    None where no point is seen by two of the cameras.
    """
    names = [name for name in rig.cameras if name in (cameras or rig.cameras)]
    observed = {name: observe(rig, name, points_m) for name in names}
    often = np.sum([o.seen for o in observed.values()], axis=0) > 1 if len(names) > 1 else np.zeros(len(points_m), bool)
    if not often.any():
        return None
    kept = {name: _keep(o, often) for name, o in observed.items()}
    jacobians = {name: place_jacobian(rig, name, o, _width(parameters[name])) for name, o in kept.items()}
    pairs = {}
    for a, b in combinations(names, 2):
        both = kept[a].seen & kept[b].seen
        if both.any():
            at = np.concatenate([_range(parameters[a]), _range(parameters[b])])
            J = np.concatenate([jacobians[a][both], -jacobians[b][both]], axis=-1)
            pairs[a, b] = np.full(len(both), np.nan)
            pairs[a, b][both] = _mean_length(J @ covariance[np.ix_(at, at)] @ J.transpose(0, 2, 1))
    return ExpectedAlignment(points_m[often], pairs)


def place_jacobian(rig: Rig, name: str, observed: Observed, width: int) -> FloatArray:
    """Derivative (n, 3, width) of :func:`place` by the camera's parameters, pixel and reported depth held.

    By the pose: Exp(xi) P - P = phi x P + rho. By the intrinsics: the point slides in its plane of depth z such that
    its pixel stays, d(x, y) = -(dpsi/d(x, y))^-1 dpsi/dK. By the bias: along the ray.
    """
    own = rig.cameras[name]
    T = own.T_world_color
    p = own.intrinsics.unproject(observed.pixels_px, observed.z_m)
    P = se3.transform(T, p)
    J = np.zeros((len(p), 3, width))
    J[..., :3], J[..., 3:_N_POSE] = -so3.hat(P), np.eye(3)
    if width == _N_POSE:
        return J
    ok = np.isfinite(p).all(axis=1) & (p[:, 2] > 0)
    _, by_point, by_lens = camera.project_jacobian(
        own.intrinsics.vector, np.where(ok[:, None], p, [0.0, 0.0, 1.0]), own.intrinsics.model
    )
    slide = np.zeros((len(p), 3, N_INTRINSICS))
    slide[:, :2] = -np.linalg.solve(by_point[..., :2], by_lens)
    J[..., _N_POSE : _N_POSE + N_INTRINSICS] = T[:3, :3] @ slide
    bias, raw = own.depth_bias, observed.raw_m
    if bias is not None:
        n = min(width - _N_POSE - N_INTRINSICS, len(bias.coefficients))
        powers = polynomial.polyvander(np.clip(raw, bias.min_m, bias.max_m), max(n, 1) - 1)[:, :n]
        ray = p / p[:, 2:]
        at = _N_POSE + N_INTRINSICS
        J[..., at : at + n] = (ray @ T[:3, :3].T)[..., None] * powers[:, None]
    return J


def _mean_length(S: FloatArray) -> FloatArray:
    """E|d| (n,) of d ~ N(0, S), S (n, 3, 3)."""
    eigenvalues = np.maximum(np.linalg.eigvalsh((S + S.transpose(0, 2, 1)) / 2), 0)
    length: FloatArray = _MEAN_LENGTH * elliprg(*eigenvalues.T)
    return length


def _keep(o: Observed, which: np.ndarray) -> Observed:
    return Observed(o.pixels_px[which], o.raw_m[which], o.z_m[which], o.seen[which])


def _range(part: slice) -> np.ndarray:
    return np.arange(part.start, part.stop)


def _width(part: slice) -> int:
    return int(part.stop - part.start)
