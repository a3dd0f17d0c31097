"""Where the board has been, camera by camera and pair by pair, and what is still missing, in words.

A view fills the regions of the image that its corners fall into, stands at a distance (depth of the board's middle
along the optical axis) and at a tilt (angle between the board's normal and the optical axis). A focal length and a
principal point need corners over the whole image, tilted boards, and near and far ones; a rig needs a chain of pairs
of cameras that saw the board at the same instant. Capturing shows this live, and a finished recording is judged by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView, IntArray

NOMINAL_FOCAL_PER_WIDTH = 575.82 / 640
"""Focal length of an Xtion's VGA stream per px of width, from the field of view the driver reports."""

_MIN_POSE_CORNERS = 4


@dataclass(frozen=True)
class CoverageParams:
    """What counts as enough."""

    region_columns: int = 4
    region_rows: int = 3
    min_regions: int = 9
    """Regions of each image that must hold corners."""
    min_views: int = 8
    """Views of each camera."""
    distance_edges_m: tuple[float, ...] = (0.0, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, math.inf)
    min_distance_ratio: float = 1.3
    """Farthest over nearest distance of the board; a focal length shows in how the size changes."""
    tilt_edges_rad: tuple[float, ...] = tuple(math.radians(v) for v in (0, 15, 30, 45, 90))
    tilted_rad: float = math.radians(15)
    min_tilted: int = 3
    """Views of each camera tilted by at least `tilted_rad`: parallel boards alone leave the focal length open."""
    judge_cameras: bool = True
    """False: regions, distances and tilts are shown but not asked for (the intrinsics come from elsewhere)."""
    judge_pairs: bool = True
    """False: each camera is recorded alone."""
    min_common_frames: int = 3
    """Frames that a pair must share to count as a link of the rig."""
    judge_alone: bool = False
    """True: lenses come from the same recording. Shared views are asked for first, then views close to each camera alone."""
    close_extent: float = 0.4
    """Of the image's width or height: a board whose corners span as much is close."""
    min_close: int = 5
    """Close views of each camera: four corners of the image, and its middle."""


@dataclass(frozen=True)
class ViewCoverage:
    """A view with the regions it fills and the board's place; distance and tilt are NaN where no pose was found."""

    camera: str
    frame: str
    regions: IntArray
    """(rows, columns), 1 where a corner lies."""
    distance_m: float
    tilt_rad: float
    extent: float = 0.0
    """Of the corners, along the image's width or height, whichever is the larger share."""


@dataclass(frozen=True)
class CameraCoverage:
    """Where one camera has seen the board."""

    views: int
    regions: IntArray
    """(rows, columns): views with a corner in that region of the image, row 0 on top."""
    distances: IntArray
    """Views in each bin of `CoverageParams.distance_edges_m`."""
    tilts: IntArray
    """Views in each bin of `CoverageParams.tilt_edges_rad`."""
    nearest_m: float
    """NaN without views."""
    farthest_m: float


@dataclass(frozen=True)
class Coverage:
    """What has been seen, and what is still missing."""

    cameras: dict[str, CameraCoverage]
    common_frames: dict[tuple[str, str], int]
    """Frames in which both cameras saw the board, for every pair."""
    missing: tuple[str, ...]
    """Sentences for the person who holds the board; the most needed first."""
    next: str
    """What the first of them asks to do, without the reason; empty where nothing is missing."""
    connected: bool
    """True where pairs with enough common frames join all cameras."""
    shared_enough: bool
    """True where nothing is missing of what cameras see together."""

    @property
    def enough(self) -> bool:
        """True where nothing is missing."""
        return not self.missing


class _Wish(NamedTuple):
    """A sentence of `Coverage.missing`, in three parts."""

    cameras: str
    reason: str
    action: str


def measure_coverage(
    views: Sequence[BoardView],
    board: Board,
    image_sizes: Mapping[str, tuple[int, int]],
    intrinsics: Mapping[str, Intrinsics] | None = None,
    params: CoverageParams | None = None,
) -> Coverage:
    """Coverage by `views`, of the cameras of `image_sizes`: {camera: (width, height)} px.

    A camera without entry in `intrinsics` is taken as an Xtion: distances and tilts are then good to some percent.
    """
    params = params or CoverageParams()
    placed = [place_view(v, board, image_sizes[v.camera], (intrinsics or {}).get(v.camera), params) for v in views]
    return summarize_coverage(placed, tuple(image_sizes), params)


