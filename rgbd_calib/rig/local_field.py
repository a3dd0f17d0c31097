"""What a depth sensor errs by over its image, beyond the smooth field: cells, steps, ripples, from the walls alone.

With the smooth field (:mod:`.blocks.depth_field`) and all else as solved, what is left in the walls of one camera, beyond
shapes that are smooth themselves, is a sum of patterns f_p(u, v) z^p, plus noise that grows as z^2. In the frequencies of
the image the patterns are independent of each other, those of one band of frequencies alike in size, and so is the noise:
neighbouring pixels share some of it. Their covariance over the powers, band by band, is that which makes
the data most probable (expectation and maximisation), and the patterns are their mean given the data (N. Wiener, 1949): where
there is no pattern nothing is left, and where there is one its noise is not taken for it.

Patterns this fine have no part in where cameras stand; so they are estimated between the rounds, and are known while the
rest is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import dctn, idctn

from rgbd_calib.geometry.depth_error import CellPattern, ErrorOfDepth, terms
from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import depth_field
from rgbd_calib.rig.problem import Problem, State

POWERS = (0, 1, 2)
"""Fixed pattern and range errors of time of flight, and disparity."""
LEAST_WALLS = len(POWERS) + 1
"""Below, their scatter does not tell noise from pattern."""
BANDS = 12
"""Of spatial frequency: the spectrum is smooth."""
LEAST_SEEN = 0.5
"""Share of the walls in which a cell must be seen."""
ROUNDS = 40
"""Of expectation and maximisation."""


@dataclass(frozen=True, kw_only=True)
class LocalField(CellPattern):
    """A pattern, and where its estimate stands: from there the next one goes on, since small sizes take many rounds."""

    sizes: FloatArray
    """(bands, powers, powers), covariance of the pattern's spectrum."""
    noise: FloatArray
    """(bands,), variance of the spectrum of one wall's error over z^2."""

    def error_m(self, pixels_px: FloatArray, z_m: FloatArray, size_px: FloatArray) -> FloatArray:
        key = pixels_px.shape, pixels_px.tobytes(), tuple(size_px)
        if key not in self._kept:
            self._kept[key] = self.at(pixels_px, size_px)
        return np.asarray(self._kept[key](z_m))

    @cached_property
    def _kept(self) -> dict[tuple[object, ...], ErrorOfDepth]:
        """The pattern at pixels that were asked for: corners and cells do not move while the rest is solved."""
        return {}


def local_fields(problem: Problem, state: State) -> tuple[LocalField | None, ...]:
    """The pattern of each camera that the walls show at a state; empty where there are no walls."""
    walls, found = problem.setup.walls, list[LocalField | None]()
    if not walls.n:
        return ()
    left_m, sizes_px = problem.wall_residuals(state), problem.setup.sizes_px
    for c, grid in enumerate(walls.grids):
        mine, cells = walls.camera == c, slice(0, int(np.prod(grid)))
        pixels_px, depth_m, seen = (x[mine][:, cells] for x in (walls.pixels_px, walls.depth_m, walls.seen))
        own_m, start = left_m[mine][:, cells], problem.local[c] if problem.local else None
        if start is not None:
            own_m = own_m + start.error_m(pixels_px, depth_m, sizes_px[c])
        shape = (len(own_m), *grid)
        found.append(local_field(own_m.reshape(shape), depth_m.reshape(shape), seen.reshape(shape), start))
    return tuple(found)


def local_field(
    left_m: FloatArray, depth_m: FloatArray, seen: BoolArray, start: LocalField | None = None
) -> LocalField | None:
    """The pattern of one camera.

    Parameters
    ----------
    left_m : (walls, rows, columns), true less corrected depth.
    depth_m : (walls, rows, columns), as reported.
    seen : (walls, rows, columns) bool.
    """
    known = seen & (seen.sum(axis=0) >= LEAST_SEEN * len(seen))
    walls = known.any(axis=(1, 2))
    if walls.sum() < LEAST_WALLS:
        return None
    left_m, depth_m, known = left_m[walls], depth_m[walls], known[walls]
    q = _rough(np.where(known, left_m / depth_m**2, 0.0), known)
    z = np.sum(depth_m * known, axis=(1, 2)) / known.sum(axis=(1, 2))
    A = z[:, None] ** (np.array(POWERS, float) - 2)  # (walls, powers)
    band = _bands(*q.shape[1:])
    members = [np.flatnonzero(band.ravel() == b) for b in range(BANDS)]
    count = np.bincount(band.ravel(), minlength=BANDS)
    noise = np.full(BANDS, float(np.mean(q[known] ** 2)))
    sizes = np.eye(len(POWERS)) * noise[:, None, None]
    if start is not None:
        sizes, noise = start.sizes, start.noise
    at = dctn(q, axes=(1, 2), norm="ortho")  # (walls, rows, columns)
    for k in range(ROUNDS):
        posterior = np.linalg.inv(np.linalg.inv(sizes) + A.T @ A / noise[:, None, None])  # (bands, powers, powers)
        of_powers = np.einsum("wq,wrc->rcq", A, at, optimize=True) / noise[band][..., None]
        mean = (posterior[band] @ of_powers[..., None])[..., 0]
        flat = mean.reshape(-1, len(POWERS))
        outer = np.stack([flat[own].T @ flat[own] for own in members])
        sizes = outer / count[:, None, None] + posterior
        left = np.sum((at - np.einsum("wp,rcp->wrc", A, mean, optimize=True)) ** 2, axis=0)
        lost = np.einsum("wp,bpq,wq->b", A, posterior, A)
        noise = (np.bincount(band.ravel(), left.ravel(), BANDS) / count / known.mean() + lost) / len(q)
        if k == ROUNDS - 1 or not known.all():
            values = idctn(mean, axes=(0, 1), norm="ortho")
        if not known.all():
            at = dctn(np.where(known, q, np.einsum("wp,rcp->wrc", A, values)), axes=(1, 2), norm="ortho")
    covariance = np.einsum("b,bpq->pq", count / band.size, posterior)
    return LocalField(POWERS, values.transpose(2, 0, 1), covariance, sizes=sizes, noise=noise)


def _rough(q: FloatArray, known: BoolArray) -> FloatArray:
    """Values (walls, rows, columns) less what the smooth field could follow, by least squares wall by wall."""
    rows, columns = q.shape[1:]
    y, x = (2 * (np.arange(n) + 0.5) / n - 1 for n in (rows, columns))
    T = terms(np.tile(x, (rows, 1)), np.tile(y[:, None], (1, columns)), depth_field.DEGREE)
    out = np.zeros_like(q)
    for wall, seen, rough in zip(q, known, out, strict=True):
        rough[seen] = wall[seen] - T[seen] @ np.linalg.lstsq(T[seen], wall[seen], rcond=None)[0]
    return out


def _bands(rows: int, columns: int) -> IntArray:
    frequency = np.hypot(*np.meshgrid(np.arange(rows) / rows, np.arange(columns) / columns, indexing="ij"))
    return np.minimum((frequency / frequency.max() * BANDS).astype(int), BANDS - 1)
