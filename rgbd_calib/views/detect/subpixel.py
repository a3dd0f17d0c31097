r"""Corners of a checkerboard to a few hundredths of a pixel, and which of them to leave out.

First the gradients: cv2.cornerSubPix, in a window as wide as the squares allow. Then a model of the brightness around a
corner c, fitted by least squares (Levenberg-Marquardt) to the pixels of half a square to each side:

    I(x) = [1 + g . (x - c)] [a + b erf(n1 . (x - c) / (sqrt(2) s)) erf(n2 . (x - c) / (sqrt(2) s))]

two edges through c with normals n1, n2, blurred by s, in a light that rises by g. It uses all pixels along the edges, not
only where both gradients are strong, and so has less than half the error of the gradients alone; both leave errors that
are independent from corner to corner, other than the finders, which move whole boards by up to 0.3 px.

Without g all corners would be drawn to the light together, and that is what moves a pose. Fitted at each corner, g would
cost precision, and take a lens's or a sensor's unevenness for light; the board as a whole tells it: g is the slope of its
white's logarithm over the image. What is left of the light is the lens's: blurring light that rises by g' moves the pattern
by -g' s^2 (the blur of x f is x times the blur of f plus s^2 times its slope), and a camera encodes light by its
1 / GAMMA-th power, so that g' = GAMMA g.

A corner is left out where this model does not explain the pixels (a finger, a highlight), or where it does not lie
with the others: corners of a plane are a homography of the grid, and lens and bow add a smooth part, here a cubic.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbd_calib.geometry.so3 import FloatArray

WINDOW_SQUARES = 0.5
"""Half a window's side over the smaller side of a square."""
MODEL_SQUARES = 0.45
"""The same for the model, along each side of the square on its own."""
WINDOW_MAX_PX = 10.0
"""Beyond it a lens bends the squares' sides: the errors grow again, and not independently."""
ROUNDS = 6
SETTLED_PX = 1e-3
"""A corner whose last step was shorter moves no more: the steps shrink by a factor of ten or more a round."""
N_PARAMETERS = 7
GAMMA = 2.2
"""Of the curve by which cameras encode light."""
MAX_MOVE_PX = 0.5
"""A corner that moved farther from its start had its pixels to one side, and is fitted again."""
MIN_EXPLAINED = 0.8
"""Share of the variance around a corner that the model must explain."""
GROSS_PX = 0.3
GROSS_SIGMAS = 6.0
GROSS_SQUARES = 0.08
"""A corner farther than all three, px, robust sigmas and sides of a square, from where the others have it is left out.
The last is for the lens: in the corners of an image, a cubic leaves 0.04 squares of its distortion."""


@dataclass(frozen=True)
class Surroundings:
    """How far from a corner of a board with markers there are two black and two white quadrants, in squares."""

    beside: float
    """To both sides of the edges that meet in the corner."""
    along: float = np.inf
    """Along these edges."""


def refine(
    gray: np.ndarray, grid: FloatArray, corners_px: FloatArray, clear: Surroundings | None = None
) -> tuple[FloatArray, np.ndarray]:
    """Corners (n, 2), px, refined, and which of them are good (n,).

    Parameters
    ----------
    gray : (h, w), uint8.
    grid : (n, 2), where each corner is on the board, in squares.
    corners_px : (n, 2), within a third of a square.
    clear : where markers are near, how far from them the corners are; None: a checkerboard.
    """
    sides = _sides(grid, corners_px)
    if sides is None:
        return corners_px, np.zeros(len(corners_px), bool)
    start = corners_px if clear is not None else _gradients(gray, corners_px, sides)
    start = np.where(
        np.linalg.norm(start - corners_px, axis=1, keepdims=True) < _shorter(sides)[:, None] / 2, start, corners_px
    )
    fitted, explained, light = fit_crossings(gray, start, sides, clear)
    gross, expected = outliers(grid, fitted, _shorter(sides), explained >= MIN_EXPLAINED)
    astray = np.linalg.norm(fitted - start, axis=1) > MAX_MOVE_PX
    again = np.flatnonzero(gross | astray | (explained < MIN_EXPLAINED))
    if len(again):  # a wrong start: look where the other corners have it
        fitted[again], explained[again], _ = fit_crossings(gray, expected[again], sides[again], clear, light)
        apart = np.asarray(cKDTree(fitted).query(fitted[again], 2)[0])[:, 1]
        explained[again[apart < _shorter(sides)[again] / 2]] = 0.0  # found another one of the corners
        gross, _ = outliers(grid, fitted, _shorter(sides), explained >= MIN_EXPLAINED)
    return fitted, (explained >= MIN_EXPLAINED) & ~gross


