"""What an estimate starts from: cameras and what is known of them, the board, the observations, and settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.observations import Observations, Walls
from rgbd_calib.types import Board, DepthBias

N_WEAK_BIAS = 4
"""Coefficients of a depth bias that is not given: offset, scale, curvature, and what bends the curve once more."""


@dataclass(frozen=True)
class BundleParams:
    """Priors where nothing was measured, rules for outliers, and when to stop."""

    sigma_2d_px: float = 0.2
    """First guess; estimated from the residuals."""
    k_depth_per_m: float = 0.002
    """First guess of k in sigma_z = k z^2, for the mean over a corner's cell; estimated."""
    structure: Literal["board", "free"] = "board"
    """board: rigid, as printed, with a bow. free: the corners that cameras share are points of their own."""
    hold: tuple[str, ...] = ()
    """Blocks of unknowns that are held at zero instead, by name."""
    free_intrinsics: bool = True
    free_k3: bool = True
    free_bow: bool = True
    bow_sd_m: float = 0.001
    """Prior of the board's bow: boards are flat to about a millimetre."""
    print_aspect_sd: float = 0.003
    """Prior of the difference of the print's two scales: office printers are off by 0.1 to 0.6 %."""
    print_shear_sd_rad: float = 0.0026
    """Prior of the angle by which the print's axes are from square, 0.15 degrees."""
    weak_focal: float = 0.1
    """Prior of focal lengths that the recording itself determines, as a share of them: only against a singular matrix."""
    weak_centre: float = 0.1
    """The same for the principal point, as a share of the image's width."""
    weak_distortion: float = 0.5
    k3_px: float = 5.0
    """Prior of what k3 moves in the image's corner: few views must not buy a wild polynomial."""
    given_focal: float = 0.005
    """Prior of focal lengths that were given in a file without standard deviations."""
    given_centre: float = 0.005
    given_distortion: float = 0.02
    bias_offset_sd_m: float = 0.010
    """Prior of the depth's offset without a bias recording."""
    bias_scale_sd: float = 0.010
    """Prior of the depth's scale without a bias recording: consumer sensors are good to 1 %."""
    bias_curvature_sd_per_m: float = 0.005
    """Prior of the depth bias's quadratic term without a bias recording."""
    tof_offset_sd_m: float = 0.025
    """The same as bias_offset_sd_m for time of flight, which errs by centimetres, and by more near the camera."""
    tof_scale_sd: float = 0.020
    tof_wiggle_sd_m: float = 0.015
    """Waves of time of flight as long as the range, each of Legendre's polynomials from the second degree on."""
    tape_sd_m: float = 0.002
    """Prior of what all written distances of a camera's walls are off by: one tape, one zero."""
    wall_tilt_sd_rad: float = 0.035
    """Usual of how far all walls of a camera are from square to it, and of how far each is from there, 2 degrees; estimated."""
    wall_bend: float = 0.0003
    """Usual bend of a wall, as a share of its distance at the image's unit rays; estimated."""
    k_wall_per_m: float = 0.002
    """First guess of k in sigma_z = k z^2 for a cell of a wall; estimated."""
    corner_offset_m: float = 0.00005
    """Usual offset of a printed corner from where it should be, each way; estimated."""
    back_shift_sd_m: float = 0.001
    """Prior of the back's sheet beside the front's, each way."""
    back_turn_sd_rad: float = 0.0052
    """Prior of the back's sheet turned against the front's, 0.3 degrees."""
    back_scale_sd: float = 0.001
    """Prior of the back's print larger than the front's: one printer, one day."""
    thickness_sd_m: float = 0.0005
    """Prior of the board's thickness: a ruler."""
    registration_sd_px: float = 2.5
    """Prior of the depth image beside its colour image."""
    registration_scale_sd: float = 0.005
    """Prior of its magnification."""
    registration_turn_sd_rad: float = 0.003
    """Prior of its turn."""
    registration_baseline_sd_m: float = 0.003
    """Prior of what is wrong with the baseline that the driver registers with, each way."""
    depth_tilt_sd_rad: float = 0.003
    """Prior of the depth's axis turned against the colour camera's, each way: what moves its image by a pixel or two."""
    depth_focal_sd: float = 0.01
    """Prior of a depth camera's focal lengths, of the factory or nominal, as a share of them."""
    depth_centre_sd: float = 0.015
    """Prior of its principal point, as a share of the image's width."""
    mount_turn_sd_rad: float = 0.03
    """Prior of how a depth camera stands beside its colour camera: by the factory, or as it was meant."""
    mount_shift_sd_m: float = 0.010
    ripple_m: float = 0.001
    """Usual size of each shape of the depth's error along the range beyond its bias; estimated."""
    field_m: float = 0.010
    """Usual size of the depth's error over the image, of each of its slopes 3 m away; estimated."""
    huber_sigmas: float = 3.0
    max_view_ratio: float = 4.0
    max_depth_sigmas: float = 5.0
    max_rounds: int = 20
    max_iterations: int = 30
    tolerance: float = 1e-9
    """Relative change of the cost that ends the last minimisation."""
    round_tolerance: float = 1e-5
    """The same before, while the weights still change."""
    weight_tolerance: float = 0.005
    """Relative change of any sigma that ends the rounds."""


