"""Where the latent points start: triangulated from the pixels, or the mean of the measured points."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.groups import Grouping
from rgbd_calib.rig.biobjective.kernels import Cholesky3, camera_points, point_blocks
from rgbd_calib.types import IntArray


def rays(pixels_px: FloatArray, cameras: IntArray, intrinsics: tuple[Intrinsics, ...]) -> FloatArray:
    """Normalised coordinates (n, 2) of the pixels (n, 2) of their cameras (n,); NaN beyond what the lens can be."""
    out = np.empty_like(pixels_px)
    for i, model in enumerate(intrinsics):
        own = cameras == i
        if any(model.distortion):
            out[own] = model.rays(pixels_px[own])[:, :2]
        else:
            out[own] = (pixels_px[own] - [model.cx, model.cy]) / [model.fx, model.fy]
    return out


def triangulate(grouping: Grouping, rays_xy: FloatArray, T: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Points (3, h), metres in the world, and whether (h,) each lies in front of all its cameras.

    Linear in x: (R_0 - u R_2)^T (x - t) = 0 and the same for v, over the depth that the first pass gives. A point that
    this puts behind a camera starts on its first camera's ray instead, at the median depth of the others.
    """
    X = np.empty((3, len(grouping.labels)))
    good = np.empty(len(grouping.labels), bool)
    ray_start = np.empty_like(X)
    for block in grouping.blocks:
        m = block.gather(rays_xy)
        R, t = T[block.cameras, :3, :3], T[block.cameras, :3, 3]
        scale = np.ones((len(m), m.shape[2])) if block.seen is None else block.seen.astype(float)
        for _ in range(2):
            A = (R[:, :, :2, None] - R[:, :, 2, None, None] * m[:, None]) * scale[:, None, None]
            b = np.einsum("kcrn,kc->krn", A, t)
            V, right = point_blocks(A, b)
            with np.errstate(invalid="ignore", divide="ignore"):
                L = Cholesky3.of(V)
                L.forward(right, right)
                x = L.backward(right)
            z = camera_points(R, t, x)[:, 2]
            front = z > 0 if block.seen is None else (z > 0) | ~block.seen
            scale = np.where(front & (scale > 0), 1.0 / np.where(front, z, 1.0), scale)
        X[:, block.points], good[block.points] = x, front.all(axis=0)
        first = 0 if block.seen is None else np.argmax(block.seen, axis=0)
        columns = np.arange(m.shape[2])
        direction = np.stack([*m[first, :, columns].T, np.ones(m.shape[2])])
        rotation, origin = np.broadcast_to(R[first], (len(columns), 3, 3)), np.broadcast_to(t[first], (len(columns), 3))
        depth = np.median(np.abs(z)) if not good[block.points].any() else np.median(z[:, good[block.points]])
        ray_start[:, block.points] = np.einsum("nij,jn->in", rotation, direction) * depth + origin.T
    X[:, ~good] = ray_start[:, ~good]
    for block in grouping.blocks:
        z = camera_points(T[block.cameras, :3, :3], T[block.cameras, :3, 3], X[:, block.points])[:, 2]
        good[block.points] = np.all(z > 0 if block.seen is None else (z > 0) | ~block.seen, axis=0)
    return X, good


def mean_points(grouping: Grouping, xyz_m: FloatArray, T: FloatArray) -> FloatArray:
    """Means (3, h), metres in the world, of the measured points (n, 3) of each point's cameras."""
    X = np.empty((3, len(grouping.labels)))
    for block in grouping.blocks:
        p = block.gather(xyz_m)
        y = T[block.cameras, :3, :3] @ p + T[block.cameras, :3, 3, None]
        seen = np.ones(y.shape[::2]) if block.seen is None else block.seen
        X[:, block.points] = np.einsum("kcn,kn->cn", y, seen) / seen.sum(axis=0)
    return X
