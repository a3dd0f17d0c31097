"""Views of boards become correspondences: the same corner in the same frame is the same point for every camera.

A corner seen from the back lies `thickness` behind the front's. Its pixel and its 3D point are carried through the
board, by the board's pose in that view: a shift of at most a pixel or so, known to a hundredth of itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, Correspondences, IntArray, PlacedView, RigCamera
from rgbd_calib.views.corner_points import corner_points


def correspond(
    views: Sequence[PlacedView],
    board: Board,
    cameras: Mapping[str, RigCamera],
) -> Correspondences:
    """Correspondences of all corners that two cameras or more see; frames seen by one camera alone are left out.

    `board` and `cameras` say what is known of print, lenses and depth; the cameras' poses play no part.
    """
    names = tuple(cameras)
    per_frame: dict[str, int] = {}
    views = [placed for placed in views if not placed.view.predicted]
    for placed in views:
        per_frame[placed.view.frame] = per_frame.get(placed.view.frame, 0) + 1
    shared = [placed for placed in views if per_frame[placed.view.frame] >= 2]
    labels: dict[tuple[str, str], int] = {}
    columns: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for placed in shared:
        name = placed.view.camera
        pixels_px, points_m = _on_front(placed, board, cameras[name])
        numbers = [
            labels.setdefault((placed.view.frame, str(k)), len(labels)) for k in placed.front_corner(board).tolist()
        ]
        columns.append((np.full(len(numbers), names.index(name)), np.array(numbers), pixels_px, points_m))
    if not columns:
        none, nowhere = np.empty(0, int), np.empty((0, 3))
        return Correspondences(names, (), none, none, nowhere[:, :2], none, none, nowhere)
    camera_of, point_of, pixels, points = (np.concatenate([column[k] for column in columns]) for k in range(4))
    seen_twice = np.bincount(point_of, minlength=len(labels))[point_of] >= 2  # parts of a ChArUco board differ
    has_depth = np.isfinite(points[:, 2]) & seen_twice
    return Correspondences(
        names,
        tuple(labels),
        camera_of[seen_twice],
        point_of[seen_twice],
        pixels[seen_twice],
        camera_of[has_depth],
        point_of[has_depth],
        points[has_depth],
    )


def _on_front(placed: PlacedView, board: Board, camera: RigCamera) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) and measured points (n, 3), metres, NaN without depth, as if the front had been seen."""
    view, lens = placed.view, camera.intrinsics
    points_m = corner_points(view, placed.T_color_board, lens, camera.depth_sensor)
    if not placed.back:
        return view.corners_px, points_m
    on_front = board.corners_m()[placed.front_corner(board)]
    p_back, p_front = (se3.transform(placed.T_color_board, p) for p in (placed.points_m(board), on_front))
    return view.corners_px + lens.project(p_front) - lens.project(p_back), points_m + p_front - p_back
