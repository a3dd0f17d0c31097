"""Views at a state: where their corners are in the parent's and the camera's frame, and what a row depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.observations import Observations

if TYPE_CHECKING:
    from rgbd_calib.rig.blocks import Boards
    from rgbd_calib.rig.blocks.block import Kind


@dataclass(frozen=True)
class Sight:
    """Some views of one camera; n views, N corners. The parent is the world, or the camera of a frame that only one sees."""

    camera: int
    obs: Observations
    R_parent_board: FloatArray
    """(n, 3, 3)."""
    freed: BoolArray
    """(n,) bool: the corners are points of their own, and the board's pose tells the normal alone."""
    p_parent: FloatArray
    """(n, N, 3), metres."""
    R_color_parent: FloatArray
    """(n, 3, 3)."""
    p_color: FloatArray
    """(n, N, 3), metres."""

    @cached_property
    def normal_color(self) -> FloatArray:
        """(n, 3), the board's z axis in the camera's frame."""
        return np.asarray((self.R_color_parent @ self.R_parent_board)[..., 2])


@dataclass(frozen=True)
class Look:
    """Rows of one kind, of n views or walls: what is predicted, and how that moves; r rows for each of N corners or cells."""

    kind: Kind
    camera: int
    pixels_px: FloatArray
    """(n, N, 2), of the image that the row is of."""
    depth_m: FloatArray
    """(n, N), as reported."""
    left: FloatArray
    """(n, N, r), predicted less measured: px, or metres of reported depth."""
    views: Sight | None = None
    """Of a board."""
    by_point: FloatArray | None = None
    """(n, N, r, 3), by the point in the parent's frame; of a board."""
    by_normal: FloatArray | None = None
    """(n, N, r, 3), by the board's normal in the parent's frame; of depth on a board."""
    by_turn: FloatArray | None = None
    """(n, N, 2), by a turn of the depth image's rays against those of the colour image, metres; of depth on a board."""
    by_lens: FloatArray | None = None
    """(n, N, r, 4 + k), by the intrinsics; of pixels, and of depth that is read where no corner was seen."""
    slope: FloatArray | None = None
    """(n, N), of the corrected by the reported depth; of depth."""
    by_distance: FloatArray | None = None
    """(n, N), by the distance of the wall; of walls."""
    by_tilts: FloatArray | None = None
    """(n, N, 2), by the tilts of the wall; of walls."""
    values: Mapping[str, FloatArray] = field(default_factory=dict)
    """The camera's unknowns at this state, by block, of those of depth."""

    @property
    def sight(self) -> Sight:
        assert self.views is not None, "rows of walls have no view"
        return self.views

    @cached_property
    def by_motion(self) -> FloatArray:
        """(n, N, r, 6), by a motion (rad, m) of all that the view shows, in the parent's frame."""
        assert self.by_point is not None
        turn = np.cross(self.sight.p_parent[:, :, None], self.by_point)
        if self.by_normal is not None:
            turn = turn + np.cross(self.sight.R_parent_board[:, None, None, :, 2], self.by_normal)
        return np.concatenate([turn, self.by_point], axis=-1)

    @cached_property
    def by_point_on_board(self) -> FloatArray:
        """(n, N, r, 3), by the point in the board's frame; nothing where corners are points of their own."""
        assert self.by_point is not None
        held = np.where(self.sight.freed[:, None, None], 0.0, self.sight.R_parent_board)
        return np.asarray(self.by_point @ held[:, None])


def sight_of(
    camera: int,
    obs: Observations,
    boards: Boards,
    corners_m: FloatArray,
    thickness_m: float,
    T_color_world: FloatArray,
) -> Sight:
    """Views of one camera: `corners_m` (2, M, 3) are the board's, the boards' frames those of `obs`."""
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
