"""All cameras of a rig by their snapshots: which of them moved against the others, and did the rig move as a whole?

The scene is one more node beside the cameras, that never moved by definition. Pairs of nodes are compared as pairs of cameras are
by a board (:mod:`..displacement.verdict`), and the smallest set of nodes that explains the broken pairs is what moved. Where
the scene itself is in that set, the whole rig was shifted: its cameras agree with each other and not with the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.linear import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.displacement import LocatedCameras, PairError, VerdictParams, judge
from rgbd_calib.trust.snapshot.camera import CameraMotion
from rgbd_calib.trust.snapshot.determined import displacement_m, free_directions, working_points
from rgbd_calib.types import Rig

SCENE = "the scene"


@dataclass(frozen=True)
class SnapshotParams:
    """When cameras count as moved, and when a scene cannot tell."""

    distance_m: float = 2.0
    """Working distance: displacements are those of points this far away."""
    pairs: VerdictParams = field(default_factory=VerdictParams)
    sd_share: float = 1 / 3
    """A camera is undetermined where its deviation at the working distance is more than this share of the limit."""
    least_unchanged: float = 0.15
    """Share of the scene that must be unchanged: below, what is the scene and what is a thing in it?"""
    clear_ratio: float = 0.7
    """Another motion with this much of the support, in depth and in pixels, is a rival."""


@dataclass(frozen=True)
class CameraVerdict:
    """One camera."""

    camera: str
    moved: bool
    """Against the cameras that did not move."""
    T_old_new: FloatArray
    """(4, 4), p_old = T_old_new p_new, the motion of the whole rig taken off."""
    covariance: FloatArray
    """(6, 6) of the left perturbation (rad, m) in the camera's old frame."""
    displacement_m: float
    """RMS over the image at the working distance."""
    displacement_sd_m: float
    shift_m: float
    """Of the optical centre."""
    shift_sd_m: float
    turn_rad: float
    turn_sd_rad: float
    motion: CameraMotion


@dataclass(frozen=True)
class RigVerdict:
    cameras: dict[str, CameraVerdict]
    """Those whose motion is determined."""
    undetermined: dict[str, str]
    """Why, by camera."""
    missing: tuple[str, ...]
    """Cameras of the rig that lack images in one of the snapshots."""
    moved: tuple[str, ...]
    rivals: tuple[tuple[str, ...], ...]
    """Other sets of cameras that explain the same."""
    T_world_moved: FloatArray | None
    """(4, 4), motion of the whole rig in the old world, where it moved."""
    pairs: tuple[PairError, ...]
    params: SnapshotParams

    @property
    def holds(self) -> bool:
        """Every camera was checked, and none moved against the others."""
        return not self.moved and not self.undetermined and not self.missing and bool(self.cameras)


def judge_motions(rig: Rig, motions: Mapping[str, CameraMotion], params: SnapshotParams) -> RigVerdict:
    """Judge the cameras of a rig by their motions between two snapshots."""
    missing = tuple(name for name in rig.cameras if name not in motions)
    undetermined = {name: why for name, m in motions.items() if (why := _why_undetermined(rig, m, params))}
    known = {name: m for name, m in motions.items() if name not in undetermined}
    if not known:
        return RigVerdict({}, undetermined, missing, (), (), None, (), params)
    verdict = judge(_as_poses(rig, known, params), (*known, SCENE), params.pairs)
    moved = tuple(name for name in verdict.moved if name != SCENE)
    whole = SCENE in verdict.moved and len(known) > 1
    if len(known) == 1 and verdict.moved:  # a camera alone: only the scene is there to compare with
        moved, whole = tuple(known), False
    still = [name for name in known if name not in moved]
    D, C = _common(rig, known, still) if whole else (np.eye(4), np.zeros((6, 6)))
    cameras = {name: _of_camera(rig, m, name in moved, D, C, params) for name, m in known.items()}
    rivals = tuple(r for r in verdict.rivals if SCENE not in r) if len(known) > 1 else ()
    pairs = tuple(p for p in verdict.pairs if SCENE not in p.cameras)
    return RigVerdict(cameras, undetermined, missing, moved, rivals, D if whole else None, pairs, params)


