"""Magnitudes of the errors that a simulation draws for prints, sensors, walls and images.

Each value is one standard deviation unless stated otherwise. Sources:

* Prints: office printers change the aspect ratio of a page by 0.1 to 0.6 %. A bow of 1 mm over half a metre and a back sheet
  misaligned by a millimetre are typical of boards glued by hand; calibration with an unknown target shape is common for this
  reason (Strobl and Hirzinger 2011).
* Depth: structured light has a disparity error that is a fixed pattern over the image (Herrera, Kannala, Heikkila 2012); time
  of flight has an error periodic in range (Sarbolandi, Lefloch, Kolb 2015).
* Registration: factory calibrations leave one or two pixels of shift and some per mille of scale.
* Images: auto exposure, fixed focus, changing light.

References
----------
K. Strobl, G. Hirzinger, More accurate pinhole camera calibration with imperfect planar target, ICCV workshops 2011.
D. Herrera, J. Kannala, J. Heikkila, Joint depth and color camera calibration with distortion correction, IEEE PAMI
34(10), 2012. H. Sarbolandi, D. Lefloch, A. Kolb, Kinect range sensing: structured-light versus time-of-flight Kinect,
CVIU 139, 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

Part = Literal["print", "depth_field", "registration", "walls", "images", "multipath", "drift"]


@dataclass(frozen=True)
class Realism:
    """Magnitudes of the errors; zero disables one."""

    print_aspect: float = 0.003
    """Aspect ratio of a printed square, minus one; the area is preserved."""
    print_shear_rad: float = float(np.radians(0.15))
    """Deviation from 90 degrees of the angle between columns and rows."""
    print_offset_m: float = 0.05e-3
    """RMS of each coordinate of the corner offsets, which are smooth over the sheet (fixed, not a standard deviation)."""
    print_scale: float = 0.0
    """Relative error of the stated square size."""
    plate_bow_m: float = 1.0e-3
    """Sagitta of the plate, centre to edge."""
    back_shift_m: float = 1.0e-3
    """Misalignment of the back sheet, along each side."""
    back_turn_rad: float = float(np.radians(0.3))

    field_m: float = 0.009
    """RMS of the depth error over the image and 0.8 to 3 m, bias excluded; 20 % variation between cameras, 0.6 times as much for
    time of flight."""
    stray_light: float = 0.02
    """Time of flight: share of stray light and multipath (fixed, not a standard deviation)."""
    drift_m: float = 0.005
    """Time of flight: range error of the cold device."""

    registration_px: float = 1.5
    """Shift of the depth image against its colour image, uniform between 2/3 and 4/3 of this."""
    registration_scale: float = 0.004
    """Relative scale error of the depth image."""
    registration_move_m: float = 0.7e-3
    """Baseline error along each axis: a shift inversely proportional to the range."""
    registration_turn_rad: float = float(np.radians(0.05))
    """Rotation error about each axis."""
    factory_focal: float = 0.003
    """Unregistered depth: relative error of the stated focal lengths."""
    factory_centre_px: float = 1.5
    factory_move_m: float = 1.5e-3
    """Unregistered depth: error of the stated translation, along each axis."""
    factory_turn_rad: float = float(np.radians(0.2))

    wall_tilt_rad: float = float(np.radians(2.0))
    """Largest tilt of a wall of the bias recording (a maximum, not a standard deviation)."""
    tape_m: float = 0.002
    """Error of each written wall distance."""
    tape_common_m: float = 0.0015
    """Error common to all walls of a session: same tape, same zero."""

    light_change: float = 0.25
    """Relative change of the illumination from frame to frame."""
    light_slope: float = 0.12
    """Relative non-uniformity of the illumination over some metres."""
    exposure_error: float = 0.10
    """Relative error of auto exposure."""
    defocus_px_m: float = 1.1
    """Diameter of the blur disc per dioptre of defocus, px m (fixed, not a standard deviation)."""

    def has(self, part: Part) -> bool:
        """Whether any magnitude of this part is non-zero."""
        return any(getattr(self, name) for name in _SIZES[part])

    def without(self, *parts: Part) -> Realism:
        """A copy without the errors of these parts."""
        sizes = [name for part in parts for name in _SIZES[part]]
        return replace(self, **dict.fromkeys(sizes, 0.0))


_SIZES: dict[Part, tuple[str, ...]] = {
    "print": (
        "print_aspect", "print_shear_rad", "print_offset_m", "print_scale", "plate_bow_m", "back_shift_m", "back_turn_rad",
    ),
    "depth_field": ("field_m",),
    "registration": (
        "factory_focal", "factory_centre_px", "factory_move_m", "factory_turn_rad", "registration_px", "registration_scale", "registration_move_m", "registration_turn_rad",
    ),
    "walls": ("wall_tilt_rad", "tape_m", "tape_common_m"),
    "multipath": ("stray_light",),
    "drift": ("drift_m",),
    "images": ("light_change", "light_slope", "exposure_error", "defocus_px_m"),
}  # fmt: skip

IDEAL = Realism().without(*_SIZES)
"""Lens distortion, depth bias and noise only."""
