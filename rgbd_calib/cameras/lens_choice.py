"""Which kind of lens a camera has, by views that were held out.

More coefficients always fit the views better that they were fitted to, and paper is never quite true: so the lens is fitted
to some of the views, and judged by the others, each posed by it. A kind that folds inside the image is no lens of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rgbd_calib.cameras.zhang import ZhangSolution, solve, view_rms_px
from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import LensChoice
from rgbd_calib.types import Board, BoardView

SIMPLEST_FIRST: tuple[LensKind, ...] = ("brown", "fisheye", "rational")
FOLDS = 4
LEAST_VIEWS = 3 * FOLDS
"""Fewer do not tell one kind from another."""
WORTH: dict[LensKind, float] = {"fisheye": 0.95, "rational": 0.9}
"""RMS over that of a simpler kind below which it is better by more than the errors of a print, which each kind takes up
differently; the rational lens has coefficients that nearly cancel each other."""
SURE = 2.0
"""Standard errors by which another kind must be better."""


def choose(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> tuple[LensChoice, ZhangSolution]:
    """The simplest kind of lens that no other is surely better than, and the lens of this kind that fits the views.

    Raises
    ------
    CalibrationError
        The views determine no lens.
    """
    brown = best(views, board, size, "brown")
    if len(views) < LEAST_VIEWS:
        return LensChoice("brown", {}), brown
    rational = _attempt(views, board, size, "rational")
    gain = np.median(rational.view_rms_px / brown.view_rms_px) if rational else 1.0
    if gain > max(WORTH.values()) and not brown.folds:
        return LensChoice("brown", {}), brown
    left: dict[LensKind, FloatArray] = {}
    chosen, solution = SIMPLEST_FIRST[0], brown
    whole = {"brown": brown, "fisheye": _attempt(views, board, size, "fisheye"), "rational": rational}
    for kind in SIMPLEST_FIRST:
        if (own := whole[kind]) is not None:
            left[kind] = np.full(len(views), np.inf) if own.folds else _held_out(views, board, size, kind)
            if kind != chosen and _better(left[kind], left[chosen], WORTH[kind]):
                chosen, solution = kind, own
    medians = {kind: float(np.median(own)) for kind, own in left.items()}
    return LensChoice(chosen, {kind: px if np.isfinite(px) else None for kind, px in medians.items()}), solution


def best(views: Sequence[BoardView], board: Board, size: tuple[int, int], kind: LensKind) -> ZhangSolution:
    """The lens of a kind; of Brown's, with k3 where that lowers Akaike's criterion, n log(SSE / n) + 2 k.

    Raises
    ------
    CalibrationError
        The views do not determine it.
    """
    if kind != "brown":
        return solve(views, board, size, kind)
    without, with_k3 = (solve(views, board, size, "brown", hold_k3=hold) for hold in (True, False))
    n = 2 * sum(len(view.ids) for view in views)
    return with_k3 if 2 * n * np.log(with_k3.rms_px / without.rms_px) + 2 < 0 else without


def _attempt(views: Sequence[BoardView], board: Board, size: tuple[int, int], kind: LensKind) -> ZhangSolution | None:
    try:
        return best(views, board, size, kind)
    except CalibrationError:
        return None


def _held_out(views: Sequence[BoardView], board: Board, size: tuple[int, int], kind: LensKind) -> FloatArray:
    """RMS of each view, px, by a lens fitted to others; inf where none could be."""
    out = np.full(len(views), np.inf)
    for k in range(FOLDS):
        fitted = _attempt([view for i, view in enumerate(views) if i % FOLDS != k], board, size, kind)
        if fitted is not None:
            for i in range(k, len(views), FOLDS):
                out[i] = _posed_rms_px(views[i], board, fitted.lens)
    return out


def _posed_rms_px(view: BoardView, board: Board, lens: Intrinsics) -> float:
    """RMS of a view, px, with the board where it fits best; inf where the lens cannot see it."""
    corners_m, rays = board.corners_m()[view.ids], lens.rays(view.corners_px)
    if not np.isfinite(rays).all():
        return float("inf")
    _, turn, shift = cv2.solvePnP(corners_m, np.ascontiguousarray(rays[:, :2]), np.eye(3), None)
    return view_rms_px(view, board, lens, turn, shift)


def _better(one: FloatArray, other: FloatArray, worth: float) -> bool:
    """True where one kind's views held out are surely better than the other's; logarithms, so that no bad view decides."""
    if not np.isfinite(one).all() or not np.isfinite(other).all():
        return bool(np.isfinite(one).sum() > np.isfinite(other).sum())
    gain = np.log(other / one)
    return bool(gain.mean() > max(SURE * gain.std(ddof=1) / np.sqrt(len(gain)), -np.log(worth)))
