"""Lens and board poses that put the corners of a board where they were seen: Zhang's method, as OpenCV refines it.

References
----------
Z. Zhang: A flexible new technique for camera calibration, IEEE PAMI 22(11), 2000.
J. Kannala, S. S. Brandt: A generic camera model and calibration method for conventional, wide-angle, and fish-eye lenses,
IEEE PAMI 28(8), 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, resection, se3, so3
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.lens_fit import image_grid
from rgbd_calib.geometry.linear import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView

_FLAGS: dict[LensKind, int] = {
    "brown": 0,
    "rational": cv2.CALIB_RATIONAL_MODEL,
    "fisheye": cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
}
_LENGTHS: dict[LensKind, int] = {"brown": 5, "rational": 8, "fisheye": 4}
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)


@dataclass(frozen=True)
class ZhangSolution:
    """A lens and how well it fits its views."""

    lens: Intrinsics
    standard_deviation: FloatArray
    """(4 + n,) of its parameters; 0 for those that were held."""
    rms_px: float
    """Of both coordinates together."""
    view_rms_px: FloatArray
    """(views,)."""

    @property
    def folds(self) -> bool:
        """True where the lens cannot be inverted everywhere in its image."""
        return not np.isfinite(self.lens.rays(image_grid(self.lens.width, self.lens.height))).all()


def solve(
    views: Sequence[BoardView],
    board: Board,
    size: tuple[int, int],
    kind: LensKind,
    *,
    hold_k3: bool = False,
    guess: Intrinsics | None = None,
    hold_focal: bool = False,
) -> ZhangSolution:
    """Fit a lens to views of a board, for images of `size` (width, height) px.

    Raises
    ------
    CalibrationError
        The views do not determine a lens of this kind.
    """
    corners_m = board.corners_m()
    flags = _FLAGS[kind] | (cv2.CALIB_FIX_K3 if hold_k3 else 0) | (cv2.CALIB_FIX_FOCAL_LENGTH if hold_focal else 0)
    K: FloatArray = np.eye(3)
    k: FloatArray = np.zeros(_LENGTHS[kind])
    if guess is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        K, k = guess.K, np.array(guess.distortion)
    threads_before = cv2.getNumThreads()
    # several threads add up the normal equations in the order in which they finish: other last digits each time
    cv2.setNumThreads(1)
    try:
        if kind == "fisheye":
            points = [corners_m[view.ids][None] for view in views]
            pixels = [view.corners_px.astype(float)[None] for view in views]
            found: Sequence[Any] = cv2.fisheye.calibrate(points, pixels, size, K, k, flags=flags, criteria=_STOP)
        else:
            points = [corners_m[view.ids].astype(np.float32) for view in views]
            pixels = [view.corners_px.astype(np.float32) for view in views]
            found = cv2.calibrateCameraExtended(points, pixels, size, K, k, flags=flags)
    except cv2.error as error:
        raise CalibrationError(
            f"{views[0].camera}: no {kind} lens fits the {len(views)} views ({error.err}). "
            "Film the board close, in all parts of the image, tilted up to 40 degrees both ways"
        ) from None
    finally:
        cv2.setNumThreads(threads_before)
    rms, K, k = float(found[0]), _floats(found[1]), _floats(found[2])[: _LENGTHS[kind]]
    start = Intrinsics(*size, 1, 1, 0, 0, (0.0,) * len(k), camera.model_of(kind))
    lens = start.with_vector(np.concatenate([K[[0, 4, 2, 5]], k]))
    if kind != "fisheye":
        return ZhangSolution(lens, _floats(found[5])[: len(lens.vector)], rms, _floats(found[7]))
    posed = zip(views, found[3], found[4], strict=True)
    by_view = np.array([view_rms_px(view, board, lens, turn, shift) for view, turn, shift in posed])
    n_corners, n_unknowns = sum(len(view.ids) for view in views), len(lens.vector) + 6 * len(views)
    variance = rms**2 * n_corners / (2 * n_corners - n_unknowns)
    total = np.sum([information(view, board, lens) for view in views], axis=0)
    return ZhangSolution(lens, np.sqrt(variance * np.diag(symmetric_inverse(total))), rms, by_view)


def view_rms_px(view: BoardView, board: Board, lens: Intrinsics, turn: object, shift: object) -> float:
    """RMS of a view, px, of both coordinates together, with the board where OpenCV's rotation vector and shift put it."""
    T_color_board = se3.make(so3.exp(_floats(turn)), _floats(shift))
    left = lens.project(se3.transform(T_color_board, board.corners_m()[view.ids])) - view.corners_px
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def _floats(values: object) -> FloatArray:
    return np.asarray(values, float).ravel()


def information(view: BoardView, board: Board, lens: Intrinsics) -> FloatArray:
    """What a view says of a lens (4 + n, 4 + n), whatever its pose, 1/px^2; nothing where it has no pose."""
    corners_m, n = board.corners_m()[view.ids], len(lens.vector)
    try:
        T_color_face = resection.homography_pose(corners_m[:, :2], lens.rays(view.corners_px))[0][0]
    except CalibrationError:
        return np.zeros((n, n))
    p = se3.transform(T_color_face, corners_m)
    _, by_point, by_lens = camera.project_jacobian(lens.vector, p, lens.model)
    J, B = by_lens.reshape(-1, n), (by_point @ se3.by_motion(p)).reshape(-1, 6)
    Q = np.linalg.qr(B)[0]
    left = J - Q @ (Q.T @ J)
    return np.asarray(left.T @ left, float)
