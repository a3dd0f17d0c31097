"""How a person carries the board: walked and swung through the volume, stopped, turned, with the bounce of steps and tremor.

The board's middle and three angles are sums of sinusoids of a progress phi(t), whose rate falls to zero in the stops; bounce
and tremor are sinusoids of time. Frequencies end at 6 Hz: the motion is band-limited, smooth, and known at every instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board

MotionKind = Literal["hand", "still", "line"]

_PATH_HZ, _STEPS_HZ, _TREMOR_HZ = (0.08, 0.45), (1.5, 2.2), (3.0, 6.0)
_SWEEP_HZ = np.array([[0.12, 0.07, 0.045, 0.10, 0.10, 0.10], [0.15, 0.09, 0.055, 0.20, 0.20, 0.20]])[..., None]
_SWEEP_RMS = np.array([0.55, 0.38, 0.50, 0.30, 0.30, 0.20])
"""As the guide asks: near and far, tilted, and to the borders of the images, since depth is not known where no board was. One
sinusoid each, which dwells at its ends: slowly away and back, faster up and down, fastest across. Metres along the board's
resting axes (across, down, away), then rad about them."""
_PATH_RMS_M, _PATH_RMS_RAD = np.array([0.12, 0.10, 0.10]), np.array([0.20, 0.20, 0.20])
"""Of what the hand does about the sweep."""
_STEPS_RMS = np.array([4e-3, 6e-3, 4e-3, 6e-3, 6e-3, 6e-3])
_TREMOR_RMS = np.array([3e-4, 3e-4, 3e-4, 1.5e-3, 1.5e-3, 1.5e-3])
"""Metres, then rad."""
_N_WAVES = 4
_STOP_EVERY_S, _STOP_S, _STOP_EDGE_S = (4.0, 8.0), (0.4, 1.2), 0.5
_GRID_S = 0.02
_SWING_SHARE = 0.3
"""RMS of the yaw that shows the board to the cameras in turn, as a share of the angle that they span."""
_RING_SPAN_RAD = np.radians(200.0)
"""Cameras that span more stand all round: the board turns on and on."""
_TURN_S = 12.0
_LINE_RMS_M, _LINE_HZ = 0.15, (0.2, 0.5)
_TARGET_AHEAD_M = 2.2
"""Of cameras whose axes are parallel."""


@dataclass(frozen=True)
class HandMotion:
    """A drawn motion; poses are in the frame of the camera poses that it was drawn for."""

    T_home: FloatArray
    """(4, 4), the resting pose of the board about its middle."""
    middle_m: FloatArray
    """(3,), of the board, in its frame."""
    progress: CubicSpline
    """phi(t), s."""
    yaw_rate: float
    """Constant turn about the vertical, rad per second of progress."""
    amplitudes: FloatArray
    """(6, n): middle (m), angles (rad)."""
    frequencies_hz: FloatArray
    """(6, n)."""
    phases: FloatArray
    """(6, n)."""
    of_progress: NDArray[np.bool_]
    """(n,) bool: the wave is a function of the progress, not of time."""

    def poses(self, t_s: FloatArray) -> FloatArray:
        """T_parent_board (n, 4, 4) at times (n,), s."""
        t_s = np.asarray(t_s, float)
        phi = self.progress(t_s)
        clock = np.where(self.of_progress, phi[:, None], t_s[:, None])  # (n, waves)
        angle = 2 * np.pi * self.frequencies_hz * clock[:, None] + self.phases
        x = np.sum(self.amplitudes * np.sin(angle), axis=-1)
        yaw = np.zeros((len(t_s), 3))
        yaw[:, 1] = self.yaw_rate * phi
        R = so3.exp(yaw) @ so3.exp(x[:, 3:])
        T_home_board = se3.make(R, x[:, :3] - R @ self.middle_m)
        return np.asarray(self.T_home @ T_home_board)


def hand_motion(
    T_parent_color: Sequence[FloatArray],
    board: Board,
    seconds: float,
    rng: np.random.Generator,
    kind: MotionKind = "hand",
) -> HandMotion:
    """Draw a motion before cameras at these poses (4, 4); `still` stays, `line` moves to and fro along one axis."""
    T_home, span = _home(np.stack(T_parent_color))
    ring = span > _RING_SPAN_RAD
    path = np.concatenate([_PATH_RMS_M, _PATH_RMS_RAD])
    path[4] = max(path[4], 0.0 if ring else _SWING_SHARE * span)
    amplitude, frequency, _ = _waves(_SWEEP_RMS, _SWEEP_HZ, rng, 1)
    sweep = amplitude, frequency, np.pi * rng.integers(0, 2, (6, 1))  # from the middle
    parts = [sweep, _waves(path, _PATH_HZ, rng)]
    n_path = 1 + _N_WAVES
    parts += [_waves(_STEPS_RMS, _STEPS_HZ, rng), _waves(_TREMOR_RMS, _TREMOR_HZ, rng)]
    if kind == "still":
        parts = [_waves(np.zeros(6), _PATH_HZ, rng)]
    if kind == "line":
        parts = [_waves(np.array([_LINE_RMS_M, 0, 0, 0, 0, 0]), _LINE_HZ, rng)]
    amplitudes, frequencies, phases = (np.concatenate([p[k] for p in parts], axis=1) for k in range(3))
    of_progress = np.arange(amplitudes.shape[1]) < n_path
    yaw_rate = 2 * np.pi / _TURN_S if ring and kind == "hand" else 0.0
    middle = board.corners_m().mean(axis=0) * [1, 1, 0]
    progress = _progress(seconds, rng)
    return HandMotion(T_home, middle, progress, yaw_rate, amplitudes, frequencies, phases, of_progress)


def _waves(
    rms: FloatArray, band_hz: tuple[float, float] | FloatArray, rng: np.random.Generator, n: int = _N_WAVES
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Amplitudes, frequencies and phases (6, waves): slower waves are larger."""
    frequencies = np.sort(rng.uniform(np.asarray(band_hz[0]), np.asarray(band_hz[1]), (6, n)), axis=1)
    share = 1 / frequencies
    share /= np.linalg.norm(share, axis=1, keepdims=True)
    return np.sqrt(2) * rms[:, None] * share, frequencies, rng.uniform(0, 2 * np.pi, (6, n))


