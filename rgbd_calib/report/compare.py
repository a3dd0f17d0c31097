"""Two rigs of the same cameras side by side: what moved, what changed, and which of them expects less error.

Poses are compared in the frame of one camera that both have. Deviations are those of the difference, as if the two rigs were
made from independent recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report import numbers
from rgbd_calib.report.camera_pages import FINE, along, change_at, pixels_over
from rgbd_calib.report.error_map import points_of
from rgbd_calib.trust.uncertainty import observe, place
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Rig, RigCamera

UNLIKELY = 1e-3
"""Of a motion by chance: below it a camera has moved."""
DEPTHS_M = (0.75, 1.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class Moved:
    """One camera of two rigs, the second less the first."""

    camera: str
    mm: float
    sd_mm: float | None
    """None where a rig does not know it."""
    deg: float
    sd_deg: float | None
    chance: float | None
    """Probability of a motion that is at least as large, if nothing moved."""

    @property
    def word(self) -> str:
        if self.chance is None:
            return "not known: a rig has no deviation of this pose"
        return "moved" if self.chance < UNLIKELY else "within the deviations"


@dataclass(frozen=True)
class Changed:
    """Lens and depth of one camera, the second less the first."""

    camera: str
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    sd_px: tuple[float, float, float, float] | None
    rms_px: float
    """Over the image: where a ray is seen, NaN where the images have different sizes."""
    depth_mm: tuple[tuple[float, float, float], ...]
    """(depth in m, mean and RMS in mm over the image) of the correction of the depth; empty where not both have it."""
    effect_mm: float | None
    """RMS of how far apart the two rigs put a point of the first's volume that this camera sees; pose, lens and depth together."""


@dataclass(frozen=True)
class Side:
    """What one rig says of itself."""

    name: str
    verdict: Verdict
    expected_mm: tuple[float, float, float] | None
    """Mean, 95 %, worst; None where not known."""
    measured_mm: float | None
    views: int | None
    recording: str


@dataclass(frozen=True)
class Comparison:
    """The second rig against the first."""

    sides: tuple[Side, Side]
    frame: str
    """The camera in whose frame poses are compared."""
    moved: tuple[Moved, ...]
    changed: tuple[Changed, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]
    """Cameras that only one has."""
    same_recording: bool
    sentence: str
    """Which expects less error."""


def compare(rigs: tuple[Rig, Rig], names: tuple[str, str], verdicts: tuple[Verdict, Verdict]) -> Comparison:
    """Compare two rigs.

    Raises
    ------
    ConfigError
        They have no camera in common.
    """
    a, b = rigs
    shared = [name for name in a.cameras if name in b.cameras]
    if not shared:
        raise ConfigError(
            f"{names[1]}: cameras {', '.join(b.cameras)} seen, {names[0]} has {', '.join(a.cameras)}; at least one in common is "
            "needed. Are they rigs of the same cameras?"
        )
    frame = a.reference if a.reference in shared else shared[0]
    sides = (_side(a, names[0], verdicts[0]), _side(b, names[1], verdicts[1]))
    hashes = [rig.provenance.get("recording_sha256") for rig in rigs]
    return Comparison(
        sides,
        frame,
        tuple(_moved(a, b, name, frame) for name in shared if name != frame),
        tuple(_changed(a, b, name, frame) for name in shared),
        (tuple(n for n in a.cameras if n not in shared), tuple(n for n in b.cameras if n not in shared)),
        hashes[0] is not None and hashes[0] == hashes[1],
        _which(sides),
    )


def in_frame(rig: Rig, camera: str) -> Rig:
    """The rig with one camera's frame as its world."""
    T = se3.inverse(rig.cameras[camera].T_world_color)
    cameras = {
        name: RigCamera(
            own.intrinsics,
            T @ own.T_world_color,
            own.covariance,
            own.depth_bias,
            own.statistics,
            own.depth_field,
            own.depth_camera,
        )
        for name, own in rig.cameras.items()
    }
    return Rig(camera, cameras, rig.quality, rig.provenance)


def _side(rig: Rig, name: str, verdict: Verdict) -> Side:
    expected = rig.quality.get("expected_alignment")
    measured = rig.quality.get("alignment_on_recording", {}).get("all", {})
    views = rig.quality.get("views_used")
    return Side(
        name,
        verdict,
        (expected["mean_mm"], expected["p95_mm"], expected["worst_mm"]) if expected else None,
        measured.get("median_mm"),
        sum(views.values()) if views else None,
        str(rig.provenance.get("recording", "unknown")),
    )


def _pose_covariance(rig: Rig, name: str, frame: str) -> FloatArray | None:
    """(6, 6) of a camera's left perturbation in the frame of camera `frame`; None where the rig does not know it.

    Covariances are those against the rig's reference, in the world; so the frame must be the reference's.
    """
    own = rig.cameras[name]
    if frame != rig.reference or not np.any(own.covariance):
        return None
    Ad = se3.adjoint(se3.inverse(rig.cameras[frame].T_world_color))
    return np.asarray(Ad @ own.covariance @ Ad.T)


