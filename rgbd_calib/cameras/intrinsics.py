"""Intrinsics of one camera from views of a board: Zhang's method, as OpenCV refines it.

Views that do not fit are left out one by one, the worst first: a view goes while its RMS exceeds `max_view_ratio` times
the median RMS of all. The third radial coefficient is freed where Akaike's criterion asks for it.

The time grows with the cube of the number of views. Of more than `max_views` those are taken that tell most of the lens.

References
----------
Z. Zhang: A flexible new technique for camera calibration, IEEE PAMI 22(11), 2000. The paper, section 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, resection, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.selection import most_informative
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView

MAX_RELATIVE_SD = 0.05
"""Above this standard deviation of a focal length, as a share of it, the views do not determine it."""
PROFILE_SIGMAS = 5.0
"""The standard deviation is that of a linear model; where the views are square to the camera, the focal length runs away
with the distance and takes it along. So the pixels must also rule out, by this many sigmas, focal lengths that are off by
this many of the largest standard deviation allowed."""


@dataclass(frozen=True)
class IntrinsicsParams:
    min_views: int = 3
    """Zhang's method needs three; ten or more with strong tilts are good."""
    max_view_ratio: float = 3.0
    min_outlier_px: float = 0.5
    """A view with a smaller RMS than this is never left out."""
    max_views: int = 100
    """Of more, the most informative ones are used (D-optimal): some seconds, where a thousand would take an hour."""


@dataclass(frozen=True)
class IntrinsicsResult:
    """Intrinsics of one camera and what they rest on."""

    intrinsics: Intrinsics
    standard_deviation: FloatArray
    """(9,) of fx, fy, cx, cy (px), k1, k2, p1, p2, k3; 0 for k3 where it is held at 0."""
    rms_px: float
    view_rms_px: dict[str, float]
    """By frame, of the views that were used."""
    dropped: dict[str, str]
    """Why, by frame, of the views that were left out."""
    not_needed: tuple[str, ...] = ()
    """Frames of the views beyond `max_views`."""


def calibrate_intrinsics(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], params: IntrinsicsParams | None = None
) -> IntrinsicsResult:
    """Intrinsics of the camera whose `views` these are, for images of `size` (width, height) px.

    Raises
    ------
    CalibrationError
        Too few views, or views that do not determine the focal length.
    """
    params = params or IntrinsicsParams()
    name = views[0].camera if views else "camera"
    kept, dropped = most_telling(views, board, size, params.max_views), dict[str, str]()
    not_needed = tuple(v.frame for v in views if v.frame not in {k.frame for k in kept})
    while True:
        if len(kept) < params.min_views:
            raise CalibrationError(
                f"{name}: {len(kept)} usable view(s) of the board for the intrinsics, {params.min_views} needed. "
                "Film the board close, in all parts of the image, tilted up to 40 degrees both ways"
            )
        solution = _best_model(kept, board, size)
        rms = solution[3]
        worst = int(np.argmax(rms))
        limit_px = max(params.max_view_ratio * float(np.median(rms)), params.min_outlier_px)
        if rms[worst] <= limit_px:
            break
        dropped[kept[worst].frame] = f"RMS {rms[worst]:.2f} px, {limit_px:.2f} px allowed"
        del kept[worst]
    total, vector, sd, rms = solution
    if not np.all(sd[:2] < MAX_RELATIVE_SD * vector[:2]):
        raise CalibrationError(
            f"{name}: focal length {vector[0]:.0f} px known to {sd[0]:.0f} px only, from {len(kept)} views; "
            f"{100 * MAX_RELATIVE_SD:.0f} % needed. Film the board tilted up to 40 degrees, both ways, not only square to the camera"
        )
    if (chi2 := _chi2_of_wrong_focal(kept, board, size, solution)) < PROFILE_SIGMAS**2:
        raise CalibrationError(
            f"{name}: a focal length {100 * PROFILE_SIGMAS * MAX_RELATIVE_SD:.0f} % off fits the {len(kept)} views nearly as "
            f"well (chi^2 larger by {max(chi2, 0):.0f}); {PROFILE_SIGMAS**2:.0f} needed. "
            "Film the board tilted up to 40 degrees, both ways, not only square to the camera"
        )
    frames = [view.frame for view in kept]
    intrinsics = Intrinsics(size[0], size[1], 1, 1, 0, 0).with_vector(vector)
    return IntrinsicsResult(intrinsics, sd, total, dict(zip(frames, rms.tolist(), strict=True)), dropped, not_needed)


