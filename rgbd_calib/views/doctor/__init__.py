"""What is wrong with a recording before any calibration: measures of images, and checks over all of them."""

from rgbd_calib.views.doctor.checks import (
    DoctorParams,
    check_consistency,
    check_depth,
    check_depth_unit,
    check_empty,
    check_exposure,
    check_frames,
    check_sharpness,
    check_stems,
    check_timestamps,
)
from rgbd_calib.views.doctor.findings import RecordingFinding, listed
from rgbd_calib.views.doctor.measures import (
    ImageMeasures,
    ViewMeasures,
    hull_mask,
    measure_image,
    measure_view,
    square_px,
    texture_of,
)

__all__ = [
    "DoctorParams",
    "ImageMeasures",
    "RecordingFinding",
    "ViewMeasures",
    "check_consistency",
    "check_depth",
    "check_depth_unit",
    "check_empty",
    "check_exposure",
    "check_frames",
    "check_sharpness",
    "check_stems",
    "check_timestamps",
    "hull_mask",
    "listed",
    "measure_image",
    "measure_view",
    "square_px",
    "texture_of",
]
