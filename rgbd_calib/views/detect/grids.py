"""Grids of saddle points: neighbours along the edges, closed cells, then growth by local prediction.

The neighbour of a saddle point along an edge is the nearest one with black and white exchanged and an edge on the same line.
Four such steps around a square that return to their start make a cell; connected cells are the seed of a grid. An image with
fewer than MIN_CELLS connected cells, as many as 3 x 3 corners have, is rejected at this point. A seed grows into its holes
and by whole lines, where corners are found close to their predicted places. Predictions use nearby corners only, so that a
lens may distort the grid (the idea of Geiger, Moosmann, Car, Schuster, "Automatic camera and range sensor calibration using
a single shot", ICRA 2012).

Around a hole at (0, 0), the corner of column x and row y is predicted at c0 + c1 x + c2 y + c3 x^2 / 2 + c4 x y + c5 y^2 / 2,
fitted to the 7 x 7 corners around it with weights that fall with the distance, and with priors: the sides c1 and c2 are
those of the grid as a whole, and the second derivatives c3, c4, c5 are zero, within what perspective and lenses do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import IntArray
from rgbd_calib.views.detect.saddles import Saddles

LINKED = 400
"""Number of saddles that are linked, the strongest first. In scripts/benchmark_detection.py, the weakest corner of a board of
88 is the 128th saddle, in deep shadow the 252nd."""
NEAREST = 24
"""Number of saddles around each that are candidates; on a board tilted by 70 degrees, the next along the rows is the 15th."""
TURNED = -0.5
"""Cosine between the Hessians of neighbours, at most."""
ALONG = np.cos(np.deg2rad(32))
"""The line to a neighbour leaves both saddles' edges by less; blur opens the angle between two edges that are 25 degrees
apart to 70. The next candidate for a wrong neighbour, a knight's move away, is farther than the right one."""
MIN_CELLS = 4
"""Cells of a seed, as in 3 x 3 corners."""
LINE_SHARE = 0.5
"""Share of the corners of an outer line that must be detected for the line to count."""
FAINT = np.log(0.03)
"""A corner is at least this strong beside the others of its grid; in a shadow that takes 80 % of the light, 0.04."""
SIGMA, BEND, SIDE = 0.03, 0.06, 0.3
"""Standard deviations in sides of a square: of a corner about a smooth grid, of c3 to c5 and of c1, c2 from one place of
a grid to another."""
MAX_SIGMA = 0.2
"""A corner is looked for where its prediction is that certain, sides of a square."""
TOLERANCE = 0.1, 2.0, 0.35
"""It is found within the first + the second x the prediction's standard deviation, at most the third."""
INTO_SQUARE = 0.3
"""So far from a corner along the diagonals of its squares their shades are compared."""
MIN_GAP = 0.2
"""The darker bright square is brighter than the brighter dark one by this share of what they differ in the mean."""


@dataclass(frozen=True)
class Grid:
    """Corners of one checkerboard."""

    px: FloatArray
    """(rows, columns, 2): where they are seen, or else where the others have them; NaN where they cannot tell."""
    seen: np.ndarray
    """(rows, columns), bool."""
    beyond: float
    """Share of corners that are seen in the line beside the grid that shows most of them."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.seen.shape[0], self.seen.shape[1]

    @property
    def n_seen(self) -> int:
        return int(self.seen.sum())

    @property
    def side_px(self) -> float:
        """The shorter side of a square, in the median over the grid."""
        return float(min(np.linalg.norm(_median_step(self.px, axis)) for axis in (0, 1)))


def find_grids(saddles: Saddles, size: tuple[int, int] | None = None) -> list[Grid]:
    """All grids that the saddles make, those of the most corners first; no saddle is in two.

    Parameters
    ----------
    size
        Of the grid that is looked for, in any order: one that has it, or has become larger, does not grow any more.
    """
    strong = np.flatnonzero(saddles.clear)[: LINKED if size is None else max(LINKED, 2 * size[0] * size[1])]
    if len(strong) < 9:
        return []
    neighbours, back = _neighbours(saddles.px[strong], saddles.hessian[strong], saddles.edges[strong])
    grids, used = [], np.zeros(len(saddles.px), bool)
    for start in _starts(neighbours, back, _closed(neighbours, back)):
        at = np.where(start >= 0, strong[start], -1)
        if used[at[at >= 0]].any():
            continue
        at, beyond = _grown(at, saddles, used, size)
        if min(at.shape) >= 2:
            used[at[at >= 0]] = True
            grids.append(_grid(at, beyond, saddles))
    return sorted(grids, key=lambda grid: -grid.n_seen)


def _neighbours(px: FloatArray, hessian: FloatArray, edges: FloatArray) -> tuple[IntArray, IntArray]:
    """Number of the saddle beside each one along each of its edges (n, 4), and that one's edge back (n, 4); -1: none."""
    n = len(px)
    distance, near = (np.asarray(a) for a in cKDTree(px).query(px, min(NEAREST + 1, n)))
    i, k = np.nonzero(np.einsum("ik,ijk->ij", hessian, hessian[near]) < TURNED)
    j = near[i, k]
    d = (px[j] - px[i]) / distance[i, k, None]
    out, ahead = _edge_along(edges[i], d)
    home, behind = _edge_along(edges[j], -d)
    fits = ahead & behind & (out % 2 != home % 2)  # u and v change places with black and white
    i, j, out, home = i[fits], j[fits], out[fits], home[fits]
    at, first = np.unique(4 * i + out, return_index=True)  # the nearest comes first
    neighbours, back = np.full((n, 4), -1), np.full((n, 4), -1)
    neighbours.ravel()[at], back.ravel()[at] = j[first], home[first]
    mutual = (neighbours >= 0) & (neighbours[neighbours, back] == np.arange(n)[:, None])
    return np.where(mutual, neighbours, -1), np.where(mutual, back, -1)