def _progress(seconds: float, rng: np.random.Generator) -> CubicSpline:
    """phi(t) from one second before the start to one after the end: its rate is 1, and 0 in the stops."""
    t = np.arange(-1.0, seconds + 1.0, _GRID_S)
    rate, at = np.ones_like(t), rng.uniform(1.0, _STOP_EVERY_S[1])
    while at < seconds:
        half = rng.uniform(*_STOP_S) / 2
        away = np.clip((np.abs(t - at) - half) / _STOP_EDGE_S, 0.0, 1.0)
        rate *= 0.5 - 0.5 * np.cos(np.pi * away)
        at += rng.uniform(*_STOP_EVERY_S)
    return CubicSpline(t, np.cumsum(rate) * _GRID_S)


def _home(T_parent_color: FloatArray) -> tuple[FloatArray, float]:
    """The resting pose (4, 4), where the cameras look and turned to them, and the angle that they span, rad."""
    eyes, axes = T_parent_color[:, :3, 3], T_parent_color[:, :3, 2]
    off = np.eye(3) - axes[:, :, None] * axes[:, None]
    A, b = off.sum(axis=0), np.einsum("nij,nj->i", off, eyes)
    ahead = eyes.mean(axis=0) + _TARGET_AHEAD_M * axes.mean(axis=0)
    weak = 1e-3  # parallel axes meet nowhere
    target = np.linalg.solve(A + weak * np.eye(3), b + weak * ahead)
    down = T_parent_color[:, :3, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    toward = eyes - target
    flat = toward - np.outer(toward @ down, down)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    mean = flat.mean(axis=0) if np.linalg.norm(flat.mean(axis=0)) > 0.1 else flat[0]
    mean /= np.linalg.norm(mean)
    bearing = np.sort(np.arctan2(np.cross(mean, flat) @ down, flat @ mean))
    gaps = np.diff(np.append(bearing, bearing[0] + 2 * np.pi))
    facing = toward.mean(axis=0)
    z = -facing / np.linalg.norm(facing) if np.linalg.norm(facing) > 0.5 else -mean
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    return se3.make(np.stack([x, np.cross(z, x), z], axis=1), target), float(2 * np.pi - gaps.max())