def _why_undetermined(rig: Rig, motion: CameraMotion, params: SnapshotParams) -> str:
    """Empty where the motion is determined."""
    estimate, lens = motion.motion, rig.cameras[motion.camera].intrinsics
    limit_m = params.sd_share * params.pairs.max_m
    sd_m = displacement_m(estimate.T_old_new, estimate.covariance, working_points(lens, params.distance_m))[1]
    free = free_directions(estimate.covariance, params.distance_m, limit_m)
    if sd_m > limit_m:
        named = "; ".join(free) if free else "all directions together"
        if np.abs(estimate.correlation[:, :2]).max() > 0.9:
            named += " (some trade places with a drift of the depth)"
        return (
            f"the scene does not determine the motion: {1e3 * sd_m:.1f} mm at {params.distance_m:g} m, {1e3 * limit_m:.1f} mm "
            f"allowed; free: {named}"
        )
    if motion.unchanged_share < params.least_unchanged:
        return (
            f"{100 * motion.unchanged_share:.0f} % of the scene is unchanged, {100 * params.least_unchanged:.0f} % needed to "
            "tell the scene from what moved in it"
        )
    if motion.rival > params.clear_ratio:
        return (
            f"two motions fit the scene: another one has {100 * motion.rival:.0f} % of the support, "
            f"{100 * params.clear_ratio:.0f} % allowed"
        )
    return ""


def _as_poses(rig: Rig, motions: Mapping[str, CameraMotion], params: SnapshotParams) -> LocatedCameras:
    """The cameras and the scene, as a board's frames give them; places are the working volume of each camera."""
    names = (*motions, SCENE)
    before = {name: rig.cameras[name].T_world_color for name in motions} | {SCENE: np.eye(4)}
    now = {name: before[name] @ m.motion.T_old_new for name, m in motions.items()} | {SCENE: np.eye(4)}
    C = np.zeros((6 * len(names), 6 * len(names)))
    places = {(SCENE, SCENE): np.zeros((0, 3))}
    for i, (name, m) in enumerate(motions.items()):
        Ad = se3.adjoint(before[name])
        C[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = Ad @ m.motion.covariance @ Ad.T
        points = working_points(rig.cameras[name].intrinsics, params.distance_m)
        places[name, SCENE] = se3.transform(before[name], points)
    return LocatedCameras(names, SCENE, before, now, C, 1.0, {}, {}, {}, places)


def _common(rig: Rig, motions: Mapping[str, CameraMotion], still: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Motion of the whole rig in the world, (4, 4), by the cameras that stayed in it, and its covariance (6, 6)."""
    D: FloatArray = np.eye(4)
    H: FloatArray = np.zeros((6, 6))
    for _ in range(3):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for name in still:
            T = rig.cameras[name].T_world_color
            own, Ad = T @ motions[name].motion.T_old_new @ se3.inverse(T), se3.adjoint(T)
            information = symmetric_inverse(Ad @ motions[name].motion.covariance @ Ad.T)
            H, g = H + information, g + information @ se3.difference(own, D)
        D = se3.retract(D, symmetric_inverse(H) @ g)
    return D, symmetric_inverse(H)


def _of_camera(
    rig: Rig, motion: CameraMotion, moved: bool, D: FloatArray, C: FloatArray, params: SnapshotParams
) -> CameraVerdict:
    own = rig.cameras[motion.camera]
    T_world_color, estimate = own.T_world_color, motion.motion
    T_old_new = se3.inverse(T_world_color) @ se3.inverse(D) @ T_world_color @ estimate.T_old_new
    Ad = se3.adjoint(se3.inverse(T_world_color))
    covariance = estimate.covariance + Ad @ C @ Ad.T
    away_m, sd_m = displacement_m(T_old_new, covariance, working_points(own.intrinsics, params.distance_m))
    return CameraVerdict(
        motion.camera,
        moved,
        T_old_new,
        covariance,
        away_m,
        sd_m,
        float(np.linalg.norm(T_old_new[:3, 3])),
        float(np.sqrt(np.trace(covariance[3:, 3:]))),
        float(so3.angle_rad(T_old_new[:3, :3])),
        float(np.sqrt(np.trace(covariance[:3, :3]))),
        motion,
    )
