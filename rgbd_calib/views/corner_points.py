"""Where a view's depth puts the board's corners."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_sensor import DepthSensor
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import BoardView

LEAST_COS = 0.05
"""Between a ray and the board's normal: edge on, the ray meets the board nowhere in particular."""


def corner_points(view: BoardView, T_color_board: FloatArray, lens: Intrinsics, sensor: DepthSensor) -> FloatArray:
    """Corners (n, 3), metres, in the colour camera's frame; NaN without depth.

    A depth pixel beside its colour image shows another place of the board than the corner whose pixel it has. It is a point of
    the board's plane, and the corner is where the colour camera's ray meets that plane, its direction taken from the pose.
    """
    measured = sensor.points(view.corners_px, view.depth_m)
    rays, normal = lens.rays(view.corners_px), T_color_board[:3, 2]
    along = rays @ normal
    z_m = np.where(np.abs(along) > LEAST_COS, measured @ normal / along, np.nan)
    return np.asarray(rays * z_m[:, None])
