"""Two rigs of the same cameras side by side: what moved, what changed, and which of them expects less error.

Poses are compared in the frame of one camera that both have. The covariance of a motion is the sum of the two rigs', which
holds for rigs of independent recordings only: errors of rigs that share images are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_sf
from rgbd_calib.quality import AlignmentNumbers, ExpectedAlignment
from rgbd_calib.report import numbers
from rgbd_calib.report.camera_pages import FINE, along, change_at, pixels_over
from rgbd_calib.report.error_map import points_of
from rgbd_calib.trust.uncertainty import observe, place
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Rig, RigCamera

UNLIKELY = 1e-3
"""Of a motion by chance: below it a camera has moved."""
ALIKE = 0.05
"""Expected errors that differ by less are called the same: a covariance of some hundred residuals is no surer."""
DEPTHS_M = (0.75, 1.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class PoseDifference:
    """One camera of two rigs, the second less the first."""

    camera: str
    mm: float
    sd_mm: float | None
    """Along the motion; None where a rig does not know it, or the two are not independent."""
    deg: float
    sd_deg: float | None
    chance: float | None
    """Probability of a motion that is at least as large, if nothing moved."""
    step_m: FloatArray
    """(3,), of the optical centre, in the common frame."""

    @property
    def moved(self) -> bool | None:
        """None where it cannot be decided."""
        return None if self.chance is None else self.chance < UNLIKELY

    def __str__(self) -> str:
        mm, deg = (f" ± {sd:.{n}f}" if sd is not None else "" for sd, n in ((self.sd_mm, 2), (self.sd_deg, 3)))
        result = {None: "not tested", True: "moved", False: "within the deviations"}[self.moved]
        return f"{self.mm:.2f}{mm} mm, {self.deg:.3f}{deg} deg: {result}"


@dataclass(frozen=True)
class Changed:
    """Lens and depth of one camera, the second less the first."""

    camera: str
    lens_px: FloatArray
    """(4,), fx, fy, cx, cy."""
    lens_sd_px: FloatArray | None
    """(4,); None where a rig does not know it, or the two are not independent."""
    rms_px: float
    """Over the image: where a ray is seen, NaN where the images have different sizes."""
    depth_mm: tuple[tuple[float, float, float], ...]
    """(depth in m, mean and RMS in mm over the image) of the correction of the depth; empty where not both have it."""
    effect_mm: float | None
    """RMS distance between where the two rigs put a point of the first's volume that this camera sees; pose, lens and depth
    together. None without a volume, or where the camera sees none of it."""


@dataclass(frozen=True)
class Side:
    """What one rig says of itself."""

    name: str
    verdict: Verdict
    expected: ExpectedAlignment | None
    measured: AlignmentNumbers | None
    views: int | None
    recording: str


@dataclass(frozen=True)
class Comparison:
    """The second rig against the first."""

    sides: tuple[Side, Side]
    frame: str
    """The camera in whose frame poses are compared."""
    motions: tuple[PoseDifference, ...]
    changed: tuple[Changed, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]
    """Cameras that only one has."""
    shared_images: int
    """Colour images that both were made from."""
    untested: str
    """Why no motion is tested; empty where they are."""
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
            f"{names[1]}: at least one camera of {names[0]} ({', '.join(a.cameras)}) was expected, {', '.join(b.cameras)} found. "
            "Compare rigs whose cameras have the same names"
        )
    frame = a.reference if a.reference in shared else shared[0]
    images = shared_images(a, b)
    independent = not images and not _same_recording(a, b)
    untested = ""
    if not independent:
        untested = (
            "The two rigs are from the same images, so that their errors are correlated: the covariance of the difference is not "
            "known, and no motion is tested."
        )
    elif not frame == a.reference == b.reference:
        untested = (
            f"The reference cameras differ ({a.reference}, {b.reference}), and covariances of poses are relative to the "
            "reference: no motion is tested. Calibrate both with the same --reference."
        )
    sides = (_side(a, names[0], verdicts[0]), _side(b, names[1], verdicts[1]))
    return Comparison(
        sides,
        frame,
        tuple(_motion(a, b, name, frame, bool(untested)) for name in shared if name != frame),
        tuple(_changed(a, b, name, frame, independent) for name in shared),
        (tuple(n for n in a.cameras if n not in shared), tuple(n for n in b.cameras if n not in shared)),
        images,
        untested,
        _which(sides),
    )


def shared_images(a: Rig, b: Rig) -> int:
    """Colour images, by their contents, that both rigs were made from."""
    first, second = (
        {digest for own in rig.provenance.get("images_sha256", {}).values() for digest in own.values()}
        for rig in (a, b)
    )
    return len(first & second)


def _same_recording(a: Rig, b: Rig) -> bool:
    digest = a.provenance.get("recording_sha256")
    return digest is not None and digest == b.provenance.get("recording_sha256")


def in_frame(rig: Rig, camera: str) -> Rig:
    """The rig with one camera's frame as its world; covariances of the poses go with it."""
    T = se3.inverse(rig.cameras[camera].T_world_color)
    Ad = se3.adjoint(T)
    cameras = {
        name: replace(own, T_world_color=T @ own.T_world_color, covariance=Ad @ own.covariance @ Ad.T)
        for name, own in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def _side(rig: Rig, name: str, verdict: Verdict) -> Side:
    views = rig.quality.views_used
    return Side(
        name,
        verdict,
        rig.quality.expected_alignment,
        rig.quality.measured,
        sum(views.values()) if views else None,
        str(rig.provenance.get("recording", "unknown")),
    )


def _motion(a: Rig, b: Rig, name: str, frame: str, untested: bool) -> PoseDifference:
    one, two = (in_frame(rig, frame).cameras[name] for rig in (a, b))
    center = one.T_world_color[:3, 3]
    step, turn = two.T_world_color[:3, 3] - center, so3.log(two.T_world_color[:3, :3] @ one.T_world_color[:3, :3].T)
    mm, deg = 1e3 * float(np.linalg.norm(step)), float(np.degrees(np.linalg.norm(turn)))
    if untested or not (np.any(one.covariance) and np.any(two.covariance)):
        return PoseDifference(name, mm, None, deg, None, None, step)
    J = np.eye(6)
    J[3:, :3] = -so3.hat(center)  # of turn and centre, by the left perturbation
    C = J @ (one.covariance + two.covariance) @ J.T
    d = np.concatenate([turn, step])
    chance = chi2_sf(d @ np.linalg.pinv(C, rcond=1e-12, hermitian=True) @ d, 6)
    return PoseDifference(
        name, mm, 1e3 * along(step, C[3:, 3:]), deg, float(np.degrees(along(turn, C[:3, :3]))), chance, step
    )


def _changed(a: Rig, b: Rig, name: str, frame: str, independent: bool) -> Changed:
    one, two = a.cameras[name], b.cameras[name]
    deviations = [own.statistics.intrinsics_sd for own in (one, two)]
    sd_px = None
    if independent and all(deviations):
        sd_px = np.hypot(*(np.asarray(d, float)[:4] for d in deviations))
    rms_px = float("nan")
    if (one.intrinsics.width, one.intrinsics.height) == (two.intrinsics.width, two.intrinsics.height):
        rms_px = _rms(change_at(two.intrinsics, one.intrinsics, pixels_over(one.intrinsics, FINE)[2]))
    difference = two.intrinsics.vector[:4] - one.intrinsics.vector[:4]
    return Changed(name, difference, sd_px, rms_px, _depths(one, two), _effect_mm(a, b, name, frame))


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
    failed = [side.name for side in sides if side.verdict.level == "untrusted"]
    if len(failed) == 2:
        return "Trust neither: a self-check failed in both, so that their expected errors are not comparable."
    if failed:
        other = next(side.name for side in sides if side.name not in failed)
        return f"{other} is better: a self-check failed in {failed[0]}, whose expected error is not valid."
    unknown = [side.name for side in sides if side.expected is None]
    if unknown:
        return f"It is not known which is better: no expected error in {' and '.join(unknown)}."
    (first, a), (second, b) = ((side.name, side.expected) for side in sides if side.expected is not None)
    if a.of != b.of:
        counts = f"the expected error of {first} counts {a.of.value}, that of {second} {b.of.value}"
        return f"It is not known which is better: {counts}."
    (better, less), (worse, more) = sorted([(first, a), (second, b)], key=lambda row: row[1].mean_mm)
    if more.mean_mm - less.mean_mm < ALIKE * more.mean_mm:
        return f"Both expect about the same error: {_mm(a)} and {_mm(b)} in the mean, each over its own volume."
    return f"{better} expects less error: {_mm(less)} in the mean, {worse} {_mm(more)}, each over its own volume."


def _mm(expected: ExpectedAlignment) -> str:
    mean = expected.mean_mm
    return f"{mean:.0f} mm" if mean >= 100 else f"{mean:.2f} mm"
