"""The unit of depth images, by a board of known size that is seen in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView, DepthCamera
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.depth_scale import WITHIN, unit_of_depth

WITHIN_NOMINAL = 1.5
"""By which factor the distance by pixels may be wrong, where the lens, or the place of the depth camera, is only guessed."""


@dataclass(frozen=True)
class DepthUnit:
    """What some views of the board say."""

    unit_m: float | None
    """Metres for each unit of depth; None: the views do not decide."""
    raw_per_m: float | None
    """Units for each metre by the pixels, in the median; None: no view has depth on the board."""
    views: int
    """That have depth on the board."""
    spread: tuple[float, float] = (1.0, 1.0)
    """A fifth of the views have fewer, a fifth more units for each metre: depth follows the board where they are alike."""


def find_depth_unit(
    views: Sequence[BoardView],
    raw: Sequence[FloatArray],
    board: Board,
    lens: Intrinsics,
    lens_known: bool,
    registered: bool = True,
    depth_camera: DepthCamera | None = None,
) -> DepthUnit:
    """Compare depth images with the board's distance by its pixels.

    Parameters
    ----------
    views
        Of one camera.
    raw
        Their depth images (h, w), as stored, NaN where there is none.
    lens_known
        The lens is calibrated, or estimated from views, not guessed.
    registered
        Depth has the colour camera's geometry; otherwise it is laid over the colour image, which is good to some ten per
        cent, unless its own geometry is known.
    depth_camera
        That geometry, where it is known.
    """
    ratios = []
    for view, image in zip(views, raw, strict=True):
        p_color = se3.transform(pose_view(view, board, lens, None).T_color_face, board.corners_m()[view.ids])
        if depth_camera is None:
            scale = np.array([image.shape[1] / lens.width, image.shape[0] / lens.height])
            pixels, z_m = (view.corners_px + 0.5) * scale - 0.5, p_color[:, 2]
        else:
            p_depth = se3.transform(se3.inverse(depth_camera.T_color_depth), p_color)
            pixels, z_m = depth_camera.intrinsics.project(p_depth), p_depth[:, 2]
        value = _at(image, pixels)
        seen = np.isfinite(value)
        if np.count_nonzero(seen) >= max(4, len(value) // 2):
            ratios.append(float(np.median(value[seen] / z_m[seen])))
    if not ratios:
        return DepthUnit(None, None, 0)
    raw_per_m = float(np.median(ratios))
    sure = lens_known and (registered or depth_camera is not None)
    unit_m = unit_of_depth(np.array([raw_per_m]), np.ones(1), WITHIN if sure else WITHIN_NOMINAL)
    return DepthUnit(unit_m, raw_per_m, len(ratios), (float(np.quantile(ratios, 0.2)), float(np.quantile(ratios, 0.8))))


def _at(image: FloatArray, pixels: FloatArray) -> FloatArray:
    """Values at the nearest pixels (n, 2), NaN outside."""
    u, v = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    out = np.full(len(pixels), np.nan)
    out[inside] = image[v[inside], u[inside]]
    return out
