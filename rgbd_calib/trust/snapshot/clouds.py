"""Distance between the clouds of two cameras on surfaces that both see from the same side.

A patch of camera a is carried into camera b by the rig. It is compared with b's patch at that pixel where both are flat, their
normals agree, the surface faces both cameras, and b's lies within `GATE_M`: then no other surface is in between. The distance
is that along the mean normal, so that sliding along a surface does not count, as in point to plane.

The noise of depth makes any two clouds differ. It is independent from patch to patch, while errors of a calibration
are smooth: the mean product of the distances of two patches `LAG` steps apart is the mean square without the noise (the
autocovariance beyond the nugget of a variogram; N. Cressie, Statistics for Spatial Data, 1993).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot.surfaces import Surface

GATE_M = 0.05
_SAME_NORMAL_COS = float(np.cos(np.radians(25)))
_FACING_COS = 0.25
LAG = 2
"""Patches that share no pixel and no matching window."""


@dataclass(frozen=True)
class SharedPatches:
    """The grid of patches of camera a, and which of them camera b sees from the same side; all in a's colour frame."""

    grid: np.ndarray
    """(n, 2), int, pixels of a's depth image."""
    points_a_m: FloatArray
    """(n, 3), means of a's patches."""
    points_b_m: FloatArray
    """(n, 3), means of b's patches at the pixels where b sees a's."""
    normals: FloatArray
    """(n, 3), mean of both normals."""
    both: np.ndarray
    """(n,) bool."""
    wide: np.ndarray
    """(n,) bool: of these, flat in the next window of `SCALES` too, in both: no fold is near."""
    share: float
    """Share of a's patches that b sees too."""

    @property
    def distance_m(self) -> FloatArray:
        """(n,), signed, along the mean normal."""
        return np.asarray(np.einsum("ni,ni->n", self.normals, self.points_b_m - self.points_a_m))


def shared_patches(a: Surface, b: Surface, T_a_b: FloatArray) -> SharedPatches:
    """Patches that two cameras see; T_a_b is (4, 4), p_a = T_a_b @ p_b in the colour cameras' frames."""
    grid = a.grid()
    planes = a.patches(grid)
    pixels, inside = b.pixels_of(se3.transform(se3.inverse(T_a_b), planes.points_m))
    there = b.patches(pixels)
    points, normals = se3.transform(T_a_b, there.points_m), there.normals @ T_a_b[:3, :3].T
    mean = planes.normals + normals
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    distance = np.einsum("ni,ni->n", mean, points - planes.points_m)
    to_b = T_a_b[:3, 3] - planes.points_m
    facing = np.einsum("ni,ni->n", planes.normals, to_b) > _FACING_COS * np.linalg.norm(to_b, axis=1)
    same = np.einsum("ni,ni->n", planes.normals, normals) > _SAME_NORMAL_COS
    both = planes.good & inside & there.good & facing & same & (np.abs(distance) < GATE_M)
    wide = both & planes.wide & there.wide
    return SharedPatches(grid, planes.points_m, points, mean, both, wide, float(both.sum() / max(planes.good.sum(), 1)))


@dataclass(frozen=True)
class CloudGap:
    """Distances of the patches of one camera from another's surface."""

    distance_m: FloatArray
    """(n,), signed, along the mean normal."""
    products_m2: FloatArray
    """(m,) of distances `LAG` patches apart."""
    share: float
    """Share of the patches that the other camera sees too."""

    def joined(self, other: CloudGap) -> CloudGap:
        """Both together."""
        return CloudGap(
            np.concatenate([self.distance_m, other.distance_m]),
            np.concatenate([self.products_m2, other.products_m2]),
            (self.share + other.share) / 2,
        )

    @property
    def error_m(self) -> float:
        """RMS distance, the noise taken off; 0 where the noise explains all, NaN where too few patches stand side by side."""
        return float(np.sqrt(max(self.products_m2.mean(), 0.0))) if len(self.products_m2) >= 20 else float("nan")


def cloud_gap(a: Surface, b: Surface, T_a_b: FloatArray) -> CloudGap:
    """Distances of a's patches from b's surface; T_a_b is (4, 4), p_a = T_a_b @ p_b in the colour cameras' frames."""
    shared = shared_patches(a, b, T_a_b)
    distance = shared.distance_m
    columns = len(np.unique(shared.grid[:, 0]))
    image = np.where(shared.both, distance, np.nan).reshape(-1, columns)
    products = np.concatenate(
        [(image[LAG:] * image[:-LAG]).ravel(), (image[:, LAG:] * image[:, :-LAG]).ravel()]
    )  # fmt: skip
    return CloudGap(distance[shared.both], products[np.isfinite(products)], shared.share)
