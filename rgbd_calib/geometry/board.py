"""A calibration board, as designed and as printed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

APRILGRID_TAGS = "DICT_APRILTAG_36h11"
"""Of Kalibr's boards, and taken where no other is stated."""
BoardType = Literal["checkerboard", "charuco", "aprilgrid"]


@dataclass(frozen=True, eq=False)
class BoardShape:
    """Where the corners of a board truly are: its print as measured; in the order of the front's corners, metres."""

    front_m: FloatArray
    """(n, 3), in the board's frame."""
    back_m: FloatArray | None = None
    """(n, 3), the back's corner behind each of the front's; None on one-sided boards."""
    front_sd_m: FloatArray | None = None
    """(n, 3), standard deviations; None: none are known."""
    back_sd_m: FloatArray | None = None


@dataclass(frozen=True)
class Board:
    """A calibration board with `cols` x `rows` inner corners, squares of `square_m`.

    The board's frame is the front's: x along the columns, y along the rows, z into the board, away from whoever
    looks at the front; the origin is corner (0, 0). Corner (c, r) has the number r * cols + c. On a two-sided board,
    corner (c, r) of the front lies behind corner (cols - 1 - c, r) of the back, `thickness_m` away; the back's plane
    is z = thickness_m.

    The corners of an AprilGrid (Kalibr's) are those of its tags: cols / 2 x rows / 2 tags of side `marker_m`, whose corners
    (0, 0) are 2 `square_m` apart.
    """

    cols: int
    rows: int
    square_m: float
    two_sided: bool = False
    thickness_m: float = 0.0
    type: BoardType = "checkerboard"
    marker_m: float = 0.0
    """Side of a ChArUco marker or an AprilGrid's tag; 0 for a checkerboard."""
    dictionary: str = ""
    """Name of the markers' dictionary as cv2.aruco spells it, as DICT_5X5_250; empty for a checkerboard."""
    legacy: bool = False
    """A ChArUco board in the layout before OpenCV 4.6, where an even number of rows of squares begins with white."""
    shape: BoardShape | None = None
    """None: flat, its squares as stated."""

    @property
    def n_corners(self) -> int:
        return self.cols * self.rows

    @cached_property
    def grid(self) -> FloatArray:
        """Places (cols * rows, 2) of the front's corners as it was designed, in squares along columns and rows."""
        r, c = np.divmod(np.arange(self.n_corners), self.cols)
        places = np.stack([c, r], axis=1).astype(float)
        if self.type == "aprilgrid":
            places += (places % 2) * (self.marker_m / self.square_m - 1)
        places.flags.writeable = False
        return places

    @property
    def symmetric(self) -> bool:
        """True where a half turn of the board cannot be seen: a checkerboard with cols + rows even."""
        return self.type == "checkerboard" and (self.cols + self.rows) % 2 == 0

    def T_face_board(self, back: bool, turned: bool) -> FloatArray:
        """Motion (4, 4) from the board's frame to the frame of a face as it was read (the front, unturned: identity).

        All of these motions commute and are their own inverses.
        """
        width, height = self.grid[-1] * self.square_m
        T = np.eye(4)
        if turned:
            T = np.array([[-1.0, 0, 0, width], [0, -1, 0, height], [0, 0, 1, 0], [0, 0, 0, 1]]) @ T
        if back:
            T = np.array([[-1.0, 0, 0, width], [0, 1, 0, 0], [0, 0, -1, self.thickness_m], [0, 0, 0, 1]]) @ T
        return T

    def corners_m(self, back: bool = False) -> FloatArray:
        """Corners (cols * rows, 3), metres, in the board's frame, of the front or of the back, each in its own order."""
        r, c = np.divmod(np.arange(self.n_corners), self.cols)
        if self.shape is not None:
            of_face = self.shape.back_m if back else self.shape.front_m
            if of_face is not None:
                return of_face[r * self.cols + (self.cols - 1 - c if back else c)]
        places = self.grid[r * self.cols + (self.cols - 1 - c if back else c)] * self.square_m
        return np.column_stack([places, np.full(len(c), self.thickness_m if back else 0.0)])
