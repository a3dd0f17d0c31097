"""The least-squares problem of the rig: observations, blocks of unknowns, weights and priors, as one object.

It predicts, and it linearises: the weighted rows of some views after the other, so that memory does not grow with the
recording. It alone knows which column is which.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import BoolArray, IntArray, NormalEquations, Pattern, Rows, assemble
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig import terms
from rgbd_calib.rig.blocks import ESTIMATED, Block, Boards, BoardShapeBlock, DepthErrorBlock, Kind, PointBlock
from rgbd_calib.rig.blocks.board_shape import nominal_corners_m
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.setup import Setup
from rgbd_calib.rig.sight import Look, Sight
from rgbd_calib.rig.weights import Weights

VIEWS_AT_ONCE = 256
"""Views whose derivatives are in memory together: some 10 MB."""
KINDS = (Kind.PIXEL, Kind.DEPTH)


@dataclass(frozen=True)
class State:
    """Values of all unknowns."""

    values: Mapping[str, FloatArray]
    """By block, as the block has them."""
    boards: Boards

    @property
    def T_world_color(self) -> FloatArray:
        """(C, 4, 4)."""
        return self.values["pose"]

    @property
    def intrinsics(self) -> FloatArray:
        """(C, 4 + the longest lens)."""
        return self.values["intrinsics"]


@dataclass(frozen=True)
class Prior:
    """Gaussian knowledge of the globals, and which of them are free."""

    mean: FloatArray
    """(P,), values of the parameters that have any; poses have none."""
    information: FloatArray
    """(P, P), inverse covariance."""
    free: BoolArray
    """(P,) bool."""
    assumed: BoolArray
    """(P,) bool: the knowledge is an assumption, not a measurement; where the recording adds none, it is said."""


@dataclass(frozen=True)
class Problem:
    """What is solved; all views of `setup`, of which the masks of `obs` say what is used."""

    setup: Setup
    blocks: tuple[Block, ...]
    obs: Observations
    weights: Weights
    held: BoolArray
    """(P,) bool: what the recording does not determine, held at its prior."""
    unit_size: int = 6

    @classmethod
    def of(cls, setup: Setup, blocks: Sequence[type[Block]] = ESTIMATED) -> Problem:
        made = tuple(block(setup) for block in blocks)
        weights = Weights.first(setup.obs, len(setup.cameras), setup.params)
        return cls(setup, made, setup.obs, weights, np.zeros(sum(b.size for b in made), bool))

    # ------------------------------------------------------------------------------------------------ parameters

    @property
    def n_globals(self) -> int:
        return len(self.held)

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Where each block's parameters stand among the globals."""
        stops = np.cumsum([b.size for b in self.blocks])
        return {b.name: slice(int(s) - b.size, int(s)) for b, s in zip(self.blocks, stops, strict=True)}

    def block(self, name: str) -> Block:
        return next(b for b in self.blocks if b.name == name)

    def index(self, name: str, camera: int | None = None) -> IntArray:
        """Globals of a block, or of its set for one camera."""
        part, block = self.parts[name], self.block(name)
        if camera is None:
            return np.arange(part.start, part.stop)
        return part.start + block.columns(camera)

    def of_camera(self, camera: int) -> IntArray:
        """Globals that are this camera's alone, block by block."""
        own = [self.index(b.name, camera) for b in self.blocks if b.scope.value == "camera"]
        return np.concatenate(own)

    @cached_property
    def prior(self) -> Prior:
        P = self.n_globals
        mean, information = np.zeros(P), np.zeros((P, P))
        free, assumed = np.zeros(P, bool), np.zeros(P, bool)
        for block in self.blocks:
            at, own = self.parts[block.name], block.prior()
            mean[at], free[at], assumed[at] = own.mean, own.free, own.assumed
            information[at, at] = own.information
        return Prior(mean, information, free, assumed)

    @cached_property
    def free(self) -> BoolArray:
        """(P,) bool."""
        return self.prior.free & ~self.held

    def start(self, boards: Boards) -> State:
        return State({b.name: b.start() for b in self.blocks}, boards)

    def moved(self, state: State, step: FloatArray, unit_step: FloatArray) -> State:
        """The state after a step of the globals (P,) and of the units (F, D)."""
        values = {b.name: b.moved(state.values[b.name], step[self.parts[b.name]]) for b in self.blocks}
        return State(values, state.boards.moved(unit_step))

    def vector(self, state: State) -> FloatArray:
        """(P,), with zeros for the poses, to compare with the prior's mean."""
        return np.concatenate([b.vector(state.values[b.name]) for b in self.blocks])

    def at_prior(self, state: State, which: BoolArray) -> State:
        """The state with these globals (P,) at their prior's mean."""
        step = np.where(which, self.prior.mean - self.vector(state), 0.0)
        return self.moved(state, step, np.zeros((len(state.boards.freed), state.boards.size)))

    # ------------------------------------------------------------------------------------------------ prediction

    def board_corners_m(self, state: State) -> FloatArray:
        """(2, M, 3): the front's corners and those behind them, in the board's frame, as the state has them."""
        out = nominal_corners_m(self.setup.board)
        for block in self.blocks:
            if isinstance(block, BoardShapeBlock):
                out = out + block.shift_m(state.values[block.name])
        return out

    def sights(
        self, state: State, views: IntArray | None = None, obs: Observations | None = None
    ) -> Iterator[tuple[IntArray, Sight]]:
        """Views of one camera after the other, VIEWS_AT_ONCE at most, with their numbers; of some `views`, or of all."""
        obs = self.obs if obs is None else obs
        corners = self.board_corners_m(state)
        wanted = np.arange(len(obs.camera)) if views is None else views
        T_color_world = se3.inverse(state.T_world_color)
        for c in range(len(self.setup.cameras)):
            mine = wanted[obs.camera[wanted] == c]
            for first in range(0, len(mine), VIEWS_AT_ONCE):
                some = mine[first : first + VIEWS_AT_ONCE]
                yield (
                    some,
                    _sight(c, obs.only(some), state.boards, corners, self.setup.board.thickness_m, T_color_world[c]),
                )

    def looks(self, state: State, views: IntArray | None = None) -> Iterator[tuple[IntArray, Look]]:
        """Rows of each kind of the views of :meth:`sights`."""
        for some, sight in self.sights(state, views):
            yield some, self.look_at_pixels(state, sight)
            yield some, self.look_at_depth(state, sight)

    def look_at_pixels(self, state: State, sight: Sight) -> Look:
        """What is predicted of the pixels of some views."""
        return terms.look_at_pixels(sight, self.setup.priors[sight.camera].intrinsics, state.intrinsics[sight.camera])

    def look_at_depth(self, state: State, sight: Sight) -> Look:
        """What is predicted of the depth of some views."""
        obs, c = sight.obs, sight.camera
        corrected, slope = obs.depth_m.copy(), np.ones(obs.depth_m.shape)
        for block in self.blocks:
            if isinstance(block, DepthErrorBlock) and np.any(state.values[block.name][c]):
                own = state.values[block.name][c]
                corrected += block.basis(c, obs.pixels_px, obs.depth_m) @ own
                slope += block.basis_slope(c, obs.pixels_px, obs.depth_m) @ own
        return terms.look_at_depth(sight, corrected, slope)

    def residual(self, look: Look) -> FloatArray:
        """Predicted less measured, (n, N, r), px or metres; zero where nothing is used."""
        obs = look.sight.obs
        if look.left_m is not None:
            return np.where(obs.has_depth, look.left_m, 0.0)[..., None]
        return np.where(obs.has_pixel[..., None], look.predicted - obs.pixels_px, 0.0)

    def residuals(self, state: State, obs: Observations | None = None) -> tuple[FloatArray, FloatArray]:
        """Of all views, pixels (V, N, 2) and depth (V, N), metres, by the masks of `obs`, or of the problem."""
        obs = self.obs if obs is None else obs
        pixel, depth = np.zeros(obs.pixels_px.shape), np.zeros(obs.depth_m.shape)
        for some, sight in self.sights(state, None, obs):
            lens = self.setup.priors[sight.camera].intrinsics
            with np.errstate(all="ignore"):
                found = terms.pixels_of(sight, lens, state.intrinsics[sight.camera]) - sight.obs.pixels_px
            pixel[some] = np.where(sight.obs.has_pixel[..., None], found, 0.0)
            depth[some] = self.residual(self.look_at_depth(state, sight))[..., 0]
        return pixel, depth

    def in_front(self, state: State) -> bool:
        """True where every observed corner lies before its camera."""
        return all(terms.in_front(sight) for _, sight in self.sights(state))

    # ------------------------------------------------------------------------------------------------ equations

    def rows(
        self, state: State, views: IntArray | None = None, scales: tuple[FloatArray, FloatArray] | None = None
    ) -> Iterator[tuple[IntArray, Look, Rows]]:
        """Weighted rows of the views of :meth:`sights`, pixels and depth in turn.

        `scales` are factors of the residuals in px and metres, (V, N) each; None: those of the weights.
        """
        scales = self.weights.scales(self.obs) if scales is None else scales
        for some, look in self.looks(state, views):
            obs = look.sight.obs
            w = scales[KINDS.index(look.kind)][some][..., None]
            dense = [b for b in self.blocks if look.kind in b.kinds and not isinstance(b, PointBlock)]
            points = [b for b in self.blocks if look.kind in b.kinds and isinstance(b, PointBlock)]
            n, N, r = look.predicted.shape
            J = np.concatenate([b.derivative(look) for b in dense], axis=-1)
            J *= w[..., None]
            J_point = np.concatenate([np.zeros((n, N, r, 0)), *(b.derivative(look) for b in points)], axis=-1)
            at = [self.parts[b.name].start + b.point_columns(look) for b in points]
            rows = Rows(
                obs.frame,
                np.concatenate([self.index(b.name, look.camera) for b in dense]),
                J,
                state.boards.derivative(look) * w[..., None],
                self.residual(look) * w,
                np.concatenate([np.zeros((n, N, 0), int), *at], axis=-1),
                J_point * w[..., None],
            )
            yield some, look, rows

    @cached_property
    def pattern(self) -> Pattern:
        """Which globals each frame touches."""
        shared = [self.index(b.name) for b in self.blocks if b.scope.value == "rig"]
        own = [self.of_camera(c) for c in range(len(self.setup.cameras))]
        touched: list[set[int]] = [set() for _ in range(self.setup.obs.n_frames)]
        for f, c in zip(self.setup.obs.frame, self.setup.obs.camera, strict=True):
            touched[f].add(int(c))
        keys = [tuple(sorted(cameras)) for cameras in touched]
        columns = {key: np.sort(np.concatenate([*shared, *(own[c] for c in key)])) for key in set(keys)}
        return Pattern.of(keys, columns, self.n_globals, self.unit_size)

    def data_equations(
        self, state: State, views: IntArray | None = None, kinds: Sequence[Kind] = KINDS
    ) -> NormalEquations:
        """The normal equations of the observations alone, of some views and kinds, or of all."""
        return assemble(self.pattern, (rows for _, look, rows in self.rows(state, views) if look.kind in kinds))

    def equations(self, state: State) -> NormalEquations:
        """The normal equations, priors included."""
        gradient = self.prior.information @ (self.vector(state) - self.prior.mean)
        return self.data_equations(state).regular().plus(self.prior.information, gradient)

    def cost(self, state: State) -> float:
        """Half the weighted sum of squares."""
        d = self.vector(state) - self.prior.mean
        pixel, depth = self.residuals(state)
        w_pixel, w_depth = self.weights.scales(self.obs)
        squares = np.sum((pixel * w_pixel[..., None]) ** 2) + np.sum((depth * w_depth) ** 2)
        return 0.5 * float(squares + d @ self.prior.information @ d)

    def using(self, obs: Observations) -> Problem:
        """The same with other masks."""
        return replace(self, obs=obs)


def _sight(
    camera: int,
    obs: Observations,
    boards: Boards,
    corners_m: FloatArray,
    thickness_m: float,
    T_color_world: FloatArray,
) -> Sight:
    X = corners_m[obs.back[:, None], obs.corner]
    T, freed = boards.T_parent_board[obs.frame], boards.freed[obs.frame]
    if freed.any():
        X = np.where(freed[:, None, None], obs.back[:, None, None] * np.array([0, 0, thickness_m]), X)
    p_parent = X @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    if freed.any():  # each from its own corner of the front
        p_parent[freed] += boards.corners_m[obs.frame[freed, None], obs.corner[freed]] - T[freed, None, :3, 3]
    T_color_parent = np.where(obs.shared[:, None, None], T_color_world, np.eye(4))
    p = p_parent @ T_color_parent[:, :3, :3].transpose(0, 2, 1) + T_color_parent[:, None, :3, 3]
    return Sight(camera, obs, T[:, :3, :3], freed, p_parent, T_color_parent[:, :3, :3], p)
