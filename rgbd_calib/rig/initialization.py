"""First poses of all cameras: the DLT from features of an already placed camera, over the graph of pairs.

The reference stands at the identity. Then, again and again, the camera that shares most features with one already
placed is placed: 3D points measured by the placed camera against the new one's pixels, by the DLT (the paper, section
6.1). A DLT needs points that are not coplanar; where they are (one board pose), the homography of their plane gives the
pose, and measured 3D points of both cameras choose between its two candidates. Noise of the depth gives a plane some
thickness: nearly flat points are tried both ways, and the DLT must be clearly better in the image. Without enough 3D
points on the placed side the roles are exchanged, and with 3D points on both sides but no pixels the points are aligned
rigidly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import align, plane, resection, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Correspondences

NEARLY_FLAT = 0.1
"""Thickness over extent below which points may be a plane and noise: 5 mm on a board of 15 cm is 0.1 in these terms."""

DLT_HANDICAP = 1.5
"""The DLT's error counts this often: it has noise to fit where the points are a plane, and is far better where not."""


@dataclass(frozen=True)
class InitializationParams:
    min_points: int = 4
    """Common features that a pair needs."""


@dataclass(frozen=True)
class Step:
    """How a camera was placed."""

    camera: str
    from_camera: str
    points: int
    method: str
    """`dlt`, `homography` or `rigid`."""


@dataclass(frozen=True)
class InitializationResult:
    T_world_color: dict[str, FloatArray]
    """World = the reference camera."""
    steps: tuple[Step, ...]


def initialize(
    data: Correspondences, intrinsics: dict[str, Intrinsics], reference: str, params: InitializationParams | None = None
) -> InitializationResult:
    """Place every camera of the correspondences.

    Raises
    ------
    CalibrationError
        One camera only, a camera shares too few features with the others (names the groups and which pair to film), or the features of
        a pair do not determine a pose.
    """
    params = params or InitializationParams()
    if len(data.cameras) < 2:
        raise CalibrationError(
            f"{len(data.cameras)} camera ({', '.join(data.cameras)}), two or more needed. "
            "Record the same board or scene with another camera"
        )
    tables = _tables(data)
    placed = {reference: np.eye(4)}
    steps: list[Step] = []
    while len(placed) < len(data.cameras):
        options = [(len(_common(tables[a], tables[b])), a, b) for a in placed for b in data.cameras if b not in placed]
        count, a, b = max(options, key=lambda option: option[0])
        if count < params.min_points:
            raise _not_connected(data.cameras, placed, options, params)
        T_b_a, method = _relative(tables[a], tables[b], intrinsics[b], intrinsics[a], f"{a} and {b}")
        placed[b] = placed[a] @ se3.inverse(T_b_a)
        steps.append(Step(b, a, count, method))
    return InitializationResult({name: placed[name] for name in data.cameras}, tuple(steps))


@dataclass(frozen=True)
class _Table:
    """One camera's features by number of the point."""

    pixels_px: dict[int, FloatArray]
    xyz_m: dict[int, FloatArray]


def _tables(data: Correspondences) -> dict[str, _Table]:
    tables = {name: _Table({}, {}) for name in data.cameras}
    for c, p, uv in zip(data.pixel_camera, data.pixel_point, data.pixels_px, strict=True):
        tables[data.cameras[c]].pixels_px[int(p)] = uv
    for c, p, xyz in zip(data.xyz_camera, data.xyz_point, data.xyz_m, strict=True):
        tables[data.cameras[c]].xyz_m[int(p)] = xyz
    return tables


def _common(a: _Table, b: _Table) -> list[int]:
    """Points that can place b from a: the most of 3D in a and pixel in b, the reverse, and 3D in both."""
    return max(_shared(a.xyz_m, b.pixels_px), _shared(b.xyz_m, a.pixels_px), _shared(a.xyz_m, b.xyz_m), key=len)


def _shared(a: dict[int, FloatArray], b: dict[int, FloatArray]) -> list[int]:
    return sorted(a.keys() & b.keys())


