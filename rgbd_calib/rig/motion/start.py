"""Where the clocks' estimate starts: the offset at which two cameras see the board turn alike.

How fast a rigid board turns is the same for every camera, wherever that stands. So the speeds of rotation, from the board's
poses in each camera alone, are correlated over all offsets of two cameras' stamps (normalised over what both have, with gaps:
D. Padfield, IEEE TIP 21(5), 2012); the offset of the largest correlation is right to some milliseconds. Where the board stands
still, or moves along an axis without turning, no offset stands out, and the clocks cannot be told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.so3 import FloatArray

GRID_S = 0.01
SPAN_S = 0.12
"""Over which a turn is measured: long enough to stand out from the poses' noise, short against the motion."""
LONGEST_GAP_S = 0.3
LEAST_OVERLAP_S = 2.0
LEAST_SHARE = 0.25
"""Of the shorter track, that both must have at an offset: a few seconds agree by chance."""
RIVAL_S = 0.5
"""Offsets nearer to the best one are not rivals: the motion is smooth."""
LEAST_CORRELATION = 0.6
LEAST_LEAD = 3.0
"""By how many deviations of Fisher's z the best correlation must be farther from chance than any rival."""
INDEPENDENT_S = 0.4
"""Between values of a hand's speed that are independent."""


@dataclass(frozen=True)
class Track:
    """How one camera sees the board turn."""

    t_s: FloatArray
    """(n,), stamps, ascending."""
    R_color_face: FloatArray
    """(n, 3, 3)."""


@dataclass(frozen=True)
class Lag:
    """Stamps of b plus `offset_s` are on a's clock."""

    offset_s: float
    correlation: float
    lead: float
    """By how many deviations of Fisher's z it is farther from chance than the next rival."""

    @property
    def told(self) -> bool:
        return self.correlation > LEAST_CORRELATION and self.lead > LEAST_LEAD


def first_offsets(tracks: Mapping[str, Track], reference: str, moves: Sequence[FloatArray]) -> dict[str, float]:
    """Offset (s) of each camera's stamps to the reference's clock.

    Parameters
    ----------
    moves : motions (4, 4) between the readings that a face allows; see :meth:`rgbd_calib.types.Board.T_face_board`.

    Raises
    ------
    CalibrationError
        No offset stands out for a camera: the clocks cannot be told.
    """
    signals = {c: _signal(track, moves) for c, track in tracks.items()}
    lags = {(a, b): _lag(signals[a], signals[b]) for a, b in combinations(tracks, 2)}
    placed = {reference: 0.0}
    while len(placed) < len(tracks):
        options = [
            (lag.lead, pair) for pair, lag in lags.items() if lag.told and (pair[0] in placed) != (pair[1] in placed)
        ]
        if not options:
            raise CalibrationError(_untold([c for c in tracks if c not in placed], lags))
        a, b = max(options)[1]
        if a in placed:
            placed[b] = placed[a] + lags[a, b].offset_s
        else:
            placed[a] = placed[b] - lags[a, b].offset_s
    return placed


def speeds(track: Track, moves: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Middle times (m,), s, and speeds of rotation (m,), rad/s; readings of a face may change from view to view."""
    t, R = track.t_s, track.R_color_face
    later = np.searchsorted(t, t + 0.75 * SPAN_S)
    first = np.flatnonzero(later < len(t))
    later = later[first]
    near = t[later] - t[first] < 2 * SPAN_S
    first, later = first[near], later[near]
    readings = [so3.angle_rad(R[first].transpose(0, 2, 1) @ R[later] @ G[:3, :3]) for G in moves]
    angle = np.min(readings, axis=0)
    return (t[first] + t[later]) / 2, angle / (t[later] - t[first])


@dataclass(frozen=True)
class _Signal:
    start_s: float
    values: FloatArray
    known: FloatArray
    """1 or 0."""


def _signal(track: Track, moves: Sequence[FloatArray]) -> _Signal:
    """Speeds on a grid, with what is known of it."""
    t, speed = speeds(track, moves)
    if len(t) < 2:
        return _Signal(0.0, np.zeros(1), np.zeros(1))
    grid = np.arange(t[0], t[-1], GRID_S)
    after = np.clip(np.searchsorted(t, grid, side="right"), 1, len(t) - 1)
    known = (t[after] - t[after - 1] < LONGEST_GAP_S).astype(float)
    values = np.interp(grid, t, speed) * known
    return _Signal(float(t[0]), values, known)


def _lag(a: _Signal, b: _Signal) -> Lag:
    """The offset of b's stamps to a's clock at which the speeds agree best."""
    from scipy.signal import fftconvolve

    def over(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(fftconvolve(x, y[::-1]))

    mean = (a.values.sum() + b.values.sum()) / max(a.known.sum() + b.known.sum(), 1.0)
    f, g = (a.values - mean) * a.known, (b.values - mean) * b.known  # small numbers, for the FFT's sake
    n = over(a.known, b.known)
    least = max(LEAST_OVERLAP_S, LEAST_SHARE * GRID_S * min(a.known.sum(), b.known.sum())) / GRID_S
    enough = n >= least
    if not enough.any():
        return Lag(0.0, 0.0, 0.0)
    n = np.maximum(n, 1.0)
    sum_f, sum_g = over(f, b.known), over(a.known, g)
    var_f, var_g = over(f**2, b.known) - sum_f**2 / n, over(a.known, g**2) - sum_g**2 / n
    r = (over(f, g) - sum_f * sum_g / n) / np.sqrt(np.maximum(var_f * var_g, 1e-12 * np.max(var_f * var_g)))
    r = np.where(enough, np.clip(r, -0.9999, 0.9999), 0.0)
    offsets = a.start_s - b.start_s + GRID_S * (np.arange(len(r)) - (len(g) - 1))
    deviations = np.arctanh(r) * np.sqrt(np.maximum(n * GRID_S / INDEPENDENT_S - 3, 1.0))  # R. Fisher, 1921
    best = int(np.argmax(deviations))
    rivals = enough & (np.abs(offsets - offsets[best]) > RIVAL_S)
    lead = float(deviations[best] - np.max(deviations[rivals], initial=0.0))
    between = 0.0
    if 0 < best < len(r) - 1 and enough[best - 1] and enough[best + 1]:
        curve = r[best - 1] - 2 * r[best] + r[best + 1]
        between = 0.5 * (r[best - 1] - r[best + 1]) / curve if curve < 0 else 0.0
    return Lag(float(offsets[best] + GRID_S * between), float(r[best]), lead)


def _untold(lost: Sequence[str], lags: Mapping[tuple[str, str], Lag]) -> str:
    best = max((lag for pair, lag in lags.items() if set(pair) & set(lost)), key=lambda lag: lag.correlation)
    return (
        f"{', '.join(lost)}: clocks cannot be determined: the board must be seen turning by two cameras at a time, more than "
        f"{LEAST_CORRELATION:g} of correlation of its speed of rotation, clearly at one offset, needed; {best.correlation:.2f} "
        f"found, {best.lead:.1f} deviations above any other offset ({LEAST_LEAD:g} needed). Either the board stood still, moved "
        "along one axis without turning, or was not seen by both. Turn it about all axes while you carry it, with stops"
    )
