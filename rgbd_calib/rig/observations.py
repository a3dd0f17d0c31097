"""What was measured: every view of the board as padded arrays, and the walls of a bias recording as cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from rgbd_calib.cameras.wall import SeenWall
from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, PlacedView


@dataclass(frozen=True)
class Observations:
    """All views, padded to the same number of corners; V views, N corners, C cameras, F frames."""

    camera: IntArray
    """(V,)."""
    frame: IntArray
    """(V,) number of the board's pose."""
    shared: BoolArray
    """(V,) bool: the frame is seen by several cameras, and its board is posed in the world."""
    back: IntArray
    """(V,) 1 where the board's back is seen, else 0."""
    corner: IntArray
    """(V, N), number of the front's corner at each, or before it."""
    pixels_px: FloatArray
    """(V, N, 2)."""
    depth_m: FloatArray
    """(V, N), as measured; 1 where there is none."""
    cell_ratio: FloatArray
    """(V, N), depth pixels that a corner rests on, over the median of its camera; 1 where there are none."""
    rounding_m: FloatArray
    """(V,), deviation of a depth that is rounded to the camera's unit, unit / sqrt(12)."""
    alone: BoolArray
    """(V,) bool: of the camera's own intrinsic recording."""
    has_pixel: BoolArray
    """(V, N) bool."""
    has_depth: BoolArray
    """(V, N) bool."""

    @property
    def n_frames(self) -> int:
        return int(self.frame.max()) + 1

    def keep(self, has_pixel: BoolArray, has_depth: BoolArray) -> Observations:
        """The same views with other masks."""
        return replace(self, has_pixel=has_pixel, has_depth=has_depth)

    def only(self, views: slice | IntArray) -> Observations:
        """Some of the views."""
        return Observations(**{field.name: getattr(self, field.name)[views] for field in fields(self)})


@dataclass(frozen=True)
class Walls:
    """Walls of a bias recording, cut into cells; W walls, N cells, padded where images differ."""

    camera: IntArray
    """(W,)."""
    written_m: FloatArray
    """(W,), the distance as written down, along the optical axis."""
    sd_m: FloatArray
    """(W,), its standard deviation."""
    pixels_px: FloatArray
    """(W, N, 2), middles of the cells in the depth image."""
    depth_m: FloatArray
    """(W, N), mean of what was reported; 1 where there is none."""
    seen: BoolArray
    """(W, N)."""
    grids: IntArray
    """(C, 2), rows and columns of the cells of each camera, the first of the N."""
    tilts: FloatArray
    """(W, 2), a and b of the plane z = D / (1 - a x - b y), as it is thought to stand."""

    @property
    def n(self) -> int:
        return len(self.camera)

    @classmethod
    def of(cls, cameras: Sequence[str], seen: Mapping[str, Sequence[SeenWall]]) -> Walls:
        """Of the walls of each camera."""
        every = [(i, wall) for i, name in enumerate(cameras) for wall in seen.get(name, ())]
        if not every:
            return cls.none()
        N = max(wall.cells.seen.size for _, wall in every)
        pixels, depth, there = np.zeros((len(every), N, 2)), np.ones((len(every), N)), np.zeros((len(every), N), bool)
        grids = np.zeros((len(cameras), 2), int)
        for row, (i, wall) in enumerate(every):
            n, grids[i] = wall.cells.seen.size, wall.cells.seen.shape
            pixels[row, :n] = wall.cells.pixels_px.reshape(-1, 2)
            depth[row, :n], there[row, :n] = wall.cells.depth_m.ravel(), wall.cells.seen.ravel()
        distances, sds = (np.array([getattr(wall, key) for _, wall in every]) for key in ("distance_m", "sd_m"))
        tilts = np.array([wall.tilt for _, wall in every])
        return cls(np.array([i for i, _ in every]), distances, sds, pixels, depth, there, grids, tilts)

    @classmethod
    def none(cls) -> Walls:
        cells = np.zeros((0, 1))
        grids = np.zeros((0, 2), int)
        return cls(
            np.zeros(0, int),
            np.zeros(0),
            np.zeros(0),
            np.zeros((0, 1, 2)),
            cells,
            cells.astype(bool),
            grids,
            np.zeros((0, 2)),
        )


def observe(
    views: Sequence[PlacedView], board: Board, units_m: Mapping[str, float]
) -> tuple[Observations, tuple[str, ...]]:
    """Views as padded arrays, and the frame of each board pose; `units_m` is the depth's unit by camera."""
    cameras, units = list(units_m), np.array(list(units_m.values()))
    frames = sorted({placed.view.frame for placed in views})
    number = {name: k for k, name in enumerate(frames)}
    n = max(len(placed.view.ids) for placed in views)
    V = len(views)
    pixels, depth, corner = np.zeros((V, n, 2)), np.ones((V, n)), np.zeros((V, n), int)
    has_pixel, has_depth = np.zeros((V, n), bool), np.zeros((V, n), bool)
    cells = np.full((V, n), np.nan)
    for i, placed in enumerate(views):
        m = len(placed.view.ids)
        measured = np.isfinite(placed.view.depth_m)
        pixels[i, :m], corner[i, :m] = placed.view.corners_px, placed.front_corner(board)
        has_pixel[i, :m], has_depth[i, :m] = not placed.view.predicted, measured
        depth[i, :m][measured] = placed.view.depth_m[measured]
        cells[i, :m][measured] = np.maximum(placed.view.depth_pixels[measured], 1)
    camera_of = np.array([cameras.index(placed.view.camera) for placed in views])
    frame_of = np.array([number[placed.view.frame] for placed in views])
    observations = Observations(
        camera_of,
        frame_of,
        np.bincount(frame_of)[frame_of] > 1,
        np.array([int(placed.back) for placed in views]),
        corner,
        pixels,
        depth,
        _over_median(cells, camera_of),
        units[camera_of] / np.sqrt(12),
        np.array([placed.view.alone for placed in views]),
        has_pixel,
        has_depth,
    )
    return observations, tuple(frames)


def _over_median(cells: FloatArray, camera_of: IntArray) -> FloatArray:
    """Pixels of each cell over the median of its camera's, (V, N), 1 where there are none."""
    out = np.ones_like(cells)
    for c in np.unique(camera_of):
        mine = (camera_of == c)[:, None] & np.isfinite(cells)
        if mine.any():
            out[mine] = cells[mine] / np.median(cells[mine])
    return out