def place_view(
    view: BoardView,
    board: Board,
    image_size: tuple[int, int],
    intrinsics: Intrinsics | None = None,
    params: CoverageParams | None = None,
) -> ViewCoverage:
    """The regions of the image that a view fills, and the distance and tilt of the board in it.

    Which face and which half turn was seen does not matter: both give the same distance and tilt.
    """
    params = params or CoverageParams()
    width, height = image_size
    columns = np.clip(view.corners_px[:, 0] / width * params.region_columns, 0, params.region_columns - 1).astype(int)
    rows = np.clip(view.corners_px[:, 1] / height * params.region_rows, 0, params.region_rows - 1).astype(int)
    regions = np.zeros((params.region_rows, params.region_columns), int)
    regions[rows, columns] = 1
    distance_m, tilt_rad = _distance_and_tilt(view, board, intrinsics or nominal_intrinsics(image_size))
    extent = float((np.ptp(view.corners_px, axis=0) / image_size).max()) if len(view.ids) else 0.0
    return ViewCoverage(view.camera, view.frame, regions, distance_m, tilt_rad, extent)


def nominal_intrinsics(image_size: tuple[int, int]) -> Intrinsics:
    """The intrinsics that an Xtion reports, for images of (width, height) px."""
    width, height = image_size
    focal_px = NOMINAL_FOCAL_PER_WIDTH * width
    return Intrinsics(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def summarize_coverage(
    placed: Sequence[ViewCoverage], cameras: Sequence[str], params: CoverageParams | None = None
) -> Coverage:
    """Coverage of `cameras` by views that were placed before, as a live display does it."""
    params = params or CoverageParams()
    own = {camera: [v for v in placed if v.camera == camera] for camera in cameras}
    per_camera = {camera: _camera_coverage(views, params) for camera, views in own.items()}
    frames = {camera: {v.frame for v in views} for camera, views in own.items()}
    common = {(a, b): len(frames[a] & frames[b]) for a, b in combinations(cameras, 2)}
    links = _missing_links(cameras, common, params) if params.judge_pairs else []
    missing = list(links)
    shared_enough = not links
    if params.judge_alone and params.judge_cameras and len(cameras) > 1:
        for camera, views in own.items():
            others = set[str]().union(*(frames[other] for other in cameras if other != camera))
            shared = _camera_coverage([v for v in views if v.frame in others], params)
            missing += _missing_poses(camera, shared, params, "shared view")
        shared_enough = not missing
        if shared_enough:
            for camera, views in own.items():
                close = sum(v.extent >= params.close_extent for v in views)
                missing += _missing_close(camera, close, params) + _missing_regions(camera, per_camera[camera], params)
    else:
        for camera, coverage in per_camera.items():
            missing += _missing_views(camera, coverage, params)
    first = f"{missing[0].cameras}: {missing[0].action}" if missing else ""
    sentences = tuple(f"{m.cameras}{m.reason}: {m.action}" for m in missing)
    return Coverage(per_camera, common, sentences, first, not links, shared_enough)


def _distance_and_tilt(view: BoardView, board: Board, intrinsics: Intrinsics) -> tuple[float, float]:
    if len(view.ids) < _MIN_POSE_CORNERS:
        return math.nan, math.nan
    points_m = board.corners_m()[view.ids]
    if np.linalg.matrix_rank(points_m[:, :2] - points_m[:, :2].mean(axis=0), tol=1e-6) < 2:
        return math.nan, math.nan
    try:
        found, rotation, translation = cv2.solvePnP(
            points_m,
            np.ascontiguousarray(intrinsics.rays(view.corners_px)[:, :2]),  # cv2 refuses a slice
            np.eye(3),
            np.zeros(5),
            flags=cv2.SOLVEPNP_IPPE,
        )
    except cv2.error:
        return math.nan, math.nan
    if not found:
        return math.nan, math.nan
    R_color_board: FloatArray = np.asarray(cv2.Rodrigues(rotation)[0], float)
    middle_m = R_color_board @ points_m.mean(axis=0) + translation.ravel()
    return float(middle_m[2]), float(np.arccos(np.clip(abs(R_color_board[2, 2]), 0.0, 1.0)))


def _camera_coverage(placed: Sequence[ViewCoverage], params: CoverageParams) -> CameraCoverage:
    distances_m = np.array([v.distance_m for v in placed if not math.isnan(v.distance_m)])
    tilts_rad = np.array([v.tilt_rad for v in placed if not math.isnan(v.tilt_rad)])
    regions = np.zeros((params.region_rows, params.region_columns), int)
    for view in placed:
        regions += view.regions
    return CameraCoverage(
        views=len(placed),
        regions=regions,
        distances=np.histogram(distances_m, np.array(params.distance_edges_m))[0],
        tilts=np.histogram(tilts_rad, np.array(params.tilt_edges_rad))[0],
        nearest_m=float(distances_m.min()) if len(distances_m) else math.nan,
        farthest_m=float(distances_m.max()) if len(distances_m) else math.nan,
    )


def _missing_links(
    cameras: Sequence[str], common: Mapping[tuple[str, str], int], params: CoverageParams
) -> list[_Wish]:
    """One wish for each link that a chain over all cameras still needs: the pair that is nearest to being one."""
    group = {camera: {camera} for camera in cameras}

    def join(a: str, b: str) -> None:
        union = group[a] | group[b]
        for camera in union:
            group[camera] = union

    for (a, b), frames in common.items():
        if frames >= params.min_common_frames:
            join(a, b)
    wishes = []
    for (a, b), frames in sorted(common.items(), key=lambda item: -item[1]):
        if group[a] is group[b]:
            continue
        join(a, b)
        if frames == 0:
            wishes.append(_Wish(f"{a} and {b}", " share no view yet", "hold the board where both see it"))
        else:
            more = params.min_common_frames - frames
            reason = f" share {_count(frames, 'view')}, {more} more needed"
            wishes.append(_Wish(f"{a} and {b}", reason, "hold the board for both"))
    return wishes


def _missing_views(camera: str, coverage: CameraCoverage, params: CoverageParams) -> list[_Wish]:
    if coverage.views == 0:
        return [_Wish(camera, " has not seen the board yet", "hold the board in front of it")]
    if not params.judge_cameras:
        return []
    return _missing_poses(camera, coverage, params, "view") + _missing_regions(camera, coverage, params)


def _missing_poses(camera: str, coverage: CameraCoverage, params: CoverageParams, what: str) -> list[_Wish]:
    """Number, distances and tilts of the views that `coverage` is of."""
    wishes = []
    if coverage.views < params.min_views:
        reason = f": {_count(coverage.views, what)}, {params.min_views} needed"
        wishes.append(_Wish(camera, reason, "show it more poses"))
    if coverage.views and not coverage.farthest_m >= params.min_distance_ratio * coverage.nearest_m:
        seen = "board seen" if what == "view" else "board shared"
        reason = f": {seen} only from {coverage.nearest_m:.2f} to {coverage.farthest_m:.2f} m"
        wishes.append(_Wish(camera, reason, "hold it nearer and farther too"))
    tilted = int(coverage.tilts[np.array(params.tilt_edges_rad[:-1]) >= params.tilted_rad - 1e-9].sum())
    if coverage.views and tilted < params.min_tilted:
        tilt_deg = math.degrees(params.tilted_rad)
        reason = f": {_count(tilted, what)} tilted by more than {tilt_deg:.0f}°, {params.min_tilted} needed"
        wishes.append(_Wish(camera, reason, "tilt the board to the side, up and down"))
    return wishes


def _missing_regions(camera: str, coverage: CameraCoverage, params: CoverageParams) -> list[_Wish]:
    filled = int((coverage.regions > 0).sum())
    if filled >= params.min_regions:
        return []
    reason = f": corners in {filled} of {coverage.regions.size} image regions, {params.min_regions} needed"
    return [_Wish(camera, reason, f"move the board to the {region_names(coverage.regions == 0)}")]


def _missing_close(camera: str, close: int, params: CoverageParams) -> list[_Wish]:
    if close >= params.min_close:
        return []
    reason = f": {_count(close, 'close view')}, {params.min_close} needed"
    return [_Wish(camera, reason, "hold the board close to it, in each corner of its image, tilted")]


def region_names(empty: IntArray) -> str:
    """The empty regions in words, such as `upper left, lower right`; at most three."""
    rows, columns = empty.shape
    names = []
    for row, column in np.argwhere(empty):
        y, x = (row + 0.5) / rows, (column + 0.5) / columns
        vertical = "upper " if y < 1 / 3 else "lower " if y > 2 / 3 else ""
        horizontal = "left" if x < 0.4 else "right" if x > 0.6 else "middle"
        name = f"{vertical}{horizontal}"
        if name not in names:
            names.append(name)
    return ", ".join(names[:3])


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
