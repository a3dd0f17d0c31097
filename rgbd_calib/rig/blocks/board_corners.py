"""Each printed corner's own offset from where it should be, in the plane of its sheet.

The offsets' mean, turn and scale would be those of the sheet, and their aspect and shear those of the print: these six are
taken out, by a prior that holds them at zero.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from rgbd_calib.geometry.linear import IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Component, PointBlock
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock, nominal_corners_m
from rgbd_calib.rig.sight import Look

DOF = 4.0
GAUGE = 1e3
"""How much surer the affine part is zero than a single offset."""


class CornerOffsets(PointBlock, BoardShapeBlock):
    """x and y of each corner of the front, and of the back, (1, 2 faces M)."""

    name = "corner offsets"

    @property
    def _faces(self) -> int:
        return 2 if self.setup.board.two_sided else 1

    @property
    def parameters(self) -> tuple[str, ...]:
        faces, M = ("front", "back")[: self._faces], self.setup.board.n_corners
        return tuple(f"{face} corner {k} in {axis}" for face in faces for k in range(M) for axis in "xy")

    def prior(self) -> BlockPrior:
        usual, n, M = self.setup.params.corner_offset_m, self.size, self.setup.board.n_corners
        seen = np.zeros((self._faces, M), bool)
        obs = self.setup.obs
        seen[np.broadcast_to(obs.back[:, None], obs.corner.shape)[obs.has_pixel], obs.corner[obs.has_pixel]] = True
        information = (
            np.asarray(np.kron(np.eye(self._faces), self._affine @ self._affine.T), float) * (GAUGE / usual) ** 2
        )
        component = Component("corner offsets", np.arange(n), np.eye(n), usual, DOF)
        free = np.repeat(seen.ravel(), 2)
        return BlockPrior(np.zeros(n), information, free, np.zeros(n, bool), (component,))

    @cached_property
    def _affine(self) -> FloatArray:
        """(2 M, 6), orthonormal: what a shift and a linear map of the sheet do to x and y of its corners."""
        xy = nominal_corners_m(self.setup.board)[0, :, :2]
        moves = np.concatenate([np.ones((len(xy), 1)), xy - xy.mean(axis=0)], axis=1)
        both = np.zeros((len(xy), 2, 6))
        both[:, 0, :3] = both[:, 1, 3:] = moves
        return np.asarray(np.linalg.qr(both.reshape(-1, 6))[0])

    def table(self) -> FloatArray:
        M = self.setup.board.n_corners
        out = np.zeros((2, M, 3, self.size))
        face, corner, axis = np.indices((self._faces, M, 2)).reshape(3, -1)
        out[face, corner, axis, np.arange(self.size)] = 1.0
        return out

    def shift_m(self, value: FloatArray) -> FloatArray:
        out = np.zeros((2, self.setup.board.n_corners, 3))
        out[: self._faces, :, :2] = value.reshape(self._faces, -1, 2)
        return out

    def derivative(self, look: Look) -> FloatArray:
        return look.by_point_on_board[..., :2]

    def point_columns(self, look: Look) -> IntArray:
        obs = look.sight.obs
        corner = obs.back[:, None] * self.setup.board.n_corners + obs.corner
        return np.asarray(2 * corner[..., None] + np.arange(2))
