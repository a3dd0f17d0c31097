"""What passes between the stages: frozen records of arrays, each with its shape, unit and frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.board import APRILGRID_TAGS as APRILGRID_TAGS
from rgbd_calib.geometry.board import Board as Board
from rgbd_calib.geometry.board import BoardShape as BoardShape
from rgbd_calib.geometry.board import BoardType as BoardType
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import DepthBias as DepthBias
from rgbd_calib.geometry.depth_error import DepthField as DepthField
from rgbd_calib.geometry.depth_image import DepthImage
from rgbd_calib.geometry.depth_sensor import DepthCamera as DepthCamera
from rgbd_calib.geometry.depth_sensor import DepthSensor as DepthSensor
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import CameraStatistics, Quality

IntArray = np.ndarray


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
    alone: bool = False
    """Of its camera's own intrinsic recording, which is of another time."""

    def as_alone(self, camera: str | None = None) -> BoardView:
        """The same as of an intrinsic recording, its frame named after `camera`, or its own."""
        return replace(self, frame=f"{camera or self.camera} alone: {self.frame}", alone=True)


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
    statistics: CameraStatistics = field(default_factory=CameraStatistics)
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


def unposed(intrinsics: Mapping[str, Intrinsics], biases: Mapping[str, DepthBias]) -> dict[str, RigCamera]:
    """Cameras of which lens and depth bias are known and nothing else: all at the identity."""
    at, unknown = np.eye(4), np.zeros((6, 6))
    return {name: RigCamera(lens, at, unknown, biases.get(name)) for name, lens in intrinsics.items()}


@dataclass(frozen=True)
class Rig:
    """The result: cameras by id, the reference, and how good it is."""

    reference: str
    cameras: dict[str, RigCamera]
    quality: Quality = field(default_factory=Quality)
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
