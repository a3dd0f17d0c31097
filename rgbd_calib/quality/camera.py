"""What is said of a camera beside its parameters."""

from __future__ import annotations

from dataclasses import dataclass

from rgbd_calib.quality.record import Record


@dataclass(frozen=True, slots=True)
class CameraStatistics(Record):
    """Noise, residuals and counts of what a camera was calibrated from."""

    intrinsics_sd: tuple[float, ...] | None = None
    """Standard deviations of fx, fy, cx, cy and the lens's coefficients."""
    sigma_2d_px: float | None = None
    rms_px: float | None = None
    views: int | None = None
    corners: int | None = None
    corners_with_depth: int | None = None
    sigma_3d_m: float | None = None
    sigma_3d_model: str | None = None
    """What `sigma_3d_m` is the standard deviation of."""
    depth_k_per_m: float | None = None
    """sigma_z = k z^2."""
    depth_rms_m: float | None = None
    depth_statistics: CameraStatistics | None = None
    """Of its depth camera, where depth has a geometry of its own."""
