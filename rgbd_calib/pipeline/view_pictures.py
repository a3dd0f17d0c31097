"""The views that the report shows: chosen by their residuals, read from the recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline.rig_inputs import check_depth_geometry, common_cameras
from rgbd_calib.report.numbers import Sensor
from rgbd_calib.report.view_pictures import ViewPicture, board_pose, choose, depth_cells, part_of, rows_of
from rgbd_calib.types import Rig


def view_pictures(
    recording: Recording, rig: Rig, boards: Mapping[str, FloatArray], left: Residuals
) -> tuple[ViewPicture, ...]:
    """The worst and the best view of each camera, and the worst of those left out, as far as the recording has them.

    Raises
    ------
    ConfigError
        An image cannot be read, or the recording is of another rig.
    """
    board, out = rig.quality.board, []
    for name in common_cameras(recording, rig):
        own = rig.cameras[name]
        sensor = Sensor(name, name, own.intrinsics, own.T_world_color)
        for chosen in choose(left, name):
            frame = chosen.view.frame
            if frame not in recording.color_files[name]:
                continue
            rows = rows_of(left, chosen)
            part = part_of(rows.pixels_px, own.intrinsics)
            u, v, right, bottom = part
            image = np.ascontiguousarray(recording.color(name, frame)[v:bottom, u:right, ::-1])
            T_color_board, depth = board_pose(sensor, boards, frame), None
            if T_color_board is not None and board is not None and recording.has_depth(name, frame):
                check_depth_geometry(recording, name, own)
                points_m = own.depth_image.points(recording.depth_own_m(name, frame))
                depth = depth_cells(points_m, T_color_board, board, own.intrinsics, part)
            out.append(ViewPicture(chosen, rows, image, (u, v), depth))
    return tuple(out)