def fit_crossings(
    gray: np.ndarray,
    start_px: FloatArray,
    sides: FloatArray,
    clear: Surroundings | None = None,
    light: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corners (n, 2), px, of the model in the module's head, the share of the variance that it explains (n,), and g (2,).

    Parameters
    ----------
    start_px : (n, 2).
    sides : (n, 2, 2), px, the sides of a square at each corner: [:, 0] along the columns, [:, 1] along the rows.
    light : g (2,), 1/px, where other corners have told it.
    """
    origin = np.round(start_px).astype(int)
    dx, dy, value, weight = _windows(gray, start_px, origin, sides, clear)
    p = _first_guess(start_px - origin, sides, dx, dy, value, weight)
    light = _light(start_px, p) if light is None else light
    p, rest = _least_squares(p, light, dx, dy, value, weight)
    fitted = origin + p[:, :2] + GAMMA * light * np.exp(2 * np.median(p[:, 6].astype(float)))
    pixels = weight.sum(axis=1)
    middle = (value * weight).sum(axis=1) / np.maximum(pixels, 1)
    total = (((value - middle[:, None]) * weight) ** 2).sum(axis=1)
    explained = 1 - rest / np.maximum(total, 1e-9)
    moved = np.linalg.norm(fitted - start_px, axis=1)
    good = (moved < _shorter(sides) / 2) & (pixels > N_PARAMETERS)
    return fitted, np.where(good, explained, 0.0), light


def _least_squares(
    p: np.ndarray, light: FloatArray, dx: np.ndarray, dy: np.ndarray, value: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (n, 7) from a first guess `p`, and the sum of the squared residuals (n,) at them."""
    p, damping = p.copy(), np.full(len(p), 1e-3)
    brightness, jacobian = _crossing(p, light, dx, dy)
    residual = (value - brightness) * weight
    cost = np.einsum("nm,nm->n", residual, residual)
    gradient, normal = _normal_equations(jacobian, residual, weight)
    todo = np.arange(len(p))  # corners that still move
    for _ in range(ROUNDS):
        diagonal = np.einsum("nii->ni", normal[todo])
        damped = normal[todo] + np.einsum("ni,ij->nij", damping[todo, None] * diagonal + 1e-6, np.eye(N_PARAMETERS))
        trial = p[todo] + np.linalg.solve(damped, gradient[todo, :, None])[..., 0]
        trial[:, 6] = np.clip(trial[:, 6], *_LOG_BLUR)
        brightness, jacobian = _crossing(trial, light, dx[todo], dy[todo])
        residual = (value[todo] - brightness) * weight[todo]
        trial_cost = np.einsum("nm,nm->n", residual, residual)
        better = trial_cost <= cost[todo]
        moved = np.abs(trial[:, :2] - p[todo, :2]).max(axis=1)
        damping[todo] *= np.where(better, 0.1, 10.0)
        some = todo[better]
        p[some], cost[some] = trial[better], trial_cost[better]
        gradient[some], normal[some] = _normal_equations(jacobian[better], residual[better], weight[some])
        todo = todo[~better | (moved > SETTLED_PX)]
        if not len(todo):
            break
    return p, cost


def _normal_equations(jacobian: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (n, 7) and normal matrix (n, 7, 7) of residuals (n, m) with weights 0 or 1."""
    weighted = jacobian * weight[:, None]
    return (weighted @ residual[..., None])[..., 0], weighted @ weighted.transpose(0, 2, 1)


def _light(corners_px: FloatArray, p: np.ndarray) -> FloatArray:
    """g (2,), 1/px, from first guesses (n, 7): the slope of the logarithm of the board's white; corners that something
    covers do not count."""
    white = np.log(np.maximum(p[:, 4].astype(float) + np.abs(p[:, 5].astype(float)), 1.0))
    A = np.column_stack([corners_px - corners_px.mean(axis=0), np.ones(len(p))])
    off = np.abs(white - A @ np.linalg.lstsq(A, white, rcond=None)[0])
    kept = off <= 4 * np.median(off)
    return np.asarray(np.linalg.lstsq(A[kept], white[kept], rcond=None)[0][:2], float)


def outliers(
    grid: FloatArray, corners_px: FloatArray, sides_px: FloatArray, usable: np.ndarray
) -> tuple[np.ndarray, FloatArray]:
    """Which corners (n,) do not lie with the others, and where the others have each (n, 2), px.

    The worst is taken out and the rest fitted anew, until all that is left agrees. Its deviation counts by what it was
    before it drew the fit to itself. `sides_px` (n,) are the shorter sides of the squares, `usable` (n,) the corners to go by.
    """
    keep = usable.copy()
    while True:
        H, _ = cv2.findHomography(grid[keep], corners_px[keep]) if keep.sum() >= 5 else (None, None)
        if H is None:
            return usable & False, corners_px
        plane = cv2.perspectiveTransform(grid[:, None].astype(float), H)[:, 0]
        basis = _smooth(grid, int(keep.sum()))
        solve = np.linalg.pinv(basis[keep])
        expected = np.asarray(plane + basis @ (solve @ (corners_px - plane)[keep]), float)
        own = np.clip(1 - np.einsum("ij,ji->i", basis[keep], solve), 0.05, 1)
        off = np.linalg.norm(corners_px - expected, axis=1)[keep] / own
        sigma = float(np.median(off)) / 1.18  # the median of a Rayleigh distribution
        ratio = off / np.maximum(max(GROSS_PX, GROSS_SIGMAS * sigma), GROSS_SQUARES * sides_px[keep])
        if ratio.max() <= 1:
            return usable & ~keep, expected
        keep[np.flatnonzero(keep)[np.argmax(ratio)]] = False


_LOG_BLUR = np.log([0.3, 4.0])


def _smooth(grid: FloatArray, n: int) -> FloatArray:
    """Columns (n, k) of a polynomial in column and row: cubic, or of the degree that n corners can bear."""
    degree = next(d for d, terms in ((3, 10), (2, 6), (1, 3), (0, 1)) if 2 * terms <= n or d == 0)
    c, r = ((grid - grid.mean(axis=0)) / np.maximum(np.ptp(grid, axis=0), 1)).T
    return np.stack([c**i * r**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def _sides(grid: FloatArray, corners_px: FloatArray) -> FloatArray | None:
    """Sides (n, 2, 2), px, of a square at each corner, by the homography of the grid; None where there is none."""
    if len(grid) < 4 or np.linalg.matrix_rank(grid - grid.mean(axis=0)) < 2:
        return None
    H = robust_homography(grid, corners_px)
    if H is None:
        return None
    ahead = cv2.perspectiveTransform(np.stack([grid + [0.5, 0], grid + [0, 0.5]], axis=1).astype(float), H)
    behind = cv2.perspectiveTransform(np.stack([grid - [0.5, 0], grid - [0, 0.5]], axis=1).astype(float), H)
    return np.asarray(ahead - behind, float)


def robust_homography(grid: FloatArray, corners_px: FloatArray) -> FloatArray | None:
    """H (3, 3) that most of the corners (n, 2) agree on; of few, or of two rows, where OpenCV finds no subset, all of them."""
    for method in (cv2.LMEDS, 0) if len(grid) > 8 else (0,):
        H = cv2.findHomography(grid.astype(float), corners_px, method)[0]
        if H is not None:
            return np.asarray(H, float)
    return None


def _shorter(sides: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(sides, axis=2).min(axis=1), float)


def _gradients(gray: np.ndarray, corners_px: FloatArray, sides: FloatArray) -> FloatArray:
    """Corners (n, 2), px, by cv2.cornerSubPix."""
    reach = np.clip(np.round(WINDOW_SQUARES * _shorter(sides)), 2, WINDOW_MAX_PX).astype(int)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-2)
    out = corners_px.copy()
    for half in np.unique(reach):
        some = reach == half
        begin = np.ascontiguousarray(corners_px[some, None], np.float32)
        out[some] = cv2.cornerSubPix(gray, begin, (int(half), int(half)), (-1, -1), stop)[:, 0]
    return out


def _windows(
    gray: np.ndarray, start_px: FloatArray, origin: np.ndarray, sides: FloatArray, clear: Surroundings | None
) -> tuple[np.ndarray, ...]:
    """Pixels around corners (n, m), float32: offsets from `origin` along x and along y, brightness, and weight, which is 0
    where a corner has fewer than m."""
    lengths = np.linalg.norm(sides, axis=2)
    reach = np.maximum(np.minimum(MODEL_SQUARES, WINDOW_MAX_PX / lengths), 1.5 / lengths)
    half = int(np.ceil((np.abs(sides) * reach[..., None]).sum(axis=1).max())) + 1
    dy, dx = (g.ravel() for g in np.mgrid[-half : half + 1, -half : half + 1])
    u, v = origin[:, :1] + dx, origin[:, 1:] + dy
    inside = (u >= 0) & (u < gray.shape[1]) & (v >= 0) & (v < gray.shape[0])
    off = np.stack([dx, dy]) - (start_px - origin)[..., None]
    s, t = np.abs(np.linalg.inv(sides.transpose(0, 2, 1)) @ off).transpose(1, 0, 2)
    used = inside & (s <= reach[:, :1]) & (t <= reach[:, 1:])
    if clear is not None:
        room = np.maximum(clear.beside - 1.0 / lengths, 0.5 / lengths)  # a pixel for the blur of the marker's rim
        used &= (s <= room[:, :1]) | (t <= room[:, 1:])
        reach = np.maximum(clear.along - 1.0 / lengths, 1.5 / lengths)
        used &= (s <= reach[:, :1]) & (t <= reach[:, 1:])
    pixels = np.argsort(~used, axis=1, kind="stable")[:, : max(int(used.sum(axis=1).max()), 1)]
    dx, dy, weight = dx[pixels], dy[pixels], np.take_along_axis(used, pixels, axis=1)
    value = gray[np.clip(origin[:, 1:] + dy, 0, gray.shape[0] - 1), np.clip(origin[:, :1] + dx, 0, gray.shape[1] - 1)]
    return tuple(a.astype(np.float32) for a in (dx, dy, value, weight))


def _first_guess(
    centre: FloatArray, sides: FloatArray, dx: np.ndarray, dy: np.ndarray, value: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Parameters (n, 7): centre, directions of the two edges, a, b, log of the blur."""
    n = len(centre)
    a = (value * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    angles = np.arctan2(sides[..., 1], sides[..., 0])
    p = np.column_stack([centre, angles, a, np.ones(n), np.full(n, np.log(0.8))]).astype(np.float32)
    pattern = (_crossing(p, np.zeros(2), dx, dy)[0] - p[:, 4:5]) * weight
    p[:, 5] = ((value - a[:, None]) * pattern).sum(axis=1) / np.maximum((pattern**2).sum(axis=1), 1e-9)
    return p


def _crossing(p: np.ndarray, g: FloatArray, dx: np.ndarray, dy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness (n, m) of the model at pixels (n, m), and its derivatives by the parameters (n, 7, m)."""
    u, v, first, second, a, b, log_blur = (p[:, i, None] for i in range(N_PARAMETERS))
    gx, gy = (np.float32(rise) for rise in g)
    x, y, blur = dx - u, dy - v, np.exp(log_blur)
    c1, s1, c2, s2 = np.cos(first), np.sin(first), np.cos(second), np.sin(second)
    d1, d2 = (y * c1 - x * s1) / blur, (x * s2 - y * c2) / blur
    bell1, bell2 = np.exp(d1 * d1 * np.float32(-0.5)), np.exp(d2 * d2 * np.float32(-0.5))
    e1, e2 = _erf(d1, bell1), _erf(d2, bell2)
    light, e12 = 1 + gx * x + gy * y, e1 * e2
    board = a + b * e12
    steep = light * (b * _SLOPE / blur)
    f1, f2 = steep * bell1 * e2, steep * bell2 * e1
    jacobian = np.empty((len(p), N_PARAMETERS, x.shape[1]), np.float32)
    jacobian[:, 0] = f1 * s1 - f2 * s2 - board * gx
    jacobian[:, 1] = f2 * c2 - f1 * c1 - board * gy
    jacobian[:, 2] = -f1 * (x * c1 + y * s1)
    jacobian[:, 3] = f2 * (x * c2 + y * s2)
    jacobian[:, 4] = light
    jacobian[:, 5] = light * e12
    jacobian[:, 6] = -blur * (f1 * d1 + f2 * d2)
    return light * board, jacobian


_SLOPE = np.float32(np.sqrt(2 / np.pi))
_ERF = [np.float32(k) for k in (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)]


def _erf(d: np.ndarray, bell: np.ndarray) -> np.ndarray:
    """erf(d / sqrt(2)) where exp(-d^2 / 2) is `bell`, to 1.5e-7 (Abramowitz and Stegun, 7.1.26): seven times as fast as
    scipy.special.erf, which does not know the exponential."""
    t = 1 / (1 + np.float32(0.3275911 * np.sqrt(0.5)) * np.abs(d))
    total = _ERF[0] * t
    for k in _ERF[1:]:
        total += k
        total *= t
    return np.copysign(1 - total * bell, d)
