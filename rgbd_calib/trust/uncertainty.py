"""How far apart two cameras of a rig put the same point, as predicted by its joint covariance.

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

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import elliprg

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import JointErrors
from rgbd_calib.types import Rig

NEAREST_M, FARTHEST_M = 0.3, 4.0
"""Depths at which a camera of this kind measures."""

OF_PLACES = ("pose", "intrinsics", "depth bias", "depth ripple", "depth tilt", "depth field")
"""Blocks that :func:`place_derivatives` knows."""
MOST_KEPT = 1500
"""Parameters of a joint covariance in a rig file: of 20 cameras, 3 MB."""

_MEAN_LENGTH = 2 * np.sqrt(2 / np.pi)  # of a Gaussian with three unit variances


@dataclass(frozen=True)
class Observed:
    """What one camera of a rig would report of points (n, 3)."""

    pixels_px: FloatArray
    """(n, 2), of the colour image."""
    depth_pixels_px: FloatArray
    """(n, 2), of the depth image."""
    raw_m: FloatArray
    """(n,), the depth that the sensor would report without noise, its error included."""
    z_m: FloatArray
    """(n,), along the colour camera's axis."""
    seen: np.ndarray
    """(n,) bool: inside both images, at a depth that is measured."""

    def only(self, which: np.ndarray) -> Observed:
        """Some of the points."""
        return Observed(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True)
class JointCovariance:
    """Covariance of all cameras together, and where each camera's parameters stand in it."""

    matrix: FloatArray
    """(P, P)."""
    parameters: Mapping[str, Mapping[str, IntArray]]
    """By camera and block; what is not there is taken as exact."""

    def moved(self, T_new_world: FloatArray) -> JointCovariance:
        """In another world: the pose of a camera is a left perturbation (rad, m) in it."""
        A, Ad = np.eye(len(self.matrix)), se3.adjoint(T_new_world)
        for own in self.parameters.values():
            A[np.ix_(own["pose"], own["pose"])] = Ad
        return replace(self, matrix=A @ self.matrix @ A.T)

    def loosened(self, reference: str, sd_m: float, distance_m: float) -> JointCovariance:
        """With cameras that moved since, but the reference: points at this distance by so much (RMS), half of it by turning."""
        sd = np.repeat([sd_m / (2 * distance_m), sd_m / np.sqrt(6)], 3)  # two of three turns move a point
        C = self.matrix.copy()
        for name, own in self.parameters.items():
            if name != reference:
                C[own["pose"], own["pose"]] += sd**2
        return replace(self, matrix=C)

    @classmethod
    def of_parts(cls, rig: Rig) -> JointCovariance:
        """Of a rig that states no more than the covariance of each part, as if these were independent."""
        parts: list[FloatArray] = []
        parameters: dict[str, dict[str, IntArray]] = {}
        for name, own in rig.cameras.items():
            blocks = {"pose": own.covariance}
            if own.statistics.intrinsics_sd is not None:
                blocks["intrinsics"] = np.diag(np.array(own.statistics.intrinsics_sd) ** 2)
            if own.depth_bias is not None and own.depth_bias.covariance is not None:
                n = len(own.depth_bias.coefficients)
                blocks["depth bias"] = own.depth_bias.covariance[:n, :n]
                blocks["depth ripple"] = own.depth_bias.covariance[n:, n:]
            if isinstance(own.depth_field, PolynomialField) and own.depth_field.covariance is not None:
                blocks["depth field"] = own.depth_field.covariance
            start = sum(len(part) for part in parts)
            ends = start + np.cumsum([len(block) for block in blocks.values()])
            at = [np.arange(end - len(block), end) for end, block in zip(ends, blocks.values(), strict=True)]
            parameters[name] = dict(zip(blocks, at, strict=True))
            parts += blocks.values()
        return cls(block_diag(*parts), parameters)

    def kept(self) -> JointErrors | None:
        """For a rig file, what places depend on; None where that is more than `MOST_KEPT` parameters."""
        blocks = {name: {b: at for b, at in own.items() if b in OF_PLACES} for name, own in self.parameters.items()}
        order = np.concatenate([at for own in blocks.values() for at in own.values()])
        if len(order) > MOST_KEPT:
            return None
        C = self.matrix[np.ix_(order, order)]
        sd = np.sqrt(np.maximum(np.diag(C), 0.0))
        free = np.flatnonzero(sd > 0)
        values, vectors = np.linalg.eigh(C[np.ix_(free, free)] / np.outer(sd[free], sd[free]))
        root = vectors * np.sqrt(np.maximum(values, 0.0))  # which may be singular, as no Cholesky factor can be
        R = np.asarray(np.linalg.qr(root.T)[1]).T
        rows, columns = np.tril_indices(len(free))
        text = base64.b64encode(R[rows, columns].astype("<f2").tobytes()).decode("ascii")
        sizes = {name: {b: len(at) for b, at in own.items()} for name, own in blocks.items()}
        return JointErrors(sizes, tuple(sd.tolist()), text)

    @classmethod
    def of_kept(cls, kept: JointErrors) -> JointCovariance:
        """As a rig file has it.

        Raises
        ------
        ValueError
            The parts do not belong together.
        """
        sd = np.array(kept.sd)
        free = np.flatnonzero(sd > 0)
        halves = np.frombuffer(base64.b64decode(kept.factor, validate=True), "<f2").astype(float)
        parameters: dict[str, dict[str, IntArray]] = {}
        start = 0
        for name, sizes in kept.sizes.items():
            parameters[name] = {}
            for block, size in sizes.items():
                parameters[name][block] = np.arange(start, start + size)
                start += size
        if start != len(sd) or len(halves) != len(free) * (len(free) + 1) // 2 or not np.isfinite(halves).all():
            raise ValueError(f"{len(sd)} standard deviations and {len(halves)} numbers for {start} parameters")
        if any(sizes.get("pose") != 6 or min(sizes.values()) < 0 for sizes in kept.sizes.values()):
            raise ValueError("a pose of 6 parameters expected of each camera")
        R = np.zeros((len(free),) * 2)
        R[np.tril_indices(len(free))] = halves
        R /= np.maximum(np.linalg.norm(R, axis=1, keepdims=True), 1e-9)
        C = np.zeros((len(sd),) * 2)
        C[np.ix_(free, free)] = (R @ R.T) * np.outer(sd[free], sd[free])
        return cls(C, parameters)


