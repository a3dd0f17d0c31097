"""What passes between the stages: frozen records of arrays, each with its shape, unit and frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import DepthBias as DepthBias
from rgbd_calib.geometry.depth_error import DepthField as DepthField
from rgbd_calib.geometry.depth_image import DepthImage
from rgbd_calib.geometry.depth_sensor import DepthCamera as DepthCamera
from rgbd_calib.geometry.depth_sensor import DepthSensor as DepthSensor
from rgbd_calib.geometry.so3 import FloatArray

IntArray = np.ndarray
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


@dataclass(frozen=True)
class BoardView:
    """The board in one image: corners in px and the sensor's depth there, before any bias correction."""

    camera: str
    frame: str
    ids: IntArray
    """Corner numbers (n,), as the detector ordered them: face and half turn are not decided yet."""
    corners_px: FloatArray
    """(n, 2)."""
    depth_m: FloatArray
    """(n,), metres along the optical axis as measured, NaN where there is none."""
    depth_pixels: IntArray
    """(n,), how many depth pixels each value rests on, 0 where there is none."""
    predicted: bool = False
    """The corners were not seen in this image: `corners_px` says where its depth was read, by the board's pose in another."""


@dataclass(frozen=True)
class PosedView:
    """A view with the pose of the face that it shows, in the order in which the detector read it."""

    view: BoardView
    T_color_face: FloatArray
    """(4, 4); the face's frame is the front's frame of :class:`Board`, as if the face were the front."""
    rms_px: float
    """RMS reprojection error over corners, px for each coordinate."""


@dataclass(frozen=True)
class PlacedView:
    """A view whose face and half turn are decided: its corners are points of the board's frame."""

    view: BoardView
    back: bool
    turned: bool
    T_color_board: FloatArray
    """(4, 4)."""

    def points_m(self, board: Board) -> FloatArray:
        """Corners (n, 3), metres, in the board's frame, in the order of the view."""
        ids = board.n_corners - 1 - self.view.ids if self.turned else self.view.ids
        return board.corners_m(self.back)[ids]

    def front_corner(self, board: Board) -> IntArray:
        """Number (n,) of the front's corner at, or behind, each corner of the view."""
        ids = board.n_corners - 1 - self.view.ids if self.turned else self.view.ids
        r, c = np.divmod(ids, board.cols)
        return r * board.cols + (board.cols - 1 - c if self.back else c)


@dataclass(frozen=True)
class Clock:
    """How a camera's time stamps relate to the reference's clock: t = stamp + offset_s + 1e-6 drift_ppm (stamp - first stamp)
    is the instant of the middle row of its colour image; zeros for the reference, but for what is between its own images."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    depth_delay_s: float = 0.0
    """Instant of the depth less that of its colour image, beyond what the stamps say."""
    readout_s: float = 0.0
    """Of a rolling shutter, from the first row to the last."""
    jitter_s: float = 0.0
    """Standard deviation of the stamps."""
    offset_sd_s: float = 0.0
    drift_sd_ppm: float = 0.0
    depth_delay_sd_s: float = 0.0


@dataclass(frozen=True)
class RigCamera:
    """A calibrated camera of the rig."""

    intrinsics: Intrinsics
    T_world_color: FloatArray
    """(4, 4), p_world = T_world_color @ p_color, metres."""
    covariance: FloatArray
    """(6, 6) of the left perturbation (rad, m) of T_world_color in the world frame; zeros for the reference."""
    depth_bias: DepthBias | None = None
    """None: the sensor's depth is taken as it is."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """Plain numbers by name, such as sigma_2d_px, sigma_3d_m, views, observations."""
    depth_field: DepthField | None = None
    """What its depth errs by over the image."""
    depth_camera: DepthCamera | None = None
    """None: depth has the colour camera's geometry."""
    clock: Clock | None = None
    """None: its stamps are not related to the others'."""

    def project(self, points_m: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3), metres, in the world; NaN behind the camera.

        Pixels may lie outside the image: compare with `intrinsics.size_px`.
        """
        p_color = se3.transform(se3.inverse(self.T_world_color), np.asarray(points_m, float))
        with np.errstate(all="ignore"):
            pixels = self.intrinsics.project(p_color)
        return np.where(p_color[..., 2:] > 0, pixels, np.nan)

    @property
    def depth_sensor(self) -> DepthSensor:
        """Its depth sensor, as far as it is known."""
        return DepthSensor(self.depth_camera or DepthCamera(self.intrinsics), self.depth_bias, self.depth_field)

    @cached_property
    def depth_image(self) -> DepthImage:
        """The same over its whole image."""
        return DepthImage(self.depth_sensor)


@dataclass(frozen=True)
class Rig:
    """The result: cameras by id, the reference, and how good it is."""

    reference: str
    cameras: dict[str, RigCamera]
    quality: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, camera: str) -> RigCamera:
        if camera not in self.cameras:
            raise KeyError(f"no camera {camera!r} in this rig; it has {', '.join(self.cameras)}")
        return self.cameras[camera]


@dataclass(frozen=True)
class Correspondences:
    """Features that several cameras see: pixels and measured 3D points, in any mixture.

    A point is a physical point at one instant, (frame, feature); row i of a table is one observation, by camera
    `cameras[*_camera[i]]` of point `labels[*_point[i]]`. The two feature sets of the paper (q_l^h and p_l^j) are the
    two tables; they may or may not hold the same points.
    """

    cameras: tuple[str, ...]
    labels: tuple[tuple[str, str], ...]
    """(frame, feature) of each point."""
    pixel_camera: IntArray
    """(n2,) index into `cameras`."""
    pixel_point: IntArray
    """(n2,) index into `labels`."""
    pixels_px: FloatArray
    """(n2, 2)."""
    xyz_camera: IntArray
    """(n3,)."""
    xyz_point: IntArray
    """(n3,)."""
    xyz_m: FloatArray
    """(n3, 3), metres, in the colour camera's frame, depth bias removed."""
    xyz_covariance: FloatArray | None = None
    """(n3, 3, 3), in the colour camera's frame, known up to one common factor sigma_3d^2; None: the identity."""


@dataclass(frozen=True, eq=False)
class CameraSnapshot:
    """One camera's images of a still scene: one colour image, and the mean of its depth images."""

    camera: str
    color: np.ndarray
    """(h, w, 3), uint8, B G R."""
    depth_m: FloatArray
    """(h, w) of the depth image, metres as measured, NaN where there is none."""
    frames: int
    """Depth images in the mean."""