def most_telling(views: Sequence[BoardView], board: Board, size: tuple[int, int], n: int) -> list[BoardView]:
    """The `n` views that together tell most of the lens, in their order; all where there are no more."""
    if len(views) <= n:
        return list(views)
    spread = np.linspace(0, len(views) - 1, max(n // 2, 3)).astype(int)
    vector = _solve([views[i] for i in spread], board, size, cv2.CALIB_FIX_K3)[1]
    information = np.stack([_information(view, board, vector) for view in views])
    weak = np.array([0.1 * vector[0], 0.1 * vector[1], 0.1 * size[0], 0.1 * size[1], 0.5, 0.5, 0.05, 0.05, 0.5])
    return [views[i] for i in most_informative(np.diag(weak**-2.0), information.__getitem__, len(views), n)]


def _information(view: BoardView, board: Board, vector: FloatArray) -> FloatArray:
    """What a view says of the lens (9, 9), whatever its pose, 1/px^2; nothing where it has no pose."""
    corners_m = board.corners_m()[view.ids]
    try:
        T_color_face = resection.homography_pose(corners_m[:, :2], camera.rays(vector, view.corners_px))[0][0]
    except CalibrationError:
        return np.zeros((9, 9))
    p = se3.transform(T_color_face, corners_m)
    _, by_point, by_lens = camera.project_jacobian(vector, p)
    by_pose = by_point @ se3.by_motion(p)
    J, B = by_lens.reshape(-1, 9), by_pose.reshape(-1, 6)
    Q = np.linalg.qr(B)[0]
    left = J - Q @ (Q.T @ J)
    return np.asarray(left.T @ left, float)


_Solution = tuple[float, FloatArray, FloatArray, FloatArray]


def _best_model(views: list[BoardView], board: Board, size: tuple[int, int]) -> _Solution:
    """Without and with k3; k3 stays where it lowers Akaike's criterion, n log(SSE / n) + 2 k."""
    without, with_k3 = (_solve(views, board, size, flags) for flags in (cv2.CALIB_FIX_K3, 0))
    n = 2 * sum(len(view.ids) for view in views)
    return with_k3 if 2 * n * np.log(with_k3[0] / without[0]) + 2 < 0 else without


def _chi2_of_wrong_focal(views: list[BoardView], board: Board, size: tuple[int, int], solution: _Solution) -> float:
    """By how much chi^2 grows, in units of the residuals' own variance, where the focal lengths are held off."""
    n = 2 * sum(len(view.ids) for view in views)
    grown = []
    for factor in (1 - PROFILE_SIGMAS * MAX_RELATIVE_SD, 1 / (1 - PROFILE_SIGMAS * MAX_RELATIVE_SD)):
        guess = solution[1].copy()
        guess[:2] *= factor
        guess[4:] *= np.array([factor**2, factor**4, factor, factor, factor**6])  # the same lens in pixels
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH | (0 if guess[8] else cv2.CALIB_FIX_K3)
        grown.append(n * ((_solve(views, board, size, flags, guess)[0] / solution[0]) ** 2 - 1))
    return float(min(grown))


def _solve(
    views: list[BoardView], board: Board, size: tuple[int, int], flags: int, guess: FloatArray | None = None
) -> _Solution:
    corners_m = board.corners_m()
    object_points = [corners_m[view.ids].astype(np.float32) for view in views]
    image_points = [view.corners_px.astype(np.float32) for view in views]
    start = (None, None) if guess is None else (Intrinsics(*size, 1, 1, 0, 0).with_vector(guess).K, guess[4:].copy())
    threads_before = cv2.getNumThreads()
    cv2.setNumThreads(
        1
    )  # several add up the normal equations in the order in which they finish: other last digits each time
    try:
        rms, K, distortion, _, _, sd, _, per_view = cv2.calibrateCameraExtended(
            object_points, image_points, size, *start, flags=flags
        )  # type: ignore[call-overload]
    finally:
        cv2.setNumThreads(threads_before)
    k1, k2, p1, p2, k3 = distortion.ravel()[:5]
    sd = sd.ravel()
    vector = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, k3])
    return float(rms), vector, sd[:9], per_view.ravel()