def _edge_along(edges: FloatArray, d: FloatArray) -> tuple[IntArray, np.ndarray]:
    """Which of the edges (m, 4, 2) points along d (m, 2), and whether it is near enough."""
    cosine = np.einsum("mki,mi->mk", edges, d)
    return cosine.argmax(axis=1), cosine.max(axis=1) > ALONG


def _closed(neighbours: IntArray, back: IntArray) -> np.ndarray:
    """(n, 4) bool: is the square between this edge and the next one a cell?"""
    left, left_back = np.roll(neighbours, -1, axis=1), np.roll(back, -1, axis=1)
    # whoever came by edge `back` goes straight on by back + 2, to the left by back + 3, to the right by back + 1
    around = np.where(neighbours >= 0, neighbours[neighbours, (back + 3) % 4], -1)
    return np.asarray((around >= 0) & (left >= 0) & (around == neighbours[left, (left_back + 1) % 4]))


def _starts(neighbours: IntArray, back: IntArray, cells: np.ndarray) -> Iterator[IntArray]:
    """Saddles' numbers (rows, columns) of each set of connected cells, -1 for none, the largest first."""
    n = len(neighbours)
    linked = cells | np.roll(cells, 1, axis=1)
    i, k = np.nonzero(linked)
    count, label = connected_components(coo_array((np.ones(len(i)), (i, neighbours[i, k])), (n, n)), directed=False)
    size = np.bincount(label, cells.sum(axis=1), count) / 4  # a cell is seen from its four corners
    for component in np.argsort(-size, kind="stable"):
        if size[component] < MIN_CELLS:
            return
        members = np.flatnonzero(label == component)
        first = members[np.argmax(cells[members].sum(axis=1))]
        yield _laid_out(int(first), neighbours, back, linked)


def _laid_out(first: int, neighbours: IntArray, back: IntArray, linked: np.ndarray) -> IntArray:
    """Numbers (rows, columns) of the saddles that links join to the first."""
    place, turn, taken, todo = {first: (0, 0)}, {first: 0}, {(0, 0): first}, [first]
    for i in todo:
        (x, y), turned = place[i], turn[i]
        beside, arrive, joined = neighbours[i].tolist(), back[i].tolist(), linked[i].tolist()
        for k, (dx, dy) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            edge = (k + turned) % 4
            j, at = beside[edge], (x + dx, y + dy)
            if joined[edge] and j not in place and at not in taken:
                place[j], taken[at], turn[j] = at, j, (arrive[edge] + 2 - k) % 4
                todo.append(j)
    places = np.array(list(taken))
    places -= places.min(axis=0)
    out = np.full(places.max(axis=0)[::-1] + 1, -1)
    out[places[:, 1], places[:, 0]] = list(taken.values())
    return out


