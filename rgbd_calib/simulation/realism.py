"""How large the errors of real prints, sensors and walls are that a simulation draws.

Each size is one standard deviation unless it says otherwise. They come from what is made and sold:

* Prints. Office printers stretch a page by 0.1 to 0.6 % along one side; a bend of 1 mm in a plate of half a metre and
  the offset of a second sheet are what hands leave. Free targets are common because of it (Strobl and Hirzinger 2011).
* Depth. Structured light errs in disparity, by a pattern over the image that is the device's own (Herrera, Kannala,
  Heikkila 2012); time of flight errs along the range (Sarbolandi, Lefloch, Kolb 2015).
* Images. Exposure is automatic, focus is somewhere, light changes.
* Registration. A factory's idea of both cameras leaves one or two pixels and some per mille of scale.

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
    """Sizes of the errors; zeros: none."""

    print_aspect: float = 0.003
    """Width over height of a printed square, less one; its area is kept."""
    print_shear_rad: float = float(np.radians(0.15))
    """Of the angle between the columns and the rows."""
    print_offset_m: float = 0.05e-3
    """RMS of each coordinate of the corners' own offsets, which are smooth over the sheet; not a deviation."""
    print_scale: float = 0.0
    """Of the length of a square's side, relative: what people's rulers are off by."""
    plate_bow_m: float = 1.0e-3
    """From the middle of the plate to its edges."""
    back_shift_m: float = 1.0e-3
    """The back's sheet beside the front's, along each side."""
    back_turn_rad: float = float(np.radians(0.3))

    field_m: float = 0.009
    """RMS over the image and 0.8 to 3 m of what a camera's depth errs by besides its bias; cameras differ by a fifth. Time
    of flight has 0.6 of it."""
    stray_light: float = 0.02
    """Time of flight: share of the light that comes over other ways (multipath, and in the lens); not a deviation."""
    drift_m: float = 0.005
    """Time of flight: what ranges are off by when the device is cold."""

    registration_px: float = 1.5
    """How far the depth image lies beside its colour image, 1/3 more or less; not a deviation."""
    registration_scale: float = 0.004
    """Its magnification, less one."""
    registration_move_m: float = 0.7e-3
    """What is wrong with the factory's baseline, each way: a shift that falls with the range."""
    registration_turn_rad: float = float(np.radians(0.05))
    """About each axis."""
    factory_focal: float = 0.003
    """Depth that is not registered: of its focal lengths as the factory states them, relative."""
    factory_centre_px: float = 1.5
    factory_move_m: float = 1.5e-3
    """Of its place beside the colour camera, each way."""
    factory_turn_rad: float = float(np.radians(0.2))

    wall_tilt_rad: float = float(np.radians(2.0))
    """Most that a wall of a bias recording is out of square; not a deviation."""
    tape_m: float = 0.002
    """Of a wall's distance as written down."""
    tape_common_m: float = 0.0015
    """The same for all walls of a recording: one tape, one zero."""

    light_change: float = 0.25
    """Of the light in the room from instant to instant, relative."""
    light_slope: float = 0.12
    """How uneven it is, over some metres."""
    exposure_error: float = 0.10
    """Of auto exposure, relative."""
    defocus_px_m: float = 1.1
    """Diameter of the disc that a point is blurred to, for each 1/m that it is from focus; not a deviation."""

    def has(self, part: Part) -> bool:
        """Is any size of this part more than zero?"""
        return any(getattr(self, name) for name in _SIZES[part])

    def without(self, *parts: Part) -> Realism:
        """The same with these parts exact."""
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
"""Nothing wrong but lenses, bias and noise."""
