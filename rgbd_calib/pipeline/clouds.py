"""How far apart the clouds of a rig's cameras are, on the scene itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.io.snapshot import depth_of
from rgbd_calib.pipeline.rig_inputs import common_cameras
from rgbd_calib.trust.snapshot.clouds import CloudGap, cloud_gap
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.types import Rig

MOST_FRAMES = 5
"""Of a recording in which the board moves: each is compared by itself."""
LEAST_PATCHES = 50


@dataclass(frozen=True)
class CloudNumbers:
    """Of patches of surface that two cameras see: from one cloud to the other, point to plane."""

    patches: int
    median_mm: float
    rms_mm: float
    overlap_share: float
    error_mm: float | None
    """RMS without the noise of depth; None where that cannot be told."""


@dataclass(frozen=True)
class CloudAlignment:
    """By pair of cameras, and all together."""

    all: CloudNumbers
    pairs: Mapping[str, CloudNumbers]
    without_overlap: tuple[str, ...]


@one_blas_thread
def evaluate_clouds(rig_path: Path, path: Path) -> CloudAlignment:
    """Distances between the clouds of each pair of cameras.

    Raises
    ------
    CalibrationError
        No two cameras see the same surfaces.
    """
    rig, recording = read_rig(rig_path), open_recording(path)
    pairs: dict[tuple[str, str], CloudGap] = {}
    for surfaces in surfaces_of(recording, rig):
        for pair in combinations(surfaces, 2):
            gap = _gap(rig, surfaces, pair)
            pairs[pair] = pairs[pair].joined(gap) if pair in pairs else gap
    kept = {pair: gap for pair, gap in pairs.items() if len(gap.distance_m) >= LEAST_PATCHES}
    if not kept:
        if not pairs:
            raise CalibrationError(
                f"{recording.path}: depth of two cameras in one frame expected, none found. Record it with depth"
            )
        raise CalibrationError(
            f"{recording.path}: no two cameras see the same surfaces from the same side; {LEAST_PATCHES} patches in common are "
            "needed. Put things where two cameras see them, or evaluate on a board: --recording"
        )
    together = CloudGap(
        np.concatenate([gap.distance_m for gap in kept.values()]),
        np.concatenate([gap.products_m2 for gap in kept.values()]),
        float(np.mean([gap.share for gap in kept.values()])),
    )
    return CloudAlignment(
        _numbers(together),
        {" - ".join(pair): _numbers(gap) for pair, gap in kept.items()},
        tuple(" - ".join(pair) for pair in pairs if pair not in kept),
    )


def surfaces_of(recording: Recording, rig: Rig, left_out: Sequence[str] = ()) -> Iterator[dict[str, Surface]]:
    """What the cameras with depth see of a scene, by camera, at each of some instants; some frames are left out."""
    cameras = common_cameras(recording, rig)
    for frames in _instants(recording, left_out):
        found = {name: depth_of(recording, name, frames) for name in cameras}
        yield {name: Surface(rig.cameras[name], depth_m) for name, depth_m in found.items() if depth_m is not None}


def _instants(recording: Recording, left_out: Sequence[str]) -> list[list[str]]:
    """Frames to take together: all of a still scene, single ones where a board is moved."""
    if recording.board is None:
        with_depth = {frame for files in recording.depth_files.values() for frame in files}
        return [sorted(with_depth - {*left_out})]
    frames = [frame for frame in recording.frames if frame not in left_out]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int))
    return [[frames[i]] for i in chosen]


def _gap(rig: Rig, surfaces: dict[str, Surface], pair: tuple[str, str]) -> CloudGap:
    a, b = pair
    T_a_b = se3.inverse(rig.cameras[a].T_world_color) @ rig.cameras[b].T_world_color
    return cloud_gap(surfaces[a], surfaces[b], T_a_b).joined(cloud_gap(surfaces[b], surfaces[a], se3.inverse(T_a_b)))


def _numbers(gap: CloudGap) -> CloudNumbers:
    mm = 1e3 * np.abs(gap.distance_m)
    rms_mm, error_mm = float(np.sqrt(np.mean(mm**2))), None if np.isnan(gap.error_m) else 1e3 * gap.error_m
    return CloudNumbers(len(mm), float(np.median(mm)), rms_mm, gap.share, error_mm)
