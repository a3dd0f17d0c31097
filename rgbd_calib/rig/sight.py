"""Views at a state: where their corners are in the parent's and the camera's frame, and what a row depends on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.observations import Observations

if TYPE_CHECKING:
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
    """Rows of one kind: what is predicted of a view's corners, and how that moves; r rows for each corner."""

    kind: Kind
    camera: int
    pixels_px: FloatArray
    """(n, N, 2), of the image that the row is of."""
    depth_m: FloatArray
    """(n, N), as reported."""
    predicted: FloatArray
    """(n, N, r)."""
    sight: Sight
    by_point: FloatArray
    """(n, N, r, 3), by the point in the parent's frame."""
    by_normal: FloatArray | None = None
    """(n, N, r, 3), by the board's normal in the parent's frame; None where it has no part."""
    by_lens: FloatArray | None = None
    """(n, N, r, 4 + k), by the intrinsics; of pixels."""
    slope: FloatArray | None = None
    """(n, N), of the corrected by the reported depth; of depth."""
    left_m: FloatArray | None = None
    """(n, N), predicted less corrected depth over the slope: what the reported depth is off by; of depth."""

    @cached_property
    def by_motion(self) -> FloatArray:
        """(n, N, r, 6), by a motion (rad, m) of all that the view shows, in the parent's frame."""
        turn = np.cross(self.sight.p_parent[:, :, None], self.by_point)
        if self.by_normal is not None:
            turn = turn + np.cross(self.sight.R_parent_board[:, None, None, :, 2], self.by_normal)
        return np.concatenate([turn, self.by_point], axis=-1)

    @cached_property
    def by_point_on_board(self) -> FloatArray:
        """(n, N, r, 3), by the point in the board's frame; nothing where corners are points of their own."""
        held = np.where(self.sight.freed[:, None, None], 0.0, self.sight.R_parent_board)
        return np.asarray(self.by_point @ held[:, None])
