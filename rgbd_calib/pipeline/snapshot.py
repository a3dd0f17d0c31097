"""Does a rig still hold? Two recordings of the empty scene, without a board: each camera against its own old images."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.snapshot import read_snapshot
from rgbd_calib.pipeline.rig_inputs import common_cameras
from rgbd_calib.quality import CameraUpdate
from rgbd_calib.trust.snapshot import (
    Before,
    CameraMotion,
    RigVerdict,
    SnapshotParams,
    camera_motion,
    drift_sentence,
    judge_motions,
)
from rgbd_calib.types import CameraSnapshot, Rig, RigCamera

_AT_ONCE = min(4, os.cpu_count() or 1)
"""Cameras in memory together; more than there are processors only displace each other there."""


@one_blas_thread
def verify_snapshot(rig: Rig, new: Recording, old: Recording, params: SnapshotParams) -> RigVerdict:
    """Compare the rig's cameras with their own old images.

    Raises
    ------
    CalibrationError
        No camera of the rig has colour and depth in both recordings.
    """
    return judge_motions(rig, compare(rig, new, prepare(rig, old)), params)


@one_blas_thread
def prepare(rig: Rig, old: Recording) -> dict[str, Before]:
    """The old snapshot of each camera of the rig that has one."""

    def one(name: str) -> tuple[str, Before | None]:
        snapshot = read_snapshot(old, name)
        return name, None if snapshot is None else Before(rig.cameras[name], snapshot)

    found = _threads().map(one, common_cameras(old, rig))
    return {name: before for name, before in found if before is not None}


def compare(rig: Rig, new: Recording, before: Mapping[str, Before]) -> dict[str, CameraMotion]:
    """The motion of each camera that both snapshots have."""
    both = [name for name in common_cameras(new, rig) if name in before]
    found = compare_with(before, both, lambda name: read_snapshot(new, name))
    if not found:
        raise CalibrationError(
            f"{new.path}: no camera has colour and depth images in both snapshots; at least one is needed. "
            f"The old one has {', '.join(before) or 'none'}. Record both with depth: rgbd-calib capture OUT --snapshot"
        )
    return found


@one_blas_thread
def compare_with(
    before: Mapping[str, Before], cameras: Sequence[str], read: Callable[[str], CameraSnapshot | None]
) -> dict[str, CameraMotion]:
    """The motion of each of these cameras that `read` gives a new snapshot of."""

    def one(name: str) -> CameraMotion | None:
        snapshot = read(name)
        return None if snapshot is None else camera_motion(name, before[name], snapshot)

    return {m.camera: m for m in _threads().map(one, cameras) if m is not None}


@cache
def _threads() -> ThreadPoolExecutor:
    """The same in every round of a monitor: OpenCV keeps a kilobyte of each thread that has ended."""
    return ThreadPoolExecutor(_AT_ONCE)


def summary(verdict: RigVerdict) -> dict[str, Any]:
    """Plain numbers and the verdict in words."""
    cameras: dict[str, Any] = {}
    for name, own in verdict.cameras.items():
        estimate = own.motion.motion
        cameras[name] = {
            "moved": own.moved,
            "displacement_mm": 1e3 * own.displacement_m,
            "displacement_sd_mm": 1e3 * own.displacement_sd_m,
            "shift_mm": 1e3 * own.shift_m,
            "shift_sd_mm": 1e3 * own.shift_sd_m,
            "turn_deg": float(np.degrees(own.turn_rad)),
            "turn_sd_deg": float(np.degrees(own.turn_sd_rad)),
            "T_old_new": own.T_old_new.tolist(),
            "covariance": own.covariance.tolist(),
            "unchanged_share": own.motion.unchanged_share,
            "depth_drift": drift_sentence(estimate),
            "tracks": round(estimate.tracks.rows),
            "patches": round(estimate.patches.rows),
        }
    D = verdict.T_world_moved
    return {
        "holds": verdict.holds,
        "verdict": sentence(verdict),
        "moved": list(verdict.moved),
        "or_else": [list(names) for names in verdict.rivals],
        "undetermined": dict(verdict.undetermined),
        "not_checked": list(verdict.missing),
        "distance_m": verdict.params.distance_m,
        "cameras": cameras,
        "rig_motion": None
        if D is None
        else {
            "shift_mm": 1e3 * float(np.linalg.norm(D[:3, 3])),
            "turn_deg": float(np.degrees(so3.angle_rad(D[:3, :3]))),
            "T_world_moved": D.tolist(),
        },
        "pairs": {
            " - ".join(p.cameras): {"error_mm": 1e3 * p.error_m, "noise_mm": 1e3 * p.noise_m, "off": p.broken}
            for p in verdict.pairs
        },
    }


def sentence(verdict: RigVerdict) -> str:
    """The verdict, and what to do."""
    limit = f"{1e3 * verdict.params.pairs.max_m:g} mm"
    whole = ""
    if verdict.T_world_moved is not None:
        shift_mm = 1e3 * float(np.linalg.norm(verdict.T_world_moved[:3, 3]))
        turn = float(np.degrees(so3.angle_rad(verdict.T_world_moved[:3, :3])))
        whole = (
            f"; the whole rig moved against the scene by {shift_mm:.1f} mm and {turn:.2f}°, its relative poses count"
        )
    if verdict.moved:
        names = " and ".join(verdict.moved)
        if verdict.rivals:
            names += ", or " + ", or ".join(" and ".join(r) for r in verdict.rivals) + ","
        return (
            f"FAIL: {names} moved{whole}. Calibrate again, or correct the rig: "
            "rgbd-calib calibrate NEW --update RIG --snapshot OLD -o RIG2"
        )
    if verdict.undetermined:
        first = next(iter(verdict.undetermined))
        return (
            f"UNDECIDED: {', '.join(verdict.undetermined)}: {verdict.undetermined[first]}. Put textured things into the view "
            "before the snapshots, or check with a board: rgbd-calib verify RIG RECORDING"
        )
    if verdict.missing:
        return f"UNDECIDED: {', '.join(verdict.missing)}: no colour and depth images in both snapshots. Record them"
    worst = max(verdict.cameras.values(), key=lambda c: c.displacement_m)
    return (
        f"PASS: no camera moved by more than {limit} at {verdict.params.distance_m:g} m against the others; most: "
        f"{worst.camera}, {1e3 * worst.displacement_m:.2f} ± {1e3 * worst.displacement_sd_m:.2f} mm{whole}"
    )


def corrected_by(
    rig: Rig, verdict: RigVerdict, new: Recording, old: Recording
) -> dict[str, tuple[RigCamera, CameraUpdate]]:
    """New entry and report, for the rig file, of each camera that moved.

    The covariance of the old pose stays, since its error is still there, and that of the motion is added.

    Raises
    ------
    CalibrationError
        The scene does not determine the motion of a camera, a camera lacks images, or several sets of cameras explain the same.
    """
    if verdict.undetermined or verdict.missing or verdict.rivals:
        raise CalibrationError(f"{new.path}: the snapshots do not determine the rig: {sentence(verdict)}")
    out = {}
    for name in verdict.moved:
        own, found = rig.cameras[name], verdict.cameras[name]
        Ad = se3.adjoint(own.T_world_color)
        covariance = own.covariance + Ad @ found.covariance @ Ad.T
        entry = replace(own, T_world_color=own.T_world_color @ found.T_old_new, covariance=covariance)
        report = CameraUpdate(
            name,
            by="snapshot",
            recording=str(new.path),
            recording_sha256=new.digest(),
            snapshot=str(old.path),
            snapshot_sha256=old.digest(),
            moved_mm=1e3 * found.shift_m,
            turned_deg=float(np.degrees(found.turn_rad)),
            unchanged_share=found.motion.unchanged_share,
        )
        out[name] = (entry, report)
    return out