def _grown(at: IntArray, saddles: Saddles, used: np.ndarray, size: tuple[int, int] | None) -> tuple[IntArray, float]:
    """The same grid with its holes filled and with the lines beside it, as far as saddles are where they should be.

    Also the share of corners that are seen in the line beside it that shows most of them.
    """
    before = 0
    while True:
        while (filled := _filled(at, saddles, used)) is not at:
            at = filled
        at = _trimmed(at, saddles.clear)
        n_seen = int((at >= 0).sum())
        large = size is not None and (max(at.shape) > max(size) or min(at.shape) > min(size))
        if min(at.shape) < 2 or large or n_seen <= before:
            return at, 0.0
        before, whole = n_seen, size is not None and sorted(at.shape) == sorted(size)
        k = 1 if whole else 2  # lines; the edge of a shadow may hide one
        wider = _filled(np.pad(at, k, constant_values=-1), saddles, used)
        trimmed = _trimmed(wider, saddles.clear)
        if trimmed.shape == at.shape:
            beside = wider[k - 1, k:-k], wider[-k, k:-k], wider[k:-k, k - 1], wider[k:-k, -k]
            return at, float(max((line >= 0).mean() for line in beside))
        at = trimmed


def _trimmed(at: IntArray, clear: np.ndarray) -> IntArray:
    """Without outer lines in which too few corners are seen."""
    good = (at >= 0) & clear[at]
    while min(good.shape) > 1:
        share = [line.mean() for line in (good[0], good[-1], good[:, 0], good[:, -1])]
        worst = int(np.argmin(share))
        if share[worst] >= LINE_SHARE:
            break
        at, good = ((a[1:], a[:-1], a[:, 1:], a[:, :-1])[worst] for a in (at, good))
    return at


def _filled(at: IntArray, saddles: Saddles, used: np.ndarray) -> IntArray:
    """With saddles in its holes, where they are as predicted; the same array where there are none."""
    rows, cols = np.nonzero(at < 0)
    if not len(rows):
        return at
    expected = _predicted(at, rows, cols, saddles)
    sure = expected.sigma < MAX_SIGMA
    rows, cols, expected = rows[sure], cols[sure], expected.of(sure)
    if not len(rows):
        return at
    base, slope, most = TOLERANCE
    reach = most * np.abs(expected.sides).max()
    low, high = expected.px.min(axis=0) - reach, expected.px.max(axis=0) + reach
    free = ~used & (saddles.log_strength > np.mean(saddles.log_strength[at[at >= 0]]) + FAINT)
    free &= np.all((saddles.px > low) & (saddles.px < high), axis=1)
    free[at[at >= 0]] = False
    candidates = np.flatnonzero(free)
    if not len(candidates):
        return at
    off = saddles.px[candidates] - expected.px[:, None]
    distance = np.linalg.norm(off @ np.linalg.inv(expected.sides).transpose(0, 2, 1), axis=2)
    fits = distance < np.minimum(base + slope * expected.sigma, most)[:, None]
    fits &= expected.hessian @ saddles.hessian[candidates].T > -TURNED
    hole, candidate = np.nonzero(fits)
    px, hessian = saddles.px[candidates[candidate]], saddles.hessian[candidates[candidate]]
    fits[hole, candidate] = _amid_squares(saddles.smooth, px, expected.sides[hole], hessian)
    distance[~fits] = np.inf
    best = distance.argmin(axis=1)
    shortest = distance[np.arange(len(best)), best]
    some = np.argsort(shortest, kind="stable")[: int(np.isfinite(shortest).sum())]
    if not len(some):
        return at
    chosen, first = np.unique(candidates[best[some]], return_index=True)  # no saddle in two holes
    out = at.copy()
    out[rows[some[first]], cols[some[first]]] = chosen
    return out


def _amid_squares(smooth: np.ndarray, px: FloatArray, sides: FloatArray, hessian: FloatArray) -> np.ndarray:
    """(n,) bool: do the four squares around corners (n, 2) with sides (n, 2, 2) change from dark to bright and back?

    The Hessian (n, 3) says which are bright.
    """
    across = sides @ np.array([[1.0, 1.0], [1.0, -1.0]])  # columns: the squares' diagonals
    x, y = across[:, 0], across[:, 1]
    bends = hessian[:, :1] * x**2 + np.sqrt(2) * hessian[:, 1:2] * x * y + hessian[:, 2:] * y**2
    at = px[:, None] + INTO_SQUARE * np.concatenate([across, -across], axis=2).transpose(0, 2, 1)
    u, v = at.astype(np.float32).transpose(2, 0, 1)
    shade = cv2.remap(smooth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) if len(px) else np.zeros((0, 4))
    sign = np.where(bends[:, 0] > bends[:, 1], 1.0, -1.0)[:, None]
    bright, dark = sign * shade[:, ::2], sign * shade[:, 1::2]
    gap, contrast = bright.min(axis=1) - dark.max(axis=1), bright.mean(axis=1) - dark.mean(axis=1)
    return np.asarray((gap > MIN_GAP * contrast) & (contrast > 0))


