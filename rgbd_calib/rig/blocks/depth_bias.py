"""The depth's error along the range: z_true = z + c0 + c1 z + c2 z^2 + ..., z held to a range somewhat beyond the data's.

An error of a triangulating sensor's disparity d that is a polynomial of the second degree in d ~ 1 / z is exactly c0 + c1 z +
c2 z^2; so the curve goes on where no board was, with the covariance that it has there. What bends it once more is small.
Time of flight errs in the distance along the pixel's ray, s z: z_true = z + (c0 + c1 (s z) + ...) / s, and within the data alone.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial, legendre, polynomial

from rgbd_calib.geometry.linear import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Fault
from rgbd_calib.rig.blocks.depth_error import LinearDepthErrorBlock
from rgbd_calib.rig.setup import N_WEAK_BIAS, BundleParams
from rgbd_calib.types import DepthBias

N_QUADRATIC = 3
"""Coefficients of a triangulating sensor that a recording should determine; the size of further ones is known from what makes
them."""
BEYOND = 1.3
"""Times the range of the data, on either end, up to which the curve of a triangulating sensor goes on."""
BEND_SD_PER_M2 = 4e-5
"""Prior of c3, which is what a disparity's offset leaves in the second order, c2^2, and as much again: 2.6 mm at 4 m."""
FURTHER = 5.0
"""Prior of each coefficient after c3, over that of the one before: millimetres at 4 m."""


class DepthBiasBlock(LinearDepthErrorBlock):
    """c0, c1, ... of each camera, (C, the longest)."""

    name = "depth bias"
    over_time = Fault(
        "depth over time",
        lambda t: (
            f"{t.camera}'s depth offset changed by {1e3 * abs(t.estimate[0] + t.estimate[1] * t.distance_m):.1f} mm (at "
            f"{t.distance_m:.1f} m) at frame {t.frame}"
        ),
        "Let the sensor warm up for half an hour, and record again, the bias recording too",
        parameters=2,
    )
    between_recordings = Fault(
        "depth between recordings",
        lambda t: f"{t.camera}'s depth in the rig's recording differs from that of its intrinsic recording, by {t.mm}",
        "Check that both are of the same camera, mode and depth scale; let the sensor warm up before either",
        parameters=2,
    )
    known = Fault(
        "bias given",
        lambda t: f"{t.camera}'s depth on the board differs from its known depth bias, by {t.mm} RMS",
        "Check the distances of the bias recording (unit, from the lens to the wall, square to it) and that it is of "
        "this camera; without one, its depth scale, or the board's squares",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"depth bias c{k}" for k in range(max(self.n_own(c) for c in range(self.sets))))

    @cached_property
    def data_m(self) -> FloatArray:
        """(C, 2): the range of the data; the prior's where the bias is given."""
        obs, walls, ranges = self.setup.obs, self.setup.walls, []
        for i, prior in enumerate(self.setup.priors):
            z = obs.depth_m[(obs.camera == i)[:, None] & obs.has_depth]
            z = np.concatenate([z, walls.depth_m[(walls.camera == i)[:, None] & walls.seen]])
            if (given := prior.given_bias) is not None:
                ranges.append((given.min_m, given.max_m))
            else:
                ranges.append((float(z.min()), float(z.max())) if len(z) else (0.0, 1.0))
        return np.array(ranges)

    @cached_property
    def range_m(self) -> FloatArray:
        """(C, 2): where each bias is a polynomial."""
        out = []
        for i, (prior, (low, high)) in enumerate(zip(self.setup.priors, self.data_m, strict=True)):
            if prior.given_bias is not None:
                out.append((low, high))
            else:
                out.append((low, high * self._longest(i)) if self.along_ray(i) else (low / BEYOND, high * BEYOND))
        return np.array(out)

    def along_ray(self, camera: int) -> bool:
        """Does this camera err in the distance along its pixels' rays?"""
        prior = self.setup.priors[camera]
        return prior.time_of_flight if prior.given_bias is None else prior.given_bias.along_ray

    def stretch(self, camera: int, pixels_px: FloatArray) -> FloatArray:
        """(...), length of the pixels' rays (x, y, 1) by the lens at the start; 1 for cameras that err in z."""
        if not self.along_ray(camera):
            return np.ones(pixels_px.shape[:-1])
        rays = self.setup.priors[camera].intrinsics.rays(pixels_px)
        return np.asarray(np.linalg.norm(np.nan_to_num(rays, nan=1.0), axis=-1))

    def _longest(self, camera: int) -> float:
        """The longest ray on which the camera has depth."""
        obs, walls = self.setup.obs, self.setup.walls
        boards, cells = (obs.camera == camera)[:, None] & obs.has_depth, (walls.camera == camera)[:, None] & walls.seen
        at = np.concatenate([obs.pixels_px[boards], walls.pixels_px[cells]])
        return float(self.stretch(camera, at).max(initial=1.0))

    def start(self) -> FloatArray:
        out = np.zeros((self.sets, self.n))
        for row, prior in zip(out, self.setup.priors, strict=True):
            if prior.bias is not None:
                row[: len(prior.bias.coefficients)] = prior.bias.coefficients
        return out

    def prior(self) -> BlockPrior:
        obs, walls, n = self.setup.obs, self.setup.walls, self.n
        mean, information = np.zeros((self.sets, n)), np.zeros((self.size,) * 2)
        free = np.zeros((self.sets, n), bool)
        assumed = np.zeros((self.sets, n), bool)
        for i, prior in enumerate(self.setup.priors):
            n_own = self.n_own(i)
            seen = bool(np.any(obs.has_depth[obs.camera == i]) or np.any(walls.camera == i))
            free[i, :n_own] = seen and prior.held == "nothing"
            known = prior.given_bias
            to_find = n_own if prior.time_of_flight else min(n_own, N_QUADRATIC)
            assumed[i, :to_find] = known is None or known.covariance is None
            if known is not None:
                mean[i, :n_own] = known.coefficients
            at = slice(i * n, i * n + n_own)
            if prior.time_of_flight and (known is None or known.covariance is None):
                information[at, at] = _information_of_tof(self.range_m[i], n_own, self.setup.params)
            else:
                information[at, at] = _information(known, n_own, self.setup.params)
        return BlockPrior(mean.ravel(), information, free.ravel(), assumed.ravel())

    def n_own(self, camera: int) -> int:
        """Coefficients of one camera."""
        prior = self.setup.priors[camera]
        if prior.bias is None:
            return N_WEAK_BIAS
        given = len(prior.bias.coefficients)
        return max(given, N_WEAK_BIAS) if prior.bias_is_start else given

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        (low, high), s = self.range_m[camera], self.stretch(camera, pixels_px)
        powers = np.asarray(polynomial.polyvander(np.clip(depth_m * s, low, high), self.n - 1), float)
        slope = np.zeros_like(powers)
        slope[..., 1:] = powers[..., :-1] * np.arange(1, self.n)
        inside = (depth_m * s >= low) & (depth_m * s <= high)
        return powers / s[..., None], np.where(inside[..., None], slope, 0.0)