@dataclass(frozen=True, eq=False)
class MountPrior:
    """A depth camera beside its colour camera; the start of its pose is where it is thought to be."""

    camera: str
    """The colour camera."""
    sd: FloatArray
    """(6,) standard deviations (rad, m) of the left perturbation of T_color_depth in the colour camera's frame."""


@dataclass(frozen=True)
class CameraPrior:
    """What is known of a camera before the bundle."""

    intrinsics: Intrinsics
    intrinsics_sd: FloatArray | None
    """(4 + n,) standard deviations of a given calibration; None: none are known."""
    from_views: bool
    """True where the intrinsics are only a start: the views that they rest on are in the bundle."""
    bias: DepthBias | None
    held: Literal["nothing", "intrinsics", "all"] = "nothing"
    """What is known exactly: intrinsics and depth bias, or the pose too (its start is the pose)."""
    depth_unit_m: float = 0.001
    """Depth comes in whole multiples of it."""
    bias_is_start: bool = False
    """True where the depth bias is only a start: the walls that it rests on are in the bundle."""
    time_of_flight: bool = False
    same_sensor: bool = False
    """True where depth and corners are seen by one sensor, so that nothing can be beside anything."""
    mount: MountPrior | None = None
    """Of a depth camera that is unknown but for its place beside a colour camera; None: a camera by itself."""

    @property
    def given_bias(self) -> DepthBias | None:
        """What is known of the depth bias beside what the bundle has; None where that is nothing."""
        return None if self.bias_is_start else self.bias


@dataclass(frozen=True)
class Setup:
    """What blocks and terms are made from."""

    cameras: tuple[str, ...]
    priors: tuple[CameraPrior, ...]
    reference: str
    T_world_color: FloatArray
    """(C, 4, 4), the start."""
    board: Board
    obs: Observations
    params: BundleParams
    walls: Walls

    @classmethod
    def of(
        cls,
        priors: Mapping[str, CameraPrior],
        reference: str,
        T_world_color: Mapping[str, FloatArray],
        board: Board,
        obs: Observations,
        params: BundleParams,
        walls: Walls | None = None,
    ) -> Setup:
        poses = np.stack([T_world_color[name] for name in priors])
        return cls(tuple(priors), tuple(priors.values()), reference, poses, board, obs, params, walls or Walls.none())

    @property
    def sizes_px(self) -> FloatArray:
        """(C, 2), width and height of the images."""
        return np.array([prior.intrinsics.size_px for prior in self.priors])

    @property
    def intrinsics(self) -> FloatArray:
        """(C, 4 + the longest lens), the start."""
        out = np.zeros((len(self.priors), max(len(prior.intrinsics.vector) for prior in self.priors)))
        for row, prior in zip(out, self.priors, strict=True):
            row[: len(prior.intrinsics.vector)] = prior.intrinsics.vector
        return out

    def wall_rays(self, intrinsics: FloatArray) -> FloatArray:
        """(W, N, 2), of the cells of walls by lenses (C, 4 + the longest); NaN where there is none."""
        out = np.zeros(self.walls.pixels_px.shape)
        for c, prior in enumerate(self.priors):
            mine, start = self.walls.camera == c, prior.intrinsics
            if mine.any():
                lens = start.with_vector(intrinsics[c, : len(start.vector)])
                out[mine] = lens.rays(self.walls.pixels_px[mine])[..., :2]
        return out