def joint_of(rig: Rig) -> JointCovariance | None:
    """What a rig file states of all cameras together, those of unregistered depth by themselves; None where it states nothing.

    Raises
    ------
    CalibrationError
        It is damaged.
    """
    expected = rig.quality.expected_alignment
    if expected is None or expected.joint is None:
        return None
    try:
        return JointCovariance.of_kept(expected.joint)
    except ValueError as error:
        raise CalibrationError(f"quality.expected_alignment.joint is damaged: {error}. Calibrate again") from None


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected distance between the places where two cameras put the same point."""

    seen: BoolArray
    """Which of the points that were asked for two cameras see: n of them."""
    points_m: FloatArray
    """(n, 3), in the world: these."""
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


def observe(rig: Rig, name: str, points_m: FloatArray, farthest_m: float = FARTHEST_M) -> Observed:
    """What a camera reports of points (n, 3), metres, in the world, up to a depth."""
    own = rig.cameras[name]
    sensor = own.depth_sensor
    p = se3.transform(se3.inverse(own.T_world_color), points_m)
    p_depth = se3.transform(se3.inverse(sensor.camera.T_color_depth), p)
    z = p_depth[:, 2]
    seen = (z > NEAREST_M) & (z < farthest_m)
    with np.errstate(all="ignore"):
        pixels = own.intrinsics.project(p)
        depth_pixels, raw = sensor.report(p)
        for lens, at, point in (
            (own.intrinsics, pixels, p),
            (sensor.camera.intrinsics, depth_pixels, p_depth),
        ):
            seen &= np.all((at >= 0) & (at <= lens.size_px - 1), axis=1)
            seen &= np.linalg.norm(lens.unproject(at, point[:, 2]) - point, axis=1) < 1e-6
    return Observed(pixels, depth_pixels, raw, p[:, 2], seen)


def place(rig: Rig, name: str, seen: Observed) -> FloatArray:
    """Where a camera puts points (n, 3), metres, in the world: each by its pixel of the colour image, and by its depth."""
    own = rig.cameras[name]
    z_m = own.depth_sensor.points(seen.depth_pixels_px, seen.raw_m)[:, 2]
    return se3.transform(own.T_world_color, own.intrinsics.unproject(seen.pixels_px, z_m))


def expected_alignment(
    rig: Rig, joint: JointCovariance, points_m: FloatArray, cameras: Sequence[str]
) -> ExpectedErrors | None:
    """Expected alignment error at points (n, 3), metres, in the world, of `cameras`, those with depth.

    Returns
    -------
    None where no point is seen by two of the cameras.
    """
    names = [name for name in rig.cameras if name in cameras]
    observed = {name: observe(rig, name, points_m) for name in names}
    often = np.sum([o.seen for o in observed.values()], axis=0) > 1 if len(names) > 1 else np.zeros(len(points_m), bool)
    if not often.any():
        return None
    kept = {name: o.only(often) for name, o in observed.items()}
    patterns = {name: pattern_covariance(rig, name, o) for name, o in kept.items()}
    held = {name: by_held_depth(rig, name, o) for name, o in kept.items()}
    parts = {name: by_parameters(rig, name, o, joint) for name, o in kept.items()}
    pairs = {}
    for a, b in combinations(names, 2):
        both = kept[a].seen & kept[b].seen
        if both.any():
            at = np.concatenate([parts[a][0], parts[b][0]])
            J = np.concatenate([parts[a][1][both], -parts[b][1][both]], axis=-1)
            pairs[a, b] = np.full(len(both), np.nan)
            S = J @ joint.matrix[np.ix_(at, at)] @ J.transpose(0, 2, 1)
            beyond = sum(held[c][both, :, None] * held[c][both, None, :] for c in (a, b))
            pairs[a, b][both] = _mean_length(S + patterns[a][both] + patterns[b][both] + beyond)
    return ExpectedErrors(often, points_m[often], pairs)


def by_parameters(rig: Rig, name: str, observed: Observed, joint: JointCovariance) -> tuple[IntArray, FloatArray]:
    """Where the camera's uncertain parameters stand in the covariance, (k,), and derivatives of its places by them (n, 3, k)."""
    own, derivatives = joint.parameters[name], place_derivatives(rig, name, observed)
    used = {name: index[: derivatives[name].shape[-1]] for name, index in own.items() if name in derivatives}
    J = [derivatives[name][..., : len(index)] for name, index in used.items()]
    return np.concatenate(list(used.values())), np.concatenate(J, axis=-1)


