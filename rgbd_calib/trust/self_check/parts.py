"""Noise of parts of the residuals, and of whole views: what the self-checks compare."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.self_check import ALONE, Equations, ResidualNoise, SelfCheckParams, group_ratios
from rgbd_calib.types import IntArray


def noise_of_bundle(solved: Solution, eq: Equations) -> dict[str, ResidualNoise]:
    out = {}
    w = solved.problem.weights
    for i, name in enumerate(solved.cameras):
        mine = (eq.camera == i) & eq.shared
        if not mine.any():
            continue
        n, z = float(np.mean(eq.corners[mine])), float(np.mean(eq.distance_m[mine]))
        has_depth = solved.has_depth[i]
        # the pose part's 6 (3) of 2 n (n) residuals have `ratio` times the deviation of the others
        px = w.sigma_2d_px[i] * np.sqrt(np.sum(w.ratio_pixel**2) / n)
        mm = 1e3 * w.k_depth[i] * z**2 * np.sqrt(np.sum(w.ratio_depth**2) / n)
        out[name] = ResidualNoise(
            float(w.sigma_2d_px[i]),
            float(w.k_depth[i]) if has_depth else None,
            float(1e3 * px * z / solved.state.intrinsics[i, 0]),
            float(mm) if has_depth else 0.0,
        )
    return out


def ratios_of_bundle(solved: Solution, eq: Equations, params: SelfCheckParams) -> dict[tuple[str, str, str], float]:
    obs, weights = solved.problem.obs, solved.problem.weights
    sigma_px, sigma_m = weights.sigma_2d_px[obs.camera], weights.k_depth[obs.camera][:, None] * obs.depth_m**2
    of_frame = {name: k for k, name in enumerate(eq.frames)}
    time_index = np.array([of_frame.get(name, ALONE) for name in solved.course.frames])[obs.frame]
    out: dict[tuple[str, str, str], float] = {}
    for i, name in enumerate(solved.cameras):
        lens = solved.prior_of(name).intrinsics
        for kind, used, r in (
            ("pixels", obs.has_pixel, np.linalg.norm(solved.residuals[0], axis=-1) / np.sqrt(2) / sigma_px[:, None]),
            ("depth", obs.has_depth, solved.residuals[1] / sigma_m),
        ):
            mine = used & (obs.camera == i)[:, None]
            size = np.array([lens.width, lens.height])
            out |= parts(
                name,
                kind,
                r[mine],
                obs.pixels_px[mine] / size,
                obs.depth_m[mine] if kind == "depth" else None,
                np.broadcast_to(time_index[:, None], mine.shape)[mine],
                len(eq.frames),
                params,
            )
    return out


def ratios_of_residuals(
    r: Residuals, frames_in_time: Sequence[str], params: SelfCheckParams
) -> dict[tuple[str, str, str], float]:
    at = {name: k for k, name in enumerate(frames_in_time)}
    out: dict[tuple[str, str, str], float] = {}
    for name in np.unique(r.camera):
        own = r.of(str(name))
        time_index = np.array([at.get(str(f), ALONE) for f in own.frame])
        size = np.maximum(own.pixels_px.max(axis=0), 1.0)
        length = np.linalg.norm(own.residual_px, axis=1)
        for kind, used, value in (
            ("pixels", own.used_pixel & np.isfinite(length), length),
            ("depth", own.used_depth & np.isfinite(own.residual_depth_m), own.residual_depth_m / own.depth_m**2),
        ):
            out |= parts(
                str(name),
                kind,
                value[used],
                own.pixels_px[used] / size,
                own.depth_m[used] if kind == "depth" else None,
                time_index[used],
                len(frames_in_time),
                params,
            )
    return out


def parts(
    name: str,
    kind: str,
    r: FloatArray,
    at: FloatArray,
    depth_m: FloatArray | None,
    time_index: IntArray,
    n_frames_in_time: int,
    params: SelfCheckParams,
) -> dict[tuple[str, str, str], float]:
    """Noise of parts of one camera's residuals over its whole: in time, over the image, over the range."""
    out = {}
    rig = time_index != ALONE
    cuts = [
        (
            "time",
            np.where(rig, 2 * time_index // max(n_frames_in_time, 1), 2),
            ("in its first half", "in its second half", "close"),
        ),
        ("image", (np.abs(at - 0.5).max(axis=1) > 0.35).astype(int), ("in the middle", "near the image's edge")),
    ]
    if depth_m is not None and len(depth_m):
        edges = np.quantile(depth_m, [1 / 3, 2 / 3])
        cuts.append(("range", np.searchsorted(edges, depth_m), ("near", "half-way", "far")))
    for _, group, names in cuts:
        for g, ratio in group_ratios(r, group, params.min_group).items():
            out[name, kind, names[g]] = ratio
    return out
