"""Boards of which the first are places on a spline, at the instants of their views."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.banded import BAND
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.spline import N_KNOTS, Place, Spline
from rgbd_calib.rig.blocks import Boards, Kind
from rgbd_calib.rig.motion.sight import DelayedLook, MovingSight
from rgbd_calib.rig.sight import Look

_NEAR_S = 0.004
"""For differences of the knots' shares over the rows of an image."""


@dataclass(frozen=True, kw_only=True)
class CarriedBoards(Boards):
    """Frames of one view each, at instants of colour and depth, then frames that stand."""

    spline: Spline
    color_s: FloatArray
    """(carried,)."""
    depth_s: FloatArray
    """(carried,)."""

    @classmethod
    def of(cls, spline: Spline, color_s: FloatArray, depth_s: FloatArray, T_standing: FloatArray) -> CarriedBoards:
        """With poses (still, 4, 4) of the frames that stand."""
        T = np.concatenate([spline.at(color_s).T, T_standing])
        none = np.zeros((len(T), 0, 3))
        return cls(T, np.zeros(len(T), bool), none, spline=spline, color_s=color_s, depth_s=depth_s)

    @property
    def size(self) -> int:
        return BAND

    @property
    def n_carried(self) -> int:
        return len(self.color_s)

    @cached_property
    def color(self) -> Place:
        return self.spline.at(self.color_s)

    @cached_property
    def depth(self) -> Place:
        return self.spline.at(self.depth_s)

    def after(self, step: FloatArray, color_s: FloatArray, depth_s: FloatArray) -> CarriedBoards:
        """After a step (windows + still, 24), at other instants."""
        n = self.spline.n_windows
        knots = np.concatenate([step[0].reshape(N_KNOTS, 6), step[1:n, -6:]])
        standing = se3.retract(self.T_parent_board[self.n_carried :], step[n:, :6])
        return CarriedBoards.of(self.spline.moved(knots), color_s, depth_s, standing)

    def derivative(self, look: Look) -> FloatArray:
        frame, n = look.sight.obs.frame, self.n_carried
        out = np.zeros((*look.left.shape, BAND))
        stands = frame >= n
        by_motion = look.by_motion
        out[stands, :, :, :6] = by_motion[stands]
        moving = np.flatnonzero(~stands)
        f = frame[moving]
        if isinstance(look, DelayedLook):
            out[moving] = look.motion_later[moving] @ self._of_depth[0][f, None]
            out[moving] += look.motion_seen[moving] @ self._of_depth[1][f, None]
            return out
        if look.kind is Kind.DEPTH:
            out[moving] = by_motion[moving] @ self._of_depth[0][f, None]
            return out
        out[moving] = by_motion[moving] @ self._of_color[0][f, None]
        sight = look.sight
        if isinstance(sight, MovingSight) and np.any(sight.after_s):
            after = sight.after_s[moving, :, None, None]
            for k, power in ((1, after), (2, 0.5 * after**2)):
                out[moving] += power * (by_motion[moving] @ self._of_color[k][f, None])
        return out

    @cached_property
    def _of_depth(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives (carried, 6, 24) of the poses at the instants of depth and of colour by the knots about the first."""
        return self.depth.by_knots(), self.spline.at(self.color_s, self.depth.window).by_knots()

    @cached_property
    def _of_color(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivative (carried, 6, 24) of the pose by the knots, and its first and second derivatives by time."""
        now = self.color
        before, after = (self.spline.at(self.color_s + dt, now.window).by_knots() for dt in (-_NEAR_S, _NEAR_S))
        own = now.by_knots()
        return own, (after - before) / (2 * _NEAR_S), (after - 2 * own + before) / _NEAR_S**2
