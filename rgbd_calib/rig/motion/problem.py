"""The bundle's problem with a carried board: the units are windows of its spline, and time is among the unknowns.

The motion's prior is white jerk: the third differences of the knots are independent, N(0, s^2), with one s for turns and one
for shifts, both variance components. It holds the knots where no view does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.banded import BandedEquations
from rgbd_calib.geometry.linear import Covariance, IntArray, NormalEquations, Pattern
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import Kind, Scope
from rgbd_calib.rig.motion.boards import CarriedBoards
from rgbd_calib.rig.motion.setup import MotionSetup
from rgbd_calib.rig.motion.sight import MovingSight, look_at_delayed_depth
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.sight import Look, Sight

USUAL_JERK = (60.0, 30.0)
"""rad/s^3 and m/s^3, RMS over a piece: where the estimate of its size starts."""
JERK_DOF = 4.0
INSTANT_S = 0.25
"""Views of two cameras within this tie them to each other: the motion's prior bridges it."""


@dataclass(frozen=True)
class MotionProblem(Problem):
    """All carried views are shared, and posed in the world."""

    jerk: tuple[float, float] = USUAL_JERK
    """Size of the jerk of turns (rad/s^3) and shifts (m/s^3)."""
    reads_faces: ClassVar[bool] = False

    @property
    def own(self) -> MotionSetup:
        assert isinstance(self.setup, MotionSetup)
        return self.setup

    @property
    def n_board_units(self) -> int:
        return self.own.n_windows + self.setup.obs.n_frames - self.own.n_carried

    def units_of(self, state: State, look: Look) -> IntArray:
        boards, frame = _carried(state), look.sight.obs.frame
        place = boards.depth if look.kind is Kind.DEPTH else boards.color
        stands = self.own.n_windows + frame - self.own.n_carried
        return np.where(
            frame < self.own.n_carried, np.append(place.window, 0)[np.minimum(frame, self.own.n_carried)], stands
        )

    def instants(self) -> IntArray:
        times = np.floor(self.own.times_s(*self._clocks(None))[0] / INSTANT_S).astype(int)
        still = times.max() + 1 + np.arange(self.setup.obs.n_frames - self.own.n_carried)
        return np.concatenate([times, still])[self.obs.frame]

    def _clocks(self, state: State | None) -> tuple[FloatArray, FloatArray]:
        """Clocks (C, 2) and delays (C, 1) of a state, or where the estimate starts."""
        values = (
            {name: self.block(name).start() for name in ("clock", "depth delay")} if state is None else state.values
        )
        return values["clock"], values["depth delay"]

    def moved(self, state: State, step: FloatArray, unit_step: FloatArray) -> State:
        values = {b.name: b.moved(state.values[b.name], step[self.parts[b.name]]) for b in self.blocks}
        times = self.own.times_s(values["clock"], values["depth delay"])
        boards = _carried(state).after(unit_step[: self.n_board_units], *times)
        return State(values, boards, state.walls.moved(unit_step[self.n_board_units :]))

    # ------------------------------------------------------------------------------------------------ prediction

    def sights(
        self, state: State, views: IntArray | None = None, obs: Observations | None = None
    ) -> Iterator[tuple[IntArray, Sight]]:
        """As for any bundle, each corner at the instant of its own row."""
        for some, sight in super().sights(state, views, obs):
            yield some, self._rolled(state, sight)

    def _rolled(self, state: State, sight: Sight) -> MovingSight:
        boards, frame = _carried(state), sight.obs.frame
        moves = frame < boards.n_carried
        f, c = np.minimum(frame, boards.n_carried - 1), sight.camera
        place = boards.color
        height = self.setup.priors[c].intrinsics.height
        row = ((sight.obs.pixels_px[..., 1] + 0.5) / height - 0.5) * sight.obs.has_pixel * moves[:, None]
        after = state.values["readout"][c, 0] * row
        arm = sight.p_parent - place.c_m[f, None]
        omega, alpha = place.omega[f, None], place.alpha[f, None]
        velocity = np.cross(omega, arm) + place.velocity[f, None]
        change = np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm)) + place.acceleration[f, None]
        shift = after[..., None] * velocity + 0.5 * after[..., None] ** 2 * change
        velocity = (velocity + after[..., None] * change) * moves[:, None, None]
        return self._moving(
            sight, shift, velocity, place.omega[f] * moves[:, None], sight.R_parent_board, row, after, boards
        )

    def _moving(
        self,
        sight: Sight,
        shift: FloatArray,
        velocity: FloatArray,
        omega: FloatArray,
        R_parent_board: FloatArray,
        row: FloatArray,
        after: FloatArray,
        boards: CarriedBoards,
    ) -> MovingSight:
        own, frame = self.own, sight.obs.frame
        stamps = np.append(own.color_s, 0.0)[np.minimum(frame, own.n_carried)]
        age = np.where(frame < own.n_carried, stamps - own.first_s[sight.camera], 0.0)
        return MovingSight(
            sight.camera,
            sight.obs,
            R_parent_board,
            sight.freed,
            sight.p_parent + shift,
            sight.R_color_parent,
            sight.p_color + shift @ sight.R_color_parent.transpose(0, 2, 1),
            velocity=velocity,
            omega=omega,
            age_s=age,
            row=row,
            after_s=after,
            mid=sight,
        )

    def look_at_depth(self, state: State, sight: Sight) -> Look:
        """At the instant of the depth image."""
        assert isinstance(sight, MovingSight)
        boards, seen, mid = _carried(state), sight, sight.mid
        f, moves = np.minimum(mid.obs.frame, boards.n_carried - 1), mid.obs.frame < boards.n_carried
        place = boards.depth
        D = place.T[f] @ se3.inverse(boards.T_parent_board[f])
        D = np.where(moves[:, None, None], D, np.eye(4))
        p = mid.p_parent @ D[:, :3, :3].transpose(0, 2, 1) + D[:, None, :3, 3]
        velocity = np.cross(place.omega[f, None], p - place.c_m[f, None]) + place.velocity[f, None]
        none = np.zeros(mid.obs.has_depth.shape)
        later = self._moving(
            mid,
            p - mid.p_parent,
            velocity * moves[:, None, None],
            place.omega[f] * moves[:, None],
            D[:, :3, :3] @ mid.R_parent_board,
            none,
            none,
            boards,
        )
        return super().look_at_depth(state, replace(later, mid=seen))

    depth_rows = staticmethod(look_at_delayed_depth)

    # ------------------------------------------------------------------------------------------------ equations

    @cached_property
    def pattern(self) -> Pattern:
        """Windows may touch all cameras; which, changes with the clocks."""
        own, cameras = self.own, range(len(self.setup.cameras))
        of_rig = [self.index(b.name) for b in self.blocks if b.scope is Scope.RIG]
        of_camera = [self.of_camera(c) for c in cameras]
        still: list[set[int]] = [set() for _ in range(self.setup.obs.n_frames - own.n_carried)]
        for f, c in zip(self.setup.obs.frame, self.setup.obs.camera, strict=True):
            if f >= own.n_carried:
                still[f - own.n_carried].add(int(c))
        keys: list[tuple[int, ...]] = [tuple(cameras)] * own.n_windows
        keys += [tuple(sorted(seen)) for seen in still] + [(-1, int(c)) for c in own.walls.camera]
        columns = {
            key: np.sort(np.concatenate([*of_rig, *(of_camera[c] for c in key)])) for key in set(keys) if -1 not in key
        }
        columns |= {key: np.sort(of_camera[key[1]]) for key in set(keys) if -1 in key}
        return Pattern.of(keys, columns, self.n_globals, self.unit_size)

    def eliminable(self, data: NormalEquations, state: State, weight: float = 1.0) -> NormalEquations:
        """With the motion's prior, which holds windows that no view touches."""
        own, n = data.regular(), self.own.n_windows
        r, J = _carried(state).spline.jerks()
        w = np.sqrt(weight) / self.jerk_scale()
        J, r = J * w[:, None], r * w
        V, h = own.V.copy(), own.unit_gradient.copy()
        V[:n] = data.V[:n] + J.transpose(0, 2, 1) @ J
        h[:n] += np.einsum("wij,wi->wj", J, r)
        return BandedEquations(own.pattern, own.U, own.W, V, own.gradient, h, own.curvature, n)

    def jerk_scale(self) -> FloatArray:
        """(6,), deviations of the third differences of the knots."""
        return np.repeat(self.jerk, 3) * self._step_s**3

    def cost(self, state: State) -> float:
        r = _carried(state).spline.jerks()[0] / self.jerk_scale()
        return super().cost(state) + 0.5 * float(np.sum(r**2))

    def tuned(self, state: State, covariance: Covariance) -> tuple[Problem, float]:
        """With the sizes of the jerk that the motion has: variance components, as for the blocks."""
        r, J = _carried(state).spline.jerks()
        C = covariance.of_units[: self.own.n_windows]
        absorbed = np.einsum("wij,wjk,wik->wi", J, C, J)  # posterior variance of the differences
        scale2, sizes = self.jerk_scale() ** 2, []
        for k, usual in enumerate(USUAL_JERK):
            part = slice(3 * k, 3 * k + 3)
            told = max(r[:, part].size - float(np.sum(absorbed[:, part] / scale2[part])), 0.0)
            squares = JERK_DOF * (usual * self._step_s**3) ** 2 + float(np.sum(r[:, part] ** 2))
            sizes.append(float(np.sqrt(squares / (JERK_DOF + told))) / self._step_s**3)
        change = max(abs(float(np.log(new / old))) for new, old in zip(sizes, self.jerk, strict=True))
        return replace(self, jerk=(sizes[0], sizes[1])), 0.1 * change

    @property
    def _step_s(self) -> float:
        return self.own.step_s


def _carried(state: State) -> CarriedBoards:
    assert isinstance(state.boards, CarriedBoards)
    return state.boards
