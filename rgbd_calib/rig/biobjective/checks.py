"""Data that cannot carry a refinement are refused here, each with its cause."""

from __future__ import annotations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.groups import Grouping
from rgbd_calib.types import Correspondences, IntArray

MIN_WIDTH = 0.01
"""Width over length below which points count as collinear: turning about their line moves them by less than 1 % of
what any other turn does."""

LEAST_EIGENVALUE = 1e-12
"""Of the normal matrix scaled to unit diagonal: beyond it rounding (1e-16) leaves fewer than four digits of a step."""


def inputs(
    data: Correspondences, intrinsics: dict[str, Intrinsics], T_world_color: dict[str, FloatArray], reference: str
) -> None:
    """Cameras known and placed, numbers finite, no observation twice."""
    if len(data.cameras) < 2:
        raise CalibrationError(
            f"refinement: {len(data.cameras)} camera ({', '.join(data.cameras)}), two or more needed. "
            "Record the same board or scene with another camera"
        )
    if reference not in data.cameras:
        raise CalibrationError(
            f"refinement: the reference {reference} is not among the cameras {', '.join(data.cameras)}. Choose one of them"
        )
    for camera in data.cameras:
        for what, known in (("intrinsics", intrinsics), ("starting pose", T_world_color)):
            if camera not in known:
                raise CalibrationError(
                    f"{camera}: no {what} given, needed by the refinement. Calibrate or place it first"
                )
        if not np.all(np.isfinite(T_world_color[camera])):
            raise CalibrationError(
                f"{camera}: the starting pose is not finite (NaN or infinity). Place the camera anew"
            )
        if not np.all(np.isfinite(intrinsics[camera].vector)):
            raise CalibrationError(
                f"{camera}: the intrinsics are not finite (NaN or infinity). Calibrate the camera anew"
            )
    for kind, values, camera_of, point_of in (
        ("pixel", data.pixels_px, data.pixel_camera, data.pixel_point),
        ("3D point", data.xyz_m, data.xyz_camera, data.xyz_point),
    ):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise CalibrationError(
                f"{data.cameras[camera_of[bad[0]]]}: {len(bad)} {kind} values are not finite (NaN or infinity), the first "
                f"of feature {'/'.join(data.labels[point_of[bad[0]]])}. Leave out what was not measured"
            )
        pairs = camera_of.astype(np.int64) * (len(data.labels) + 1) + point_of
        unique, counts = np.unique(pairs, return_counts=True)
        if len(unique) < len(pairs):
            number, point = divmod(int(unique[np.argmax(counts)]), len(data.labels) + 1)
            raise CalibrationError(
                f"{data.cameras[number]}: feature {'/'.join(data.labels[point])} has {counts.max()} {kind} rows, one "
                "needed. Remove the others"
            )
    if data.xyz_covariance is not None and (
        not np.all(np.isfinite(data.xyz_covariance)) or np.any(np.linalg.eigvalsh(data.xyz_covariance)[:, 0] <= 0)
    ):
        raise CalibrationError(
            "xyz_covariance: a covariance is not positive definite. Give one for each 3D point, or none"
        )


def structure(cameras: tuple[str, ...], pixels: Grouping | None, xyz: Grouping | None) -> None:
    """Every camera shares enough points with the others, and all hang together with the reference, `cameras[0]`."""
    N = len(cameras)
    linked = np.eye(N, dtype=bool)
    counts = {"2D": np.zeros(N, int), "3D": np.zeros(N, int)}
    for kind, grouping in (("2D", pixels), ("3D", xyz)):
        for block in grouping.blocks if grouping else ():
            linked[np.ix_(block.cameras, block.cameras)] |= _common(block.seen, len(block.cameras))
            seen = np.full(len(block.cameras), block.points.stop - block.points.start)
            counts[kind][block.cameras] += seen if block.seen is None else block.seen.sum(axis=1)
    for i, camera in enumerate(cameras):
        n2, n3 = int(counts["2D"][i]), int(counts["3D"][i])
        if n3 < 3 and n2 + n3 < 5:
            raise CalibrationError(
                f"{camera}: {n3} 3D points and {n2} pixel features in common with other cameras, at least 3 points or 5 "
                "features needed to fix a pose. Record more views that both cameras see"
            )
    reached = linked[0]
    for _ in range(N):
        reached = linked[reached].any(axis=0)
    if not reached.all():
        lost = ", ".join(c for c, r in zip(cameras, reached, strict=True) if not r)
        raise CalibrationError(
            f"{lost}: no chain of common points leads to the reference {cameras[0]}. Record views that they share"
        )


