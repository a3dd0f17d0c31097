"""A finished rig's poses refined by the clouds of its cameras, where that makes them better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.depth_error import UNKNOWN_SLOPE
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.clouds import surfaces_of
from rgbd_calib.pipeline.depth_cameras import joined, name_of, split, split_rig
from rgbd_calib.pipeline.details import expectation
from rgbd_calib.pipeline.evaluate import volume_corners
from rgbd_calib.pipeline.held_out_frames import frames_of_calibration
from rgbd_calib.quality import CameraUpdate, ExpectedAlignment
from rgbd_calib.trust.snapshot.cloud_fusion import Fusion, fuse_clouds
from rgbd_calib.trust.snapshot.clouds import GATE_M
from rgbd_calib.trust.snapshot.determined import free_directions
from rgbd_calib.trust.snapshot.motion import DRIFT_SD
from rgbd_calib.trust.uncertainty import FARTHEST_M, NEAREST_M, JointCovariance, joint_of
from rgbd_calib.types import DepthBias, Rig, RigCamera

DISTANCE_M = 2.0
"""Where a standard deviation of poses in millimetres is meant, and free directions are judged."""
_LEAST_GAIN = 0.05
"""Of the expected error: a smaller one is none."""
_CONTRADICTION = 4.0
"""Mean square of what clouds tell against the rig, by both covariances: two deviations in the mean of all directions."""


@dataclass(frozen=True)
class CloudRefinement:
    """The refined rig, and whether it is better."""

    rig: Rig
    before: ExpectedAlignment
    after: ExpectedAlignment
    patches: Mapping[str, int]
    """Surface patches in common, by pair of cameras."""
    moved: Mapping[str, tuple[float, float]]
    """Translation (m) and rotation (rad), by camera."""
    free: Mapping[str, tuple[str, ...]]
    """Directions that the clouds do not determine, by camera."""
    apart: tuple[str, ...]
    """Cameras that have no surface in common with any other."""
    surprise: float
    """Mean square of the difference between clouds and rig, by their covariances; 1 is expected."""

    @property
    def refused(self) -> tuple[str, ...]:
        """Why the rig should stay as it was; empty where it is better now."""
        out = []
        if self.surprise > _CONTRADICTION:
            out.append(
                f"clouds and rig are {np.sqrt(self.surprise):.1f} standard deviations apart, {np.sqrt(_CONTRADICTION):g} allowed: "
                "a camera moved, or depth changed, since the calibration. Calibrate again, or state by how much: --pose-sd MM"
            )
        if self.free:
            named = [f"{camera} ({'; '.join(free)})" for camera, free in self.free.items()]
            out.append(f"the scene leaves cameras free: {', '.join(named)}. Put things in front of them")
        if self.gain_mm < _LEAST_GAIN * self.before.mean_mm:
            out.append(
                f"the clouds add nothing: two cameras are expected to put the same point {self.before.mean_mm:.2f} mm apart by the "
                f"rig as it is, {self.after.mean_mm:.2f} mm with the clouds. Keep the rig"
            )
        return tuple(out)

    @property
    def gain_mm(self) -> float:
        """By which the expected alignment error is smaller."""
        return self.before.mean_mm - self.after.mean_mm


@one_blas_thread
def refine_by_clouds(rig: Rig, recording: Recording, pose_sd_m: float | None = None) -> CloudRefinement:
    """Refine the poses of a rig by the clouds of a recording of any scene.

    Parameters
    ----------
    pose_sd_m : by how much cameras are thought to have moved points `DISTANCE_M` away (RMS), beyond what the rig's file says.

    Raises
    ------
    ConfigError
        The rig was calibrated from this recording.
    CalibrationError
        The rig states no covariance, or no two cameras see the same surfaces.
    """
    given, recording = recording, split(recording)
    if pose_sd_m is not None and recording is not given:
        raise CalibrationError(
            f"{recording.path}: --pose-sd is for depth that is registered to colour; the poses of depth cameras beside their colour "
            "cameras would be lost. Calibrate the rig with this version, and refine it by its own covariance"
        )
    apart_rig = split_rig(rig, recording)
    stated = replace(apart_rig, cameras={name: _with_depth_errors(own) for name, own in apart_rig.cameras.items()})
    joint = _joint(stated, pose_sd_m)
    known = replace(stated, cameras={name: stated.cameras[name] for name in joint.parameters})
    used = frames_of_calibration(rig, given)
    if used and len(used) == len(given.frames):
        raise ConfigError(
            f"{given.path}: all {len(used)} frames were used to calibrate this rig, and say nothing new of it. Record the scene again"
        )
    instants = [*surfaces_of(recording, known, used)]
    found = fuse_clouds(known, joint, instants)
    if found is None:
        raise CalibrationError(
            f"{recording.path}: no two cameras see the same surfaces from the same side. Put things where two cameras see them"
        )
    corners = volume_corners(known)
    seeing = sorted({name for surfaces in instants for name in surfaces})
    before, after = (expectation(r, j, corners, seeing) for r, j in ((known, joint), (found.rig, found.joint)))
    if before is None or after is None:
        raise CalibrationError(
            f"{recording.path}: no point of the working volume is seen by two cameras with depth; nothing to compare. "
            "Calibrate the rig again"
        )
    cameras = apart_rig.cameras | {
        name: replace(apart_rig.cameras[name], T_world_color=own.T_world_color, covariance=own.covariance)
        for name, own in found.rig.cameras.items()
    }
    in_pairs = {name for pair in found.patches for name in pair}
    devices = {name.removesuffix(name_of("")) for name in in_pairs}
    seen = {name: own for name, own in cameras.items() if name in recording.cameras}
    merged = joined(replace(apart_rig, cameras=seen), recording.cameras, found.joint).cameras
    return CloudRefinement(
        _with_reports(rig, {name: merged.get(name, cameras[name]) for name in rig.cameras}, given, after),
        before,
        after,
        {" - ".join(pair): count for pair, count in found.patches.items()},
        {name: se3.moved(rig.cameras[name].T_world_color, cameras[name].T_world_color) for name in rig.cameras},
        _free(found, in_pairs),
        tuple(name for name in rig.cameras if name not in devices),
        found.surprise,
    )


def _with_depth_errors(camera: RigCamera) -> RigCamera:
    """With a depth bias that may be anything usual, where none is known."""
    if camera.depth_bias is not None:
        return camera
    unknown = np.diag([DRIFT_SD[0], UNKNOWN_SLOPE]) ** 2
    return replace(camera, depth_bias=DepthBias((0.0, 0.0), NEAREST_M, FARTHEST_M, 0.0, unknown))


def _joint(rig: Rig, pose_sd_m: float | None) -> JointCovariance:
    joint = joint_of(rig)
    if joint is None and pose_sd_m is None:
        raise CalibrationError(
            "the rig file states no joint covariance of its cameras, by which to weigh clouds against it. Calibrate it with "
            "this version, or state what the poses are off by: --pose-sd MM"
        )
    joint = joint or JointCovariance.of_parts(rig)
    if missing := [name for name in joint.parameters if name not in rig.cameras]:
        raise CalibrationError(
            f"quality.expected_alignment.joint is of other cameras: {', '.join(missing)}. Calibrate again"
        )
    return joint if pose_sd_m is None else joint.loosened(rig.reference, pose_sd_m, DISTANCE_M)


def _free(found: Fusion, cameras: set[str]) -> dict[str, tuple[str, ...]]:
    """Directions, in each camera's frame, in which clouds alone leave it anywhere within the reach of their comparison."""
    out = {}
    for name, covariance in found.by_clouds.items():
        Ad = se3.adjoint(se3.inverse(found.rig.cameras[name].T_world_color))
        free = free_directions(Ad @ covariance @ Ad.T, DISTANCE_M, GATE_M)
        if free and name in cameras:
            out[name] = free
    return out


def _with_reports(rig: Rig, refined: Mapping[str, RigCamera], recording: Recording, after: ExpectedAlignment) -> Rig:
    reports = []
    for name, own in refined.items():
        moved_m, turned_rad = se3.moved(rig.cameras[name].T_world_color, own.T_world_color)
        reports.append(
            CameraUpdate(
                name,
                by="clouds",
                recording=str(recording.path),
                recording_sha256=recording.digest(),
                moved_mm=1e3 * moved_m,
                turned_deg=float(np.degrees(turned_rad)),
            )
        )
    quality = replace(
        rig.quality,
        expected_alignment=after,
        alignment_on_recording=None,
        residuals_sha256=None,
        updates=(*(rig.quality.updates or ()), *reports),
    )
    return replace(rig, cameras=dict(refined), quality=quality)