def _information(bias: DepthBias | None, n: int, params: BundleParams) -> FloatArray:
    if bias is not None and bias.covariance is not None:
        return symmetric_inverse(bias.covariance[:n, :n])
    offset, scale, curvature = params.bias_offset_sd_m, params.bias_scale_sd, params.bias_curvature_sd_per_m
    sd = [offset, scale, curvature, *(BEND_SD_PER_M2 / FURTHER**k for k in range(max(n - 3, 0)))]
    return np.diag(1 / np.square(sd[:n]))


def _information_of_tof(range_m: FloatArray, n: int, params: BundleParams) -> FloatArray:
    """Of c0, c1, ... (n, n): Legendre's polynomials over the range have deviations of their own, the offset in the middle, the
    scale, and the wiggle from the second degree on. Waves as long as the range have any slope at z = 0."""
    middle, half = range_m.mean(), np.diff(range_m)[0] / 2
    sd = np.array([params.tof_offset_sd_m, params.tof_scale_sd * half, *[params.tof_wiggle_sd_m] * (n - 2)])[:n]
    powers = [Polynomial([middle, half]) ** k for k in range(n)]  # z^k in t
    to_legendre = np.zeros((n, n))
    for k, power in enumerate(powers):
        to_legendre[: k + 1, k] = legendre.poly2leg(power.coef)
    return np.asarray(to_legendre.T @ np.diag(sd**-2.0) @ to_legendre)
