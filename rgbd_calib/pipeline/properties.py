"""What a bundle found out about board and sensors and has corrected, in words: properties, no faults."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.quality import CorrectedProperty, PropertyKind
from rgbd_calib.rig.solution import Solution

AT_M = 2.0
"""Distance at which depth errors are told."""
GRID = 12
"""Places across the image and down."""
CLEAR = 3.0
"""Standard deviations from which on a property is told."""


def properties_of(solved: Solution) -> tuple[CorrectedProperty, ...]:
    """With numbers, those of the board first; what is not clear of its own uncertainty is not told."""
    own = (*_of_board(solved), *_of_depth(solved))
    return tuple(CorrectedProperty(text, kind) for kind, text in own)


def _of_board(solved: Solution) -> list[tuple[PropertyKind, str]]:
    out: list[tuple[PropertyKind, str]] = []
    parts = solved.problem.parts
    if "print" in parts:
        (aspect, shear), at = solved.state.values["print"][0], solved.problem.index("print")
        sd = np.sqrt(np.diag(solved.covariance)[at])
        if abs(aspect) > CLEAR * sd[0]:
            way = "narrower" if aspect < 0 else "wider"
            ratio = f"{200 * abs(aspect):.2f} % {way} along its columns than along its rows (± {200 * sd[0]:.3f} %)"
            out.append((PropertyKind.PRINT, f"The print is {ratio}; corrected"))
        if abs(shear) > CLEAR * sd[1]:
            angle = f"{np.degrees(2 * shear):+.3f}° (± {np.degrees(2 * sd[1]):.3f}°) from square"
            out.append((PropertyKind.PRINT, f"The print's axes are {angle}; corrected"))
    shape = solved.board_shape
    flat = np.column_stack([shape.front_m[:, :2], np.ones(len(shape.front_m))])
    out_of_plane_m = shape.front_m[:, 2] - flat @ np.linalg.lstsq(flat, shape.front_m[:, 2], rcond=None)[0]
    sd_m = float(np.sqrt(np.mean(shape.front_sd_m[:, 2] ** 2))) if shape.front_sd_m is not None else np.inf
    if np.ptp(out_of_plane_m) > CLEAR * sd_m:
        bend = f"{1e3 * np.ptp(out_of_plane_m):.2f} mm from its lowest to its highest corner"
        out.append((PropertyKind.BEND, f"The board is bent by {bend}; corrected"))
    return out


def _of_depth(solved: Solution) -> list[tuple[PropertyKind, str]]:
    """Registration and field of all cameras, in one sentence each."""
    beside, fields = [], []
    for name, has_depth in zip(solved.cameras, solved.has_depth, strict=True):
        if not has_depth:
            continue
        lens, camera, field = solved.intrinsics(name), solved.depth_camera(name), solved.depth_field(name)
        u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
        pixels, z_m = np.column_stack([u.ravel(), v.ravel()]), np.full(GRID**2, AT_M)
        if camera is not None:
            points = se3.transform(se3.inverse(camera.T_color_depth), lens.unproject(pixels, z_m))
            moved = camera.intrinsics.project(points) - pixels
            rms_px = float(np.sqrt(np.nanmean(np.sum(moved**2, axis=1))))
            at = solved.index("registration", name)[:2]
            if rms_px > CLEAR * np.sqrt(np.trace(solved.covariance[np.ix_(at, at)])):
                beside.append(f"{name} by {rms_px:.1f} px")
        if isinstance(field, PolynomialField) and field.covariance is not None:
            J = field.by_parameters(pixels, z_m)
            rms_m = float(np.sqrt(np.mean(field.error_m(pixels, z_m) ** 2)))
            if rms_m > CLEAR * np.sqrt(np.mean(np.einsum("np,pq,nq->n", J, field.covariance, J))):
                fields.append(f"{name} by {1e3 * rms_m:.1f} mm")
    return [
        (kind, f"{text}: {', '.join(cameras)}; corrected")
        for kind, text, cameras in (
            (PropertyKind.REGISTRATION, f"Depth is misregistered to colour (RMS over the image at {AT_M:g} m)", beside),
            (PropertyKind.DEPTH_FIELD, f"Depth errs over the image (RMS at {AT_M:g} m, beside its bias)", fields),
        )
        if cameras
    ]