def spread(cameras: tuple[str, ...], sets: list[tuple[Grouping, FloatArray, float]]) -> None:
    """No camera's common points lie on a line; each set is a grouping, its points (3, h), and their noise in metres."""
    for i, camera in enumerate(cameras):
        points, noise_m = [np.empty((3, 0))], 0.0
        for grouping, X, sigma_m in sets:
            for block in grouping.blocks:
                at = np.flatnonzero(block.cameras == i)
                if len(at):
                    own = X[:, block.points]
                    points.append(own if block.seen is None else own[:, block.seen[at[0]]])
                    noise_m = max(noise_m, sigma_m)
        own = np.concatenate(points, axis=1)
        own = own - own.mean(axis=1, keepdims=True)
        _, width, length = np.sqrt(np.maximum(np.linalg.eigvalsh(own @ own.T / own.shape[1]), 0.0))
        if width < max(MIN_WIDTH * length, 2 * noise_m):
            noise = f", their noise {1e3 * noise_m:.3g} mm" if noise_m else ""
            raise CalibrationError(
                f"{camera}: its {own.shape[1]} common points are collinear (RMS width {1e3 * width:.3g} mm over a length of "
                f"{1e3 * length:.3g} mm{noise}), so that turning about their line cannot be seen. Use points spread over "
                "an area or a volume"
            )


def freedom(equations: int, unknowns: int, what: str) -> None:
    """At least as many equations as unknowns."""
    if equations < unknowns:
        raise CalibrationError(
            f"{what}: {equations} equations for {unknowns} unknowns of the poses. Use more features that several cameras see"
        )


def rank(cameras: tuple[str, ...], N: FloatArray, gauge: FloatArray | None) -> None:
    """The normal matrix (6 F, 6 F) of the poses of `cameras[1:]` is regular (but for the gauge)."""
    diagonal = np.diag(N)
    if np.all(diagonal > 0) and np.all(np.isfinite(N)):
        scale = 1.0 / np.sqrt(diagonal)
        if gauge is not None:
            N = N + np.trace(N) / len(N) * np.outer(gauge, gauge)
        values, vectors = np.linalg.eigh(N * scale[:, None] * scale)
        if values[0] > LEAST_EIGENVALUE:
            return
        camera = cameras[1 + int(np.argmax(np.abs(vectors[:, 0]))) // 6]
        seen = f"least eigenvalue {values[0]:.1e} of the scaled normal matrix, {LEAST_EIGENVALUE:.0e} needed"
    else:
        camera, seen = cameras[1 + int(np.argmin(diagonal)) // 6], "a direction without any information"
    raise CalibrationError(
        f"{camera}: the points that it shares do not fix its pose ({seen}). Use more points, spread over a volume"
    )


def redundancy(kind: str, value: float, residuals: int) -> None:
    """A variance needs residuals that the unknowns did not absorb."""
    if value < 1.0:
        raise CalibrationError(
            f"sigma_{kind}: {residuals} residuals leave a redundancy of {value:.2g} beside the unknowns, 1 or more needed to "
            f"estimate it. Use more {kind} features, or give both sigmas"
        )


def _common(seen: np.ndarray | None, k: int) -> IntArray:
    """(k, k), which cameras of a block have a point in common."""
    if seen is None:
        return np.ones((k, k), bool)
    counts: IntArray = seen.astype(int) @ seen.T.astype(int)
    return counts > 0
