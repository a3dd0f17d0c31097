"""Observations as a structure of arrays: points with the same cameras lie together, one dense block for each set.

Points are renumbered so that each block is a slice of them: the kernels gather nothing, whatever is visible to whom.
Memory is linear in the observations. Visibility sets of few points are merged into one block with a mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import IntArray

MIN_BLOCK_POINTS = 64
"""Below this the cost of calling numpy outweighs the arithmetic on what a mask hides."""

MAX_BLOCK_OBSERVATIONS = 8192
"""Arrays of this length, 64 KiB, stay in the second-level cache between one operation and the next."""


@dataclass(frozen=True)
class PointGroup:
    """n points seen by k cameras."""

    cameras: IntArray
    """(k,), ascending; camera 0 is the reference."""
    points: slice
    """Of the renumbered points, n long."""
    rows: IntArray
    """(k, n), row of each observation in its table; 0 where `seen` is False."""
    seen: np.ndarray | None
    """(k, n) bool, or None where all of it is seen."""

    @property
    def first_free(self) -> int:
        """Place of the first camera that has a pose to estimate: 1 where the reference is among them, else 0."""
        return int(self.cameras[0] == 0)

    def gather(self, table: FloatArray) -> FloatArray:
        """(k, d, n) from a table (rows, d), contiguous."""
        return np.ascontiguousarray(np.moveaxis(table[self.rows], -1, 1))


@dataclass(frozen=True)
class Grouping:
    """Blocks, and what was left out of them."""

    blocks: tuple[PointGroup, ...]
    labels: IntArray
    """(h,), the label of each renumbered point."""
    n_observations: int
    alone: IntArray
    """Rows whose point no other camera sees: they say nothing about a pose."""


def by_visibility(camera: IntArray, point: IntArray, n_cameras: int) -> Grouping:
    """Blocks of the points that two cameras see or more; `camera` and `point` are (n,), each pair once."""
    n_points = int(point.max()) + 1 if len(point) else 0
    shared = (np.bincount(point, minlength=n_points) >= 2)[point]
    rows = np.flatnonzero(shared)
    sets = np.zeros((n_points, n_cameras), bool)
    sets[point[rows], camera[rows]] = True
    labels = np.flatnonzero(sets.any(axis=1))
    runs = [(0, len(labels))]
    if not sets[labels].all():
        keys = np.packbits(sets[labels], axis=1)
        order = np.lexsort(keys.T[::-1])
        labels, keys = labels[order], keys[order]
        runs = _runs(keys)
    new = np.zeros(n_points, int)
    new[labels] = np.arange(len(labels))

    by_point = rows[np.argsort(new[point[rows]], kind="stable")]
    ends = np.concatenate([[0], np.cumsum(sets[labels].sum(axis=1))])
    blocks = []
    for start, stop in runs if len(labels) else ():
        cameras = np.flatnonzero(sets[labels[start:stop]].any(axis=0))
        step = max(MIN_BLOCK_POINTS, MAX_BLOCK_OBSERVATIONS // len(cameras))
        n_parts = -(-(stop - start) // step)
        edges = np.linspace(start, stop, n_parts + 1).astype(int)
        for first, last in pairwise(edges):
            own = by_point[ends[first] : ends[last]]
            table = np.full((len(cameras), last - first), -1)
            table[np.searchsorted(cameras, camera[own]), new[point[own]] - first] = own
            seen = table >= 0
            blocks.append(
                PointGroup(cameras, slice(int(first), int(last)), np.maximum(table, 0), None if seen.all() else seen)
            )
    return Grouping(tuple(blocks), labels, len(rows), np.flatnonzero(~shared))


def _runs(keys: np.ndarray) -> list[tuple[int, int]]:
    """Slices of equal sets, neighbours joined until each holds `MIN_BLOCK_POINTS` points."""
    edges = [0, *(np.flatnonzero((keys[1:] != keys[:-1]).any(axis=1)) + 1), len(keys)]
    runs: list[tuple[int, int]] = []
    start = 0
    for edge, following in zip(edges[1:], [*edges[2:], None], strict=True):
        small = edge - start < MIN_BLOCK_POINTS
        next_small = following is not None and following - edge < MIN_BLOCK_POINTS
        if following is None or not (small and next_small):
            runs.append((start, int(edge)))
            start = int(edge)
    return runs
