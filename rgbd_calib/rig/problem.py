"""The least-squares problem of the rig: observations, blocks of unknowns, weights and priors, as one object.

It predicts, and it linearises: the weighted rows of some views after the other, so that memory does not grow with the
recording. It alone knows which column is which.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import Assembly, BoolArray, Covariance, IntArray, NormalEquations, Pattern, Rows
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig import terms
from rgbd_calib.rig.blocks import (
    ESTIMATED,
    Block,
    BlockPrior,
    Boards,
    BoardShapeBlock,
    Component,
    DepthErrorBlock,
    Kind,
    PointBlock,
    Scope,
    WallPlanes,
)
from rgbd_calib.rig.blocks.board_shape import nominal_corners_m
from rgbd_calib.rig.blocks.registration import turn_of_rays
from rgbd_calib.rig.blocks.units import N_OF_WALL
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.setup import Setup
from rgbd_calib.rig.sight import Look, Sight, sight_of
from rgbd_calib.rig.weights import Weights

if TYPE_CHECKING:
    from rgbd_calib.rig.local_field import LocalField

VIEWS_AT_ONCE = 256
"""Views whose derivatives are in memory together: some 10 MB."""
OF_BOARDS = (Kind.PIXEL, Kind.DEPTH)
ALL = (*OF_BOARDS, Kind.WALL)


@dataclass(frozen=True)
class State:
    """Values of all unknowns."""

    values: Mapping[str, FloatArray]
    """By block, as the block has them."""
    boards: Boards
    walls: WallPlanes

    @property
    def T_world_color(self) -> FloatArray:
        """(C, 4, 4)."""
        return self.values["pose"]

    @property
    def intrinsics(self) -> FloatArray:
        """(C, 4 + the longest lens)."""
        return self.values["intrinsics"]


@dataclass(frozen=True)
class Problem:
    """What is solved; all views of `setup`, of which the masks of `obs` say what is used."""

    setup: Setup
    blocks: tuple[Block, ...]
    obs: Observations
    weights: Weights
    wall_rays: FloatArray
    """(W, N, 2), of the cells of walls; by the lenses as they are known between the rounds."""
    local: tuple[LocalField | None, ...] = ()
    """By camera, the pattern of its depth that is known between the rounds; empty: none."""
    unit_size: int = 6
    reads_faces: ClassVar[bool] = True
    """Each frame may be read from either side (:mod:`.faces`)."""

    @classmethod
    def of(cls, setup: Setup, blocks: Sequence[type[Block]] = ESTIMATED) -> Problem:
        made = tuple(block(setup) for block in blocks if block.name not in setup.params.hold and block.applies(setup))
        usual = {c.name: c.usual for block in made for c in block.prior().components}
        weights = Weights.first(setup.obs, setup.walls, len(setup.cameras), usual, setup.params)
        return cls(setup, made, setup.obs, weights, setup.wall_rays(setup.intrinsics))

    # ------------------------------------------------------------------------------------------------ parameters

    @cached_property
    def n_globals(self) -> int:
        return sum(block.size for block in self.blocks)

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
        return np.concatenate([self.index(b.name, camera) for b in self.blocks if b.scope is Scope.CAMERA])

    @cached_property
    def components(self) -> tuple[tuple[IntArray, Component], ...]:
        """All variance components, of their free parameters, with their globals."""
        return tuple(pair for group in self.component_groups for pair in group)

    @cached_property
    def component_groups(self) -> list[list[tuple[IntArray, Component]]]:
        """The same, those of one block and camera together."""
        sets: dict[tuple[str, int], list[tuple[IntArray, Component]]] = {}
        for block in self.blocks:
            for c in block.prior().free_components():
                at = self.parts[block.name].start + c.parameters
                sets.setdefault((block.name, int(c.parameters[0]) // block.n), []).append((at, c))
        return list(sets.values())

    @cached_property
    def prior(self) -> BlockPrior:
        """Of all globals, (P,) and (P, P), that of the components included; poses have no mean."""
        P = self.n_globals
        mean, information = np.zeros(P), np.zeros((P, P))
        free, assumed = np.zeros(P, bool), np.zeros(P, bool)
        for block in self.blocks:
            at, own = self.parts[block.name], block.prior()
            mean[at], free[at], assumed[at] = own.mean, own.free, own.assumed
            information[at, at] = own.information
        for index, component in self.components:
            information[np.ix_(index, index)] += component.structure / self.weights.sizes[component.name] ** 2
        return BlockPrior(mean, information, free, assumed)

    @property
    def n_board_units(self) -> int:
        """Units of the boards, which come before those of the walls: a pose for each frame."""
        return self.setup.obs.n_frames

    def units_of(self, state: State, look: Look) -> IntArray:
        """(n,), the unit that each view of rows touches."""
        return look.sight.obs.frame

    def tuned(self, state: State, covariance: Covariance) -> tuple[Problem, float]:
        """With what else the residuals tell besides the weights, and by how much it changed, as for the weights."""
        return self, 0.0

    def instants(self) -> IntArray:
        """(V,), equal for views that tie their cameras to each other."""
        return self.obs.frame

    @cached_property
    def unit_information(self) -> FloatArray:
        """(F + W, D), diagonal: what is known of the units before; of walls alone."""
        own, w = self.setup, self.weights
        out = np.zeros((self.n_board_units + own.walls.n, self.unit_size))
        out[self.n_board_units :, 0] = w.robust_distance * (w.distance_factor * own.walls.sd_m) ** -2.0
        out[self.n_board_units :, 1:3] = w.wall_tilt[own.walls.camera, None] ** -2.0
        out[self.n_board_units :, 3:6] = w.wall_bend[own.walls.camera, None] ** -2.0
        return out

    def start(self, boards: Boards) -> State:
        return State({b.name: b.start() for b in self.blocks}, boards, WallPlanes.none(self.setup.walls.n))

    def moved(self, state: State, step: FloatArray, unit_step: FloatArray) -> State:
        """The state after a step of the globals (P,) and of the units (F + W, D)."""
        F = self.setup.obs.n_frames
        values = {b.name: b.moved(state.values[b.name], step[self.parts[b.name]]) for b in self.blocks}
        return State(values, state.boards.moved(unit_step[:F]), state.walls.moved(unit_step[F:]))

    def vector(self, state: State) -> FloatArray:
        """(P,), with zeros for the poses, to compare with the prior's mean."""
        return np.concatenate([b.vector(state.values[b.name]) for b in self.blocks])

    def unit_vector(self, state: State) -> FloatArray:
        """(F + W, D), of walls alone, zeros for the boards, to compare with what is known of them: zero."""
        out = np.zeros(self.unit_information.shape)
        out[self.n_board_units :, :N_OF_WALL] = state.walls.values
        return out

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
                thickness_m = self.setup.board.thickness_m
                yield some, sight_of(c, obs.only(some), state.boards, corners, thickness_m, T_color_world[c])

    def looks(self, state: State, views: IntArray | None = None) -> Iterator[tuple[IntArray, Look]]:
        """Rows of pixels and depth of the views of :meth:`sights`."""
        for some, sight in self.sights(state, views):
            yield some, self.look_at_pixels(state, sight)
            yield some, self.look_at_depth(state, sight)

    def look_at_pixels(self, state: State, sight: Sight) -> Look:
        """Rows of the pixels of some views."""
        return terms.look_at_pixels(sight, self.setup.priors[sight.camera].intrinsics, state.intrinsics[sight.camera])

    def look_at_depth(self, state: State, sight: Sight) -> Look:
        """Rows of the depth of some views."""
        obs, c = sight.obs, sight.camera
        corrected, slope = self.corrected(state, c, obs.pixels_px, obs.depth_m, Kind.DEPTH, obs.alone)
        if self.setup.priors[c].mount is not None:
            lens = self.setup.priors[c].intrinsics
            look = terms.look_at_plane(sight, lens, state.intrinsics[c], corrected, slope)
            return replace(look, values=self._of_depth(state, c))
        turn = turn_of_rays(self.blocks, state.values, c, obs.pixels_px, obs.depth_m)
        return replace(self.depth_rows(sight, turn, corrected, slope), values=self._of_depth(state, c))

    depth_rows = staticmethod(terms.look_at_depth)

    def looks_at_walls(self, state: State, cameras: Sequence[int]) -> Iterator[tuple[IntArray, Look, FloatArray]]:
        """Rows of the walls of each camera, their numbers, and the derivatives (n, N, 1, 3) by the walls' own unknowns."""
        walls = self.setup.walls
        for c in cameras:
            mine = np.flatnonzero(walls.camera == c)
            if not len(mine):
                continue
            tape, tilt = (state.values[name][c] if name in self.parts else 0.0 for name in ("tape", "wall tilt"))
            at, z, rays = walls.pixels_px[mine], walls.depth_m[mine], self.wall_rays[mine]
            distance_m = walls.written_m[mine] + tape
            ahead, by_wall = state.walls.ahead(mine, distance_m, walls.tilts[mine] + tilt, np.nan_to_num(rays))
            corrected, slope = self.corrected(state, c, at, z, Kind.WALL)
            seen = walls.seen[mine] & np.isfinite(rays[..., 0])
            look = terms.look_at_walls(c, at, z, ahead, by_wall, slope, corrected, seen)
            yield mine, replace(look, values=self._of_depth(state, c)), (by_wall / slope[..., None])[:, :, None]

    def corrected(
        self,
        state: State,
        camera: int,
        pixels_px: FloatArray,
        depth_m: FloatArray,
        kind: Kind,
        alone: BoolArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Depth (n, N), metres, of boards or walls, as the state corrects it, and its slope by the reported depth; `alone` (n,)
        are the boards of intrinsic recordings."""
        corrected, slope = depth_m.copy(), np.ones(depth_m.shape)
        if self.local and (local := self.local[camera]) is not None:
            corrected += local.error_m(pixels_px, depth_m, self.setup.sizes_px[camera])
        for block in self.blocks:
            if isinstance(block, DepthErrorBlock) and kind in block.kinds:
                error, by_depth = block.error(camera, state.values[block.name][camera], pixels_px, depth_m)
                some = alone[:, None] if block.of_alone and alone is not None else 1.0
                corrected += some * error
                slope += some * by_depth
        return corrected, slope

    def _of_depth(self, state: State, camera: int) -> dict[str, FloatArray]:
        return {b.name: state.values[b.name][camera] for b in self.blocks if isinstance(b, DepthErrorBlock)}

    def residuals(self, state: State, obs: Observations | None = None) -> tuple[FloatArray, FloatArray]:
        """Of all views, pixels (V, N, 2) and depth (V, N), metres, by the masks of `obs`, or of the problem."""
        obs = self.obs if obs is None else obs
        pixel, depth = np.zeros(obs.pixels_px.shape), np.zeros(obs.depth_m.shape)
        for some, sight in self.sights(state, None, obs):
            lens = self.setup.priors[sight.camera].intrinsics
            with np.errstate(all="ignore"):
                found = terms.pixels_of(sight, lens, state.intrinsics[sight.camera]) - sight.obs.pixels_px
            pixel[some] = np.where(sight.obs.has_pixel[..., None], found, 0.0)
            depth[some] = self.look_at_depth(state, sight).left[..., 0]
        return pixel, depth

    def wall_residuals(self, state: State) -> FloatArray:
        """(W, N), metres of reported depth; zero where nothing was seen."""
        out = np.zeros(self.setup.walls.depth_m.shape)
        for some, look, _ in self.looks_at_walls(state, range(len(self.setup.cameras))):
            out[some] = look.left[..., 0]
        return out

    def in_front(self, state: State) -> bool:
        """True where every observed corner lies before its camera."""
        return all(terms.in_front(sight) for _, sight in self.sights(state))

    # ------------------------------------------------------------------------------------------------ equations

    def rows(
        self, state: State, views: IntArray | None = None, scales: tuple[FloatArray, FloatArray] | None = None
    ) -> Iterator[tuple[IntArray, Look, Rows]]:
        """Weighted rows of the views of :meth:`sights`, pixels and depth in turn, before what their weight matrix takes off.

        `scales` are factors of the residuals in px and metres, (V, N) each; None: those of the weights.
        """
        scales = self.weights.scales(self.obs) if scales is None else scales
        for some, look in self.looks(state, views):
            w = scales[OF_BOARDS.index(look.kind)][some]
            yield some, look, self._rows(look, self.units_of(state, look), state.boards.derivative(look), w)

    def wall_rows(self, state: State, cameras: Sequence[int]) -> Iterator[tuple[IntArray, Look, Rows]]:
        """Weighted rows of the walls of some cameras."""
        scales, F, more = self.weights.wall_scales(self.setup.walls), self.n_board_units, self.unit_size - N_OF_WALL
        for some, look, by_wall in self.looks_at_walls(state, cameras):
            yield some, look, self._rows(look, F + some, np.pad(by_wall, [(0, 0)] * 3 + [(0, more)]), scales[some])

    def _rows(self, look: Look, units: IntArray, by_unit: FloatArray, w: FloatArray) -> Rows:
        dense = [b for b in self.blocks if b.changes(look) and not isinstance(b, PointBlock)]
        points = [b for b in self.blocks if b.changes(look) and isinstance(b, PointBlock)]
        w, shape = w[..., None], look.left.shape
        J = np.concatenate([b.derivative(look) for b in dense], axis=-1)
        J *= w[..., None]
        J_point = np.concatenate([np.zeros((*shape, 0)), *(b.derivative(look) for b in points)], axis=-1)
        at = [self.parts[b.name].start + b.point_columns(look) for b in points]
        return Rows(
            units,
            np.concatenate([self.index(b.name, look.camera) for b in dense]),
            J,
            by_unit * w[..., None],
            look.left * w,
            np.concatenate([np.zeros((*shape[:2], 0), int), *at], axis=-1),
            J_point * w[..., None],
        )

    @cached_property
    def pattern(self) -> Pattern:
        """Which globals each frame and wall touches."""
        own, cameras = self.setup, range(len(self.setup.cameras))
        of_rig = [self.index(b.name) for b in self.blocks if b.scope is Scope.RIG]
        of_camera = [self.of_camera(c) for c in cameras]
        touched: list[set[int]] = [set() for _ in range(own.obs.n_frames)]
        for f, c in zip(own.obs.frame, own.obs.camera, strict=True):
            touched[f].add(int(c))
        keys = [*(tuple(sorted(own)) for own in touched), *((-1, int(c)) for c in own.walls.camera)]
        columns = {
            key: np.sort(np.concatenate([*of_rig, *(of_camera[c] for c in key)])) for key in set(keys) if -1 not in key
        }
        columns |= {key: np.sort(of_camera[key[1]]) for key in set(keys) if -1 in key}
        return Pattern.of(keys, columns, self.n_globals, self.unit_size)

    def data_equations(
        self, state: State, views: IntArray | None = None, kinds: Sequence[Kind] = ALL
    ) -> NormalEquations:
        """The normal equations of the observations alone: of some views, or of all, and of the walls where asked for."""
        out = Assembly(self.pattern)
        for some, look, rows in self.rows(state, views):
            if look.kind in kinds:
                out.add(rows)
                if (common := self.weights.taken_off(look.kind, some, rows)) is not None:
                    out.add(common, -1.0)
        for _, _, rows in self.wall_rows(state, range(len(self.setup.cameras)) if Kind.WALL in kinds else []):
            out.add(rows)
        return out.equations()

    def equations(self, state: State, views: IntArray | None = None) -> NormalEquations:
        """The normal equations, priors included; of some views, or of all."""
        known, prior, d = self.unit_information, self.prior, self.vector(state) - self.prior.mean
        data = self.data_equations(state, views).plus_units(known, known * self.unit_vector(state))
        return self.eliminable(data, state).plus(prior.information, prior.information @ d)

    def eliminable(self, data: NormalEquations, state: State, weight: float = 1.0) -> NormalEquations:
        """Such that units can be eliminated; `weight` is of what else is known of them."""
        return data.regular()

    def cost(self, state: State) -> float:
        """Half the weighted sum of squares."""
        d = self.vector(state) - self.prior.mean
        (pixel, depth), (w_pixel, w_depth) = self.residuals(state), self.weights.scales(self.obs)
        squares = self.weights.squares(Kind.PIXEL, (pixel * w_pixel[..., None]).reshape(len(pixel), -1))
        squares += self.weights.squares(Kind.DEPTH, depth * w_depth)
        squares += np.sum((self.wall_residuals(state) * self.weights.wall_scales(self.setup.walls)) ** 2)
        squares += np.sum(self.unit_information * self.unit_vector(state) ** 2)
        return 0.5 * float(squares + d @ self.prior.information @ d)

    def using(self, obs: Observations) -> Problem:
        """The same with other masks."""
        return replace(self, obs=obs)