def _relative(
    a: _Table, b: _Table, intrinsics_b: Intrinsics, intrinsics_a: Intrinsics, pair: str
) -> tuple[FloatArray, str]:
    """T_b_a and how it was found."""
    forward, backward, both = _shared(a.xyz_m, b.pixels_px), _shared(b.xyz_m, a.pixels_px), _shared(a.xyz_m, b.xyz_m)
    try:
        if len(forward) >= max(len(backward), 4):
            return _resect(a.xyz_m, b.pixels_px, forward, intrinsics_b, b.xyz_m)
        if len(backward) >= 4:
            T_a_b, method = _resect(b.xyz_m, a.pixels_px, backward, intrinsics_a, a.xyz_m)
            return se3.inverse(T_a_b), method
    except CalibrationError as error:
        raise CalibrationError(f"{pair}: {error}") from None
    points_a, points_b = (np.array([t.xyz_m[p] for p in both]) for t in (a, b))
    s = np.linalg.svd(points_a - points_a.mean(0), compute_uv=False)
    if s[1] < resection.MIN_FLATNESS * s[0]:
        raise CalibrationError(
            f"{pair}: the {len(both)} common 3D points are collinear. Use points that are spread out"
        )
    return align.rigid(points_b, points_a), "rigid"


def _resect(
    xyz_a: dict[int, FloatArray],
    pixels_b: dict[int, FloatArray],
    shared: list[int],
    intrinsics_b: Intrinsics,
    xyz_b: dict[int, FloatArray],
) -> tuple[FloatArray, str]:
    points_a = np.array([xyz_a[p] for p in shared])
    rays = intrinsics_b.rays(np.array([pixels_b[p] for p in shared]))
    good = np.all(np.isfinite(rays), axis=1)
    points_a, rays = points_a[good], rays[good]
    s = np.linalg.svd(points_a - points_a.mean(axis=0), compute_uv=False)
    options = []
    if s[2] >= resection.MIN_FLATNESS * s[0] and len(points_a) >= resection.MIN_DLT_POINTS:
        T_b_a = resection.dlt(points_a, rays)
        options.append((DLT_HANDICAP * _ray_rms(T_b_a, points_a, rays), T_b_a, "dlt"))
    if not options or s[2] < NEARLY_FLAT * s[0]:
        options.append((*_resect_plane(points_a, rays, shared, xyz_a, xyz_b), "homography"))
    _, T_b_a, method = min(options, key=lambda option: option[0])
    return T_b_a, method


def _resect_plane(
    points_a: FloatArray,
    rays: FloatArray,
    shared: list[int],
    xyz_a: dict[int, FloatArray],
    xyz_b: dict[int, FloatArray],
) -> tuple[float, FloatArray]:
    """RMS in ray units and T_b_a by the homography of the plane through the points, which flattens their noise too."""
    normal, d = plane.fit(points_a)
    x = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    T_a_plane = se3.make(np.stack([x, np.cross(normal, x), normal], axis=1), normal * d)
    on_plane = se3.transform(se3.inverse(T_a_plane), points_a)
    poses, rms = resection.homography_pose(on_plane[:, :2], rays)
    T_b_a = poses @ se3.inverse(T_a_plane)
    seen = [p for p in shared if p in xyz_b]
    if len(poses) > 1 and len(seen) >= 4:
        pa, pb = np.array([xyz_a[p] for p in seen]), np.array([xyz_b[p] for p in seen])
        # the slopes differ between the two; a common offset is the pixels' own error of the distance
        off = [se3.transform(T, pa) - pb for T in T_b_a]
        spread = [np.median(np.linalg.norm(d - np.median(d, axis=0), axis=1)) for d in off]
        best = int(np.argmin(spread))
        return float(rms[best]), T_b_a[best]
    return float(rms[0]), T_b_a[0]


def _ray_rms(T_b_a: FloatArray, points_a: FloatArray, rays: FloatArray) -> float:
    p = se3.transform(T_b_a, points_a)
    return float(np.sqrt(np.mean(np.sum((p[:, :2] / p[:, 2:] - rays[:, :2]) ** 2, axis=1))))


def _not_connected(
    cameras: Sequence[str],
    placed: dict[str, FloatArray],
    options: list[tuple[int, str, str]],
    params: InitializationParams,
) -> CalibrationError:
    rest = [name for name in cameras if name not in placed]
    count, a, b = max(options, key=lambda option: option[0])
    return CalibrationError(
        f"cameras are not connected: {{{', '.join(placed)}}} and {{{', '.join(rest)}}} share at most {count} feature(s) "
        f"with depth ({a} with {b}), {params.min_points} needed. Film {a} and {b} together, or any other pair across the two groups"
    )