def place_derivatives(rig: Rig, name: str, observed: Observed) -> dict[str, FloatArray]:
    """Derivatives (n, 3, k) of :func:`place` by each block of the camera's parameters, pixel and reported depth held.

    By the pose: Exp(xi) P - P = phi x P + rho. By the intrinsics: the point slides in its plane of depth z such that
    its pixel stays, d(x, y) = -(dpsi/d(x, y))^-1 dpsi/dK. By the depth's bias and field: along the ray.
    """
    own = rig.cameras[name]
    T = own.T_world_color
    p = own.intrinsics.unproject(observed.pixels_px, observed.z_m)
    P = se3.transform(T, p)
    out = {"pose": se3.by_motion(P)}
    ok = np.isfinite(p).all(axis=1) & (p[:, 2] > 0)
    _, by_point, by_lens = camera.project_jacobian(
        own.intrinsics.vector, np.where(ok[:, None], p, [0.0, 0.0, 1.0]), own.intrinsics.model
    )
    slide = np.zeros((len(p), 3, by_lens.shape[-1]))
    slide[:, :2] = -np.linalg.solve(by_point[..., :2], by_lens)
    out["intrinsics"] = T[:3, :3] @ slide
    ray = (p / p[:, 2:]) @ T[:3, :3].T  # in the world: z moves the point along it
    if (bias := own.depth_bias) is not None:
        stretch = np.linalg.norm(own.depth_sensor.camera.intrinsics.rays(observed.depth_pixels_px), axis=1)
        shapes = ray[..., None] * bias.by_parameters(observed.raw_m, stretch)[:, None]
        out["depth bias"], out["depth ripple"] = np.split(shapes, [len(bias.coefficients)], axis=-1)
    out["depth tilt"] = ray[..., None] * p[:, None, :2]
    if isinstance(own.depth_field, PolynomialField):
        shapes = own.depth_field.by_parameters(observed.depth_pixels_px, observed.raw_m)
        out["depth field"] = ray[..., None] * shapes[:, None]
    return out


def pattern_covariance(rig: Rig, name: str, observed: Observed) -> FloatArray:
    """(n, 3, 3), m^2, of a camera's places, from the fine pattern of its depth, which is no parameter of the rig."""
    field = rig.cameras[name].depth_field
    if not isinstance(field, PolynomialField):
        return np.zeros((len(observed.z_m), 3, 3))
    ray = rays_of(rig, name, observed)
    return np.asarray(field.pattern_variance_m2(observed.raw_m)[:, None, None] * ray[..., :, None] * ray[..., None, :])


def by_held_depth(rig: Rig, name: str, observed: Observed) -> FloatArray:
    """(n, 3), metres: one sigma of a camera's places, along the rays, where the depth bias is held outside its fitted range."""
    bias = rig.cameras[name].depth_bias
    if bias is None:
        return np.zeros((len(observed.z_m), 3))
    return bias.held_sd_m(observed.raw_m)[:, None] * rays_of(rig, name, observed)


def rays_of(rig: Rig, name: str, observed: Observed) -> FloatArray:
    """(n, 3), in the world, by which places move for each metre of depth."""
    own = rig.cameras[name]
    return own.intrinsics.rays(observed.pixels_px) @ own.T_world_color[:3, :3].T


def _mean_length(S: FloatArray) -> FloatArray:
    """E|d| (n,) of d ~ N(0, S), S (n, 3, 3)."""
    eigenvalues = np.maximum(np.linalg.eigvalsh((S + S.transpose(0, 2, 1)) / 2), 0)
    length: FloatArray = _MEAN_LENGTH * elliprg(*eigenvalues.T)
    return length
