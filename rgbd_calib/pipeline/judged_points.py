"""How well a rig puts bare correspondences together: what `refine` is judged by, which has no boards."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.pipeline.details import expectation
from rgbd_calib.pipeline.evaluate import Evaluation, PairAlignment
from rgbd_calib.quality import Quality
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Correspondences, Rig


def with_alignment(quality: Quality, rig: Rig, data: Correspondences, joint: JointCovariance | None) -> Quality:
    """With measured and expected alignment, and the working distance, as far as the correspondences tell them."""
    points = _measured(rig, data)
    z_m = [own[:, 2] for own in points.values() if len(own)]
    if z_m:
        quality = replace(quality, working_distance_m=round(float(np.median(np.concatenate(z_m))), 3))
    pairs = [p for a, b in combinations(data.cameras, 2) if (p := _pair(rig, data, points, a, b)) is not None]
    if pairs:
        quality = replace(quality, alignment_on_recording=Evaluation(tuple(pairs), {}).summary())
    if joint is not None and z_m:
        world = [se3.transform(rig.cameras[c].T_world_color, own[:, :3]) for c, own in points.items() if len(own)]
        with_depth = [c for c, own in points.items() if len(own)]
        quality = replace(quality, expected_alignment=expectation(rig, joint, np.concatenate(world), with_depth))
    return quality


def _measured(rig: Rig, data: Correspondences) -> dict[str, FloatArray]:
    """Measured points (n, 4) by camera: x, y, z in the camera's frame, metres, and the number of the point."""
    return {
        name: np.column_stack([data.xyz_m[mine], data.xyz_point[mine]])
        for i, name in enumerate(data.cameras)
        if (mine := data.xyz_camera == i) is not None
    }


def _pair(rig: Rig, data: Correspondences, points: dict[str, FloatArray], a: str, b: str) -> PairAlignment | None:
    """Points that both cameras measured, and points that one measured and the other saw."""
    _, ia, ib = np.intersect1d(points[a][:, 3], points[b][:, 3], return_indices=True)
    in_world = [
        se3.transform(rig.cameras[name].T_world_color, points[name][rows, :3]) for name, rows in ((a, ia), (b, ib))
    ]
    distance_m = np.linalg.norm(in_world[0] - in_world[1], axis=1)
    depth_m = (points[a][ia, 2] + points[b][ib, 2]) / 2
    transfer = np.concatenate([_transfer(rig, data, points[s], s, t) for s, t in ((a, b), (b, a))])
    if not len(distance_m) and not len(transfer):
        return None
    return PairAlignment((a, b), distance_m, depth_m, *transfer.T)


def _transfer(rig: Rig, data: Correspondences, points: FloatArray, source: str, target: str) -> FloatArray:
    """Errors (n, 2) of points measured by `source` in the image of `target`: px, and metres across the line of sight."""
    mine = data.pixel_camera == data.cameras.index(target)
    _, i, j = np.intersect1d(points[:, 3], data.pixel_point[mine], return_indices=True)
    own = rig.cameras[target]
    p_world = se3.transform(rig.cameras[source].T_world_color, points[i, :3])
    p_color = se3.transform(se3.inverse(own.T_world_color), p_world)
    front = p_color[:, 2] > 0
    p_color = p_color[front]
    lens = own.intrinsics
    off_px = lens.project(p_color) - data.pixels_px[mine][j][front]
    off_m = off_px / [lens.fx, lens.fy] * p_color[:, 2:]
    return np.column_stack([np.linalg.norm(off_px, axis=1), np.linalg.norm(off_m, axis=1)])
