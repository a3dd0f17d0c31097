"""Numbers of one image and of the board in it: exposure, sharpness, and what the depth image shows on the board."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView

WHITE, BLACK = 252, 15
"""Grey levels at which a sensor tells nothing any more."""
OFF_PLANE_M = 0.03
"""At least this far from the board's plane is something else; at 2 m some 5 sigma of one pixel."""
_SAMPLES = 25


@dataclass(frozen=True)
class ImageMeasures:
    """Of a whole colour image."""

    white_share: float
    median_grey: float


@dataclass(frozen=True)
class ViewMeasures:
    """Of the board's area in one image."""

    white_share: float
    dark_level: float
    """Grey level of the dark squares."""
    contrast: float
    """Grey levels between the board's dark and bright squares."""
    edge_px: float
    """Width of the squares' edges across the blurrier of the board's two directions; NaN where it cannot be told."""
    texture: float
    """Mean square of the Laplacian over the grey levels' variance, times a square's side in px: falls with blur."""
    depth_share: float
    """Of the board's pixels, with a measurement; NaN without a depth image."""
    covered_share: float
    """Of the measured ones, nearer than the board's plane by more than its noise and `OFF_PLANE_M`."""


def measure_image(gray: np.ndarray) -> ImageMeasures:
    """Exposure of an image (h, w), uint8."""
    return ImageMeasures(float(np.mean(gray >= WHITE)), float(np.median(gray)))


def measure_view(gray: np.ndarray, depth_m: FloatArray | None, view: BoardView, board: Board) -> ViewMeasures:
    """Measures of the board in an image (h, w) uint8 and its depth (h, w), metres, NaN where there is none."""
    mask = hull_mask(gray.shape[:2], view.corners_px)
    inside = gray[mask]
    low, high = np.percentile(inside, [10, 90])
    texture = texture_of(gray, mask, square_px(view, board))
    share, covered = (np.nan, np.nan) if depth_m is None else _depth(depth_m, mask, view)
    edge = edge_width(gray, view, board)
    return ViewMeasures(float(np.mean(inside >= WHITE)), float(low), float(high - low), edge, texture, share, covered)


def hull_mask(shape: tuple[int, ...], corners_px: FloatArray) -> np.ndarray:
    """Pixels (h, w), bool, between the corners."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners_px).astype(np.int32)), 1)
    return mask.astype(bool)


def square_px(view: BoardView, board: Board) -> float:
    """Typical side of a square in the image."""
    H, _ = cv2.findHomography(board.corners_m()[view.ids][:, :2] / board.square_m, view.corners_px)
    middle = np.append(board.corners_m()[view.ids][:, :2].mean(axis=0) / board.square_m, 1.0)
    p = H @ middle
    J = (H[:2, :2] - np.outer(p[:2] / p[2], H[2, :2])) / p[2]
    return float(np.sqrt(abs(np.linalg.det(J))))


def texture_of(gray: np.ndarray, mask: np.ndarray, side_px: float) -> float:
    """Edges inside the mask, by their sharpness, not by their contrast nor by the board's size."""
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0).astype(np.float32)
    variance = float(np.var(smooth[mask])) if mask.any() else 0.0
    if variance < 4.0:
        return 0.0
    return float(np.mean(cv2.Laplacian(smooth, cv2.CV_32F)[mask] ** 2)) / variance * side_px


def edge_width(gray: np.ndarray, view: BoardView, board: Board) -> float:
    """Contrast over steepest slope of the squares' edges, px; the greater median of rows and columns."""
    if len(view.ids) != board.n_corners or board.type != "checkerboard":
        return float("nan")
    grid = view.corners_px[np.argsort(view.ids)].reshape(board.rows, board.cols, 2)
    widths = []
    for g in (grid, grid.transpose(1, 0, 2)):
        # an edge runs between neighbours of a row; its profile leads from the row before to the row after
        start, end = g[1:-1, :-1], g[1:-1, 1:]
        across = ((g[2:, :-1] + g[2:, 1:]) - (g[:-2, :-1] + g[:-2, 1:])) / 4
        if start.size:
            widths.append(_profile_width(gray, (start + end) / 2, across))
    return float(np.nanmax(widths)) if widths and np.isfinite(widths).any() else float("nan")


def _profile_width(gray: np.ndarray, middle: FloatArray, across: FloatArray) -> float:
    """Median over the edges whose middles (..., 2) and vectors to the next edge (..., 2) are given."""
    s = np.linspace(-0.45, 0.45, _SAMPLES)
    at = (middle[..., None, :] + s[:, None] * across[..., None, :]).reshape(-1, _SAMPLES, 2).astype(np.float32)
    profile = cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    step_px = np.linalg.norm(across.reshape(-1, 2), axis=1) * (s[1] - s[0])
    contrast = np.ptp(profile, axis=1)
    slope = np.abs(profile[:, 2:] - profile[:, :-2]).max(axis=1) / (2 * step_px)
    good = contrast > 10
    return float(np.median(contrast[good] / slope[good])) if good.any() else float("nan")


def _depth(depth_m: FloatArray, mask: np.ndarray, view: BoardView) -> tuple[float, float]:
    """Share of the board's pixels with depth, and share of these that lie before the board."""
    z = depth_m[mask]
    measured = np.isfinite(z)
    known = np.isfinite(view.depth_m)
    if not measured.any() or known.sum() < 6:
        return float(measured.mean()), float("nan")
    centre = view.corners_px.mean(axis=0)

    def rows(px: FloatArray) -> FloatArray:
        return np.column_stack([px - centre, np.ones(len(px))])

    plane = np.linalg.lstsq(rows(view.corners_px[known]), 1 / view.depth_m[known], rcond=None)[0]
    v, u = np.nonzero(mask)
    q = rows(np.column_stack([u, v])[measured].astype(float)) @ plane
    off = z[measured] - 1 / np.where(q > 1e-3, q, np.nan)
    sigma = 1.4826 * float(np.nanmedian(np.abs(off - np.nanmedian(off))))
    before = off < -max(OFF_PLANE_M, 5 * sigma)
    return float(measured.mean()), float(np.mean(before))
