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
ROUNDS = 2000
"""Of expectation and maximisation, at most."""
TOLERANCE = 1e-7
"""Change of the sizes, of the largest, that ends them: they shrink by a few per cent a round."""
UNSEEN = 1e-6
"""The same of the pattern's variance over the noise's in a wall: where there is no pattern, sizes shrink for ever."""
FILLINGS = 8
"""Rounds in which cells that were not seen take what the pattern has there."""


@dataclass(frozen=True, kw_only=True)
class LocalField(CellPattern):
    """A pattern, and where its estimate stands: from there the next one goes on, since small sizes take many rounds."""

    sizes: FloatArray
    """(bands, powers, powers), covariance of the pattern's spectrum."""
    noise: FloatArray
    """(bands,), variance of the spectrum of one wall's error over z^2, the mean over the walls."""
    of_wall: FloatArray
    """(walls,), each wall's over the mean: depth in whole units is noisier near the camera."""

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
    count = np.bincount(band.ravel(), minlength=BANDS)
    noise = np.full(BANDS, float(np.mean(q[known] ** 2)))
    sizes = np.eye(len(POWERS)) * noise[:, None, None]
    if start is not None:
        sizes, noise = start.sizes, start.noise
    of_wall = np.ones(len(q)) if start is None or len(start.of_wall) != len(q) else start.of_wall
    filled = q
    for _ in range(1 if known.all() else FILLINGS):
        at = dctn(filled, axes=(1, 2), norm="ortho")
        sizes, noise, of_wall, posterior = _spectra(at, A, band, (sizes, noise, of_wall), float(known.mean()))
        gain = posterior @ A.T / (noise[:, None, None] * of_wall)
        mean = np.einsum("rcpw,wrc->rcp", gain[band], at, optimize=True)
        values = idctn(mean, axes=(0, 1), norm="ortho")
        filled = np.where(known, q, np.einsum("wp,rcp->wrc", A, values))
    covariance = np.einsum("b,bpq->pq", count / band.size, posterior)
    return LocalField(POWERS, values.transpose(2, 0, 1), covariance, sizes=sizes, noise=noise, of_wall=of_wall)


def _spectra(
    at: FloatArray, A: FloatArray, band: IntArray, start: tuple[FloatArray, FloatArray, FloatArray], share_known: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of spectra (walls, rows, columns), by expectation and maximisation from `start`: the covariance of the pattern's
    (bands, powers, powers), the variance of the noise's (bands,) with a factor for each wall (walls,), and the covariance
    of the pattern given the data, (bands, powers, powers).

    Before the data, all sizes of the pattern are as likely as in Jeffreys' prior of a covariance: few frequencies that agree
    by chance are no pattern. The data tell by the mean products of the walls alone, so that many rounds cost nothing: sizes
    that are truly zero are approached slowly.
    """
    flat, (sizes, noise, of_wall) = at.reshape(len(at), -1), start
    members = [np.flatnonzero(band.ravel() == b) for b in range(BANDS)]
    products = np.stack([flat[:, own] @ flat[:, own].T / len(own) for own in members])
    count = np.array([len(own) for own in members])
    share, shrunk = count / band.size, count / (count + len(sizes[0]) + 1)
    for _ in range(ROUNDS):
        carried = sizes @ A.T  # (bands, powers, walls)
        own = noise[:, None] * of_wall
        last = sizes
        gain = carried @ np.linalg.inv(A @ carried + own[:, :, None] * np.eye(len(A)))
        posterior, off = sizes - gain @ A @ sizes, np.eye(len(A)) - A @ gain
        left = np.sum((off @ products) * off, axis=2) / share_known + np.sum((A @ posterior) * A, axis=2)
        sizes = shrunk[:, None, None] * (gain @ products @ gain.transpose(0, 2, 1) + posterior)
        noise = np.mean(left / of_wall, axis=1)
        of_wall = share @ (left / noise[:, None])
        of_wall /= of_wall.mean()
        change = np.abs(sizes - last)
        signal = np.sum((A @ change) * np.abs(A), axis=2) / noise[:, None]  # of each band in each wall
        if change.max() < TOLERANCE * np.abs(sizes).max() or signal.max() < UNSEEN:
            break
    return sizes, noise, of_wall, posterior


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
