"""The floor in a cloud: among its large planes, one that lies below every camera, level with their image rows, and with
nothing beneath it (a table has the floor beneath it, a wall stands on end).

Cameras are held upright as a rule, so that their x axes are roughly parallel to the floor. Planes are found one after
the other, the largest first, by RANSAC. A carpet is floor too: with one the plane lies somewhere between the two heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import plane, se3
from rgbd_calib.geometry.so3 import FloatArray


@dataclass(frozen=True)
class FloorParams:
    max_points: int = 6000
    """The cloud is thinned to this many."""
    planes: int = 8
    threshold_per_m: float = 0.006
    """A point belongs to a plane where it is nearer than this times the square of its distance from its camera (6 mm at
    1 m, 54 mm at 3 m), and than `max_threshold_m`: three sigma of a structured-light sensor, and some of its bias."""
    max_distance_m: float = 5.0
    """Points farther from their camera are left out: depth there says little."""
    max_threshold_m: float = 0.06
    min_share: float = 0.03
    """Of all points, on the floor."""
    max_roll_rad: float = np.radians(25.0)
    """Of the cameras, against the floor."""
    max_beneath_share: float = 0.03
    """Of all points, beneath the floor by more than twice the threshold: reflections, stairs."""


@dataclass(frozen=True)
class Floor:
    """The plane normal . p = offset_m in the cloud's frame, its normal up."""

    normal: FloatArray
    offset_m: float
    points: int
    """On it, of those that were looked at."""
    rms_m: float
    """Of their distances from it."""


def find_floor(
    points_m: FloatArray,
    eyes_m: FloatArray,
    T_world_color: Sequence[FloatArray],
    rng: np.random.Generator,
    params: FloorParams | None = None,
) -> Floor:
    """The floor in points (n, 3), metres, each seen from `eyes_m` (n, 3); cameras' poses (4, 4).

    Raises
    ------
    CalibrationError
        No plane qualifies.
    """
    params = params or FloorParams()
    near = np.linalg.norm(points_m - eyes_m, axis=1) < params.max_distance_m
    points_m, eyes_m = points_m[near], eyes_m[near]
    if len(points_m) > params.max_points:
        some = rng.choice(len(points_m), params.max_points, replace=False)
        points_m, eyes_m = points_m[some], eyes_m[some]
    distance = np.maximum(np.linalg.norm(points_m - eyes_m, axis=1), 0.5)
    threshold = np.minimum(params.threshold_per_m * distance**2, params.max_threshold_m)
    centres = np.stack([T[:3, 3] for T in T_world_color])
    rows = np.stack([T[:3, 0] for T in T_world_color])
    left, candidates = np.ones(len(points_m), bool), []
    for _ in range(params.planes):
        if left.sum() < max(params.min_share * len(points_m), 50):
            break
        normal, d, inliers = plane.ransac(points_m[left], threshold[left], rng)
        index = np.flatnonzero(left)[inliers]
        left[index] = False
        if np.median(centres @ normal) < d:
            normal, d = -normal, -d
        height = points_m @ normal - d
        level = np.abs(rows @ normal).max() < np.sin(params.max_roll_rad)
        above = bool(np.all(centres @ normal > d + 0.2))
        beneath = float(np.mean(height < -2 * threshold))
        if level and above and beneath < params.max_beneath_share and len(index) > params.min_share * len(points_m):
            candidates.append(Floor(normal, float(d), len(index), float(np.sqrt(np.mean(height[index] ** 2)))))
    if not candidates:
        raise CalibrationError(
            f"no floor in the fused cloud: of its largest planes none lies below all cameras, within "
            f"{np.degrees(params.max_roll_rad):.0f}° of level with them, with nothing beneath it and with "
            f"{100 * params.min_share:.0f} % of the points. Film a frame that shows more of the floor, or lay the board on "
            "it and use --world board:FRAME"
        )
    return max(candidates, key=lambda floor: floor.points)


def world_on_floor(floor: Floor, T_world_color: FloatArray) -> FloatArray:
    """T_new_world (4, 4): z up, the origin on the floor below the camera, x where the camera looks, seen from above.

    A camera that looks straight down has no such direction: x is then where the top of its image points.
    """
    up, centre = floor.normal, T_world_color[:3, 3]
    forward = T_world_color[:3, 2] - (T_world_color[:3, 2] @ up) * up
    if np.linalg.norm(forward) < 0.17:  # within 10 degrees of the vertical
        forward = -T_world_color[:3, 1] + (T_world_color[:3, 1] @ up) * up
    x = forward / np.linalg.norm(forward)
    R_world_new = np.stack([x, np.cross(up, x), up], axis=1)
    origin = centre - (centre @ up - floor.offset_m) * up
    return se3.inverse(se3.make(R_world_new, origin))