def _moved(a: Rig, b: Rig, name: str, frame: str) -> Moved:
    T_a, T_b = (in_frame(rig, frame).cameras[name].T_world_color for rig in (a, b))
    center = T_a[:3, 3]
    step, turn = T_b[:3, 3] - center, so3.log(T_b[:3, :3] @ T_a[:3, :3].T)
    covariances = [_pose_covariance(rig, name, frame) for rig in (a, b)]
    known = [C for C in covariances if C is not None]
    mm, deg = 1e3 * float(np.linalg.norm(step)), float(np.degrees(np.linalg.norm(turn)))
    if len(known) < 2:
        return Moved(name, mm, None, deg, None, None)
    J = np.eye(6)
    J[3:, :3] = -so3.hat(center)  # of turn and centre, by the left perturbation
    C = J @ (known[0] + known[1]) @ J.T
    d = np.concatenate([turn, step])
    chance = float(chi2.sf(d @ np.linalg.pinv(C, rcond=1e-12, hermitian=True) @ d, 6))
    return Moved(name, mm, 1e3 * along(step, C[3:, 3:]), deg, float(np.degrees(along(turn, C[:3, :3]))), chance)


def _changed(a: Rig, b: Rig, name: str, frame: str) -> Changed:
    one, two = a.cameras[name], b.cameras[name]
    fx, fy, cx, cy = (float(v) for v in two.intrinsics.vector[:4] - one.intrinsics.vector[:4])
    deviations = [own.statistics.get("intrinsics_sd") for own in (one, two)]
    sd = None
    if all(d is not None for d in deviations):
        fx_sd, fy_sd, cx_sd, cy_sd = np.hypot(*(np.asarray(d, float)[:4] for d in deviations)).tolist()
        sd = (fx_sd, fy_sd, cx_sd, cy_sd)
    rms_px = float("nan")
    if (one.intrinsics.width, one.intrinsics.height) == (two.intrinsics.width, two.intrinsics.height):
        rms_px = _rms(change_at(two.intrinsics, one.intrinsics, pixels_over(one.intrinsics, FINE)[2]))
    return Changed(name, fx, fy, cx, cy, sd, rms_px, _depths(one, two), _effect_mm(a, b, name, frame))


def _depths(one: RigCamera, two: RigCamera) -> tuple[tuple[float, float, float], ...]:
    """Of reported depths where both rigs have data."""
    if one.depth_bias is None or two.depth_bias is None:
        return ()
    low = max(own.depth_bias.measured_m[0] for own in (one, two) if own.depth_bias is not None)
    high = min(own.depth_bias.measured_m[1] for own in (one, two) if own.depth_bias is not None)
    pixels = pixels_over(one.depth_sensor.camera.intrinsics, FINE)[2]
    out = []
    for z_m in DEPTHS_M:
        if low <= z_m <= high:
            reported = np.full(pixels.shape[:-1], z_m)
            mm = 1e3 * (two.depth_sensor.correct(pixels, reported) - one.depth_sensor.correct(pixels, reported))
            out.append((z_m, float(np.mean(mm)), float(np.sqrt(np.mean(mm**2)))))
    return tuple(out)


def _effect_mm(a: Rig, b: Rig, name: str, frame: str) -> float | None:
    points_m, _ = points_of(a.quality)
    if not len(points_m):
        return None
    first, second = in_frame(a, frame), in_frame(b, frame)
    points_m = se3.transform(first.cameras[a.reference].T_world_color, points_m)
    seen = observe(first, name, points_m)
    apart = place(second, name, seen.only(seen.seen)) - place(first, name, seen.only(seen.seen))
    return 1e3 * _rms(apart) if np.isfinite(apart).any() else None


def _rms(vectors: FloatArray) -> float:
    """Root mean square length of vectors (..., n), of those that are finite."""
    return numbers.rms(np.linalg.norm(vectors, axis=-1).ravel())


def _which(sides: Sequence[Side]) -> str:
    distrusted = [side.name for side in sides if side.verdict.level == "untrusted"]
    if len(distrusted) == 2:
        return "Neither is to be trusted: a self-check failed in both, so that their expected errors do not compare."
    if distrusted:
        other = (
            next(side.name for side in sides if side.name not in distrusted)
            if sides[0].name != sides[1].name
            else "the other"
        )
        return f"Take {other}: a self-check failed in {distrusted[0]}, and its expected error leaves something out."
    if any(side.expected_mm is None for side in sides):
        unknown = [side.name for side in sides if side.expected_mm is None]
        return f"Which expects less error is not known: {' and '.join(unknown)} has no expected error."
    (first, a), (second, b) = ((side.name, side.expected_mm[0]) for side in sides if side.expected_mm)
    if abs(a - b) < 0.05 * max(a, b):
        return f"Both expect about the same error: {a:.2f} mm and {b:.2f} mm in the mean, each over its own volume."
    better, worse = ((first, a), (second, b)) if a < b else ((second, b), (first, a))
    return f"{better[0]} expects less error: {better[1]:.2f} mm in the mean, {worse[0]} {worse[1]:.2f} mm, each over its own volume."