@dataclass(frozen=True)
class _Expected:
    """Corners in the holes of a grid."""

    px: FloatArray
    """(m, 2)."""
    sides: FloatArray
    """(m, 2, 2): c1 and c2, px, as columns."""
    sigma: FloatArray
    """(m,): standard deviation of `px`, sides of a square."""
    hessian: FloatArray
    """(m, 3)."""

    def of(self, some: np.ndarray) -> _Expected:
        return _Expected(self.px[some], self.sides[some], self.sigma[some], self.hessian[some])


_REACH = 3
_Y, _X = (g.ravel().astype(float) for g in np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1])
_BASIS = np.stack([np.ones_like(_X), _X, _Y, _X**2 / 2, _X * _Y, _Y**2 / 2], axis=1)
_SQUARED = (_BASIS[:, :, None] * _BASIS[:, None]).reshape(len(_X), 36)
_WEIGHT = np.exp(-(_X**2 + _Y**2) / (2 * 1.5**2)) / SIGMA**2
_ALTERNATE = np.where((_X + _Y) % 2 == 0, 1.0, -1.0) * _WEIGHT
_PRIOR = np.array([1e-6, SIDE**-2, SIDE**-2, BEND**-2, BEND**-2, BEND**-2])


def _predicted(at: IntArray, rows: IntArray, cols: IntArray, saddles: Saddles) -> _Expected:
    """The corners at `rows` (m,) and `cols` (m,)."""
    px = _placed(saddles.px, at)
    typical = np.array([_median_step(px, axis) for axis in (1, 0)])
    padded = np.pad(at, _REACH, constant_values=-1)
    around = padded[(rows[:, None] + _Y.astype(int) + _REACH), (cols[:, None] + _X.astype(int) + _REACH)]  # (m, 49)
    known = around >= 0
    origin = px[np.isfinite(px[..., 0])].mean(axis=0)
    weight = np.where(known, _WEIGHT, 0.0)
    normal = (weight @ _SQUARED).reshape(-1, 6, 6)
    np.einsum("nii->ni", normal)[:] += _PRIOR
    right = np.zeros((len(rows), 6, 3))
    right[..., :2] = (weight[:, None] * _BASIS.T) @ (saddles.px[around] - origin)
    right[:, 1:3, :2] += typical * SIDE**-2
    right[:, 0, 2] = 1
    solution = np.linalg.solve(normal, right)
    hessian = np.einsum("mk,mki->mi", np.where(known, _ALTERNATE, 0.0), saddles.hessian[around])
    hessian /= np.maximum(np.linalg.norm(hessian, axis=1, keepdims=True), 1e-9)
    sides = solution[:, 1:3, :2].transpose(0, 2, 1)
    flat = np.abs(np.linalg.det(sides)) < 0.05 * abs(np.linalg.det(typical)) + 1e-6
    sigma = np.where(flat | (known.sum(axis=1) < 3), np.inf, np.sqrt(solution[:, 0, 2]))
    return _Expected(solution[:, 0, :2] + origin, sides, sigma, hessian)


def _median_step(px: FloatArray, axis: int) -> FloatArray:
    """The median (2,) of the steps between neighbours along an axis of a grid (rows, columns, 2)."""
    steps = np.diff(px, axis=axis).reshape(-1, 2)
    steps = steps[np.isfinite(steps[:, 0])]
    return np.median(steps, axis=0) if len(steps) else np.zeros(2)


def _grid(at: IntArray, beyond: float, saddles: Saddles) -> Grid:
    px = _placed(saddles.px, at)
    rows, cols = np.nonzero(at < 0)
    if len(rows):
        expected = _predicted(at, rows, cols, saddles)
        px[rows, cols] = np.where(np.isfinite(expected.sigma)[:, None], expected.px, np.nan)
    return Grid(px, at >= 0, beyond)


def _placed(values: FloatArray, at: IntArray) -> FloatArray:
    return np.where((at >= 0)[..., None], values[at], np.nan)
