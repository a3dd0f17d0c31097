"""The self-checks of a calibration: what the solved bundle, or the refinement, gives them, and what they say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline.equations import equations_of
from rgbd_calib.stages.association import AssociationResult
from rgbd_calib.stages.bundle import BundleResult
from rgbd_calib.stages.refinement import RefinementResult
from rgbd_calib.stages.self_check import (
    NO_MOMENT,
    Equations,
    Finding,
    Noise,
    Outcome,
    SelfCheck,
    SelfCheckParams,
    check_clipped,
    check_copies,
    check_dropped,
    check_groups,
    check_noise,
    check_votes,
    delete,
    findings_of,
    group_ratios,
    outcomes_of,
    usual_distance_m,
)
from rgbd_calib.types import Board, BoardView, IntArray


def of_calibration(
    solution: BundleResult | RefinementResult | None,
    residuals: Residuals,
    views: Sequence[BoardView],
    association: AssociationResult,
    board: Board,
    moments: Sequence[str],
    stated_mm: float,
    params: SelfCheckParams,
) -> dict[str, Any]:
    """What the checks say of a calibration, for its quality; `solution` is None where nothing was refined."""
    if isinstance(solution, BundleResult) and not solution.state.freed.any():
        check = check_bundle(solution, board, views, association, moments, stated_mm, params)
    else:
        sigmas_px = _sigmas_px(solution)
        check = check_refined(residuals, sigmas_px, views, association, board, moments, params)
    return as_quality(check)


def _sigmas_px(solution: BundleResult | RefinementResult | None) -> Mapping[str, float]:
    if isinstance(solution, BundleResult):
        return dict(zip(solution.cameras, solution.weights.sigma_2d_px.tolist(), strict=True))
    return {} if solution is None else solution.sigmas_2d_px


def check_bundle(
    solved: BundleResult,
    board: Board,
    views: Sequence[BoardView],
    association: AssociationResult,
    moments: Sequence[str],
    stated_mm: float,
    params: SelfCheckParams,
) -> SelfCheck:
    """Checks of the joint bundle.

    Parameters
    ----------
    views : all that were found in the rig's recording.
    moments : its frames in order of time.
    stated_mm : the expected error that the result states; what is smaller is no news.
    """
    eq = equations_of(solved, board, moments)
    tests = outcomes_of(eq, params)
    errors, explained = findings_of(eq, tests, params, stated_mm)
    folds = _folds(eq, params)
    of_folds = _fold_findings(_folds(explained, params), params, len(tests))
    blind = [key for key, why in solved.dropped.items() if why.startswith("depth only")]
    lost = [*association.dropped, *(key for key in solved.dropped if key not in blind)]
    ratios = _ratios_of_bundle(solved, eq, params)
    findings = [
        *_before(views, association, lost, blind, float(np.median(solved.weights.sigma_2d_px)), board, moments, params),
        *errors,
        *of_folds,
        *(f for f in check_noise(_noise_of_bundle(solved, eq), params, stated_mm) if not (errors and f.effect_mm)),
        *check_groups(ratios, params),
    ]
    statistics = {
        "scale": _scale(eq, tests),
        "tests": [
            {
                "test": t.hypothesis.name,
                "camera": t.hypothesis.cameras[0] if t.hypothesis.cameras else None,
                "chi2": round(t.score.statistic, 2),
                "freedom": t.score.freedom,
                "p": float(f"{t.score.p:.2g}"),
                "effect_mm": round(1e3 * t.score.effect_m, 3),
            }
            for t in _worst(tests)
        ],
        "tested": len(tests) + params.folds,
        "held_out": folds,
        "noise_of_parts": {f"{camera} {kind} {part}": round(r, 3) for (camera, kind, part), r in ratios.items()},
    }
    return SelfCheck(_ordered(findings), statistics)


def check_refined(
    residuals: Residuals,
    sigmas_px: Mapping[str, float],
    views: Sequence[BoardView],
    association: AssociationResult,
    board: Board,
    moments: Sequence[str],
    params: SelfCheckParams,
) -> SelfCheck:
    """Checks of the estimators that take the lenses as given: noise, agreement and parts of the data."""
    noise = {name: Noise(s, None) for name, s in sigmas_px.items() if np.isfinite(s)}
    ratios = _ratios_of_residuals(residuals, moments, params)
    sigma_px = float(np.median([s for s in sigmas_px.values() if np.isfinite(s)] or [0.1]))
    findings = [
        *_before(views, association, list(association.dropped), [], sigma_px, board, moments, params),
        *check_noise(noise, params, 0.0),
        *check_groups(ratios, params),
    ]
    parts = {f"{camera} {kind} {part}": round(r, 3) for (camera, kind, part), r in ratios.items()}
    return SelfCheck(_ordered(findings), {"tested": 0, "noise_of_parts": parts})


def as_quality(check: SelfCheck) -> dict[str, Any]:
    """For a rig file."""
    return {
        "self_check": {
            "trusted": check.trusted,
            "findings": [
                {
                    "check": f.check,
                    "level": f.level,
                    "cameras": list(f.cameras),
                    "text": f.text,
                    "advice": f.advice,
                    **({} if f.effect_mm is None else {"effect_mm": f.effect_mm}),
                    **({} if f.p is None else {"p": float(f"{f.p:.2g}")}),
                }
                for f in check.findings
            ],
            **check.statistics,
        }
    }


def _before(
    views: Sequence[BoardView],
    association: AssociationResult,
    lost: Sequence[tuple[str, str]],
    blind: Sequence[tuple[str, str]],
    sigma_px: float,
    board: Board,
    moments: Sequence[str],
    params: SelfCheckParams,
) -> list[Finding]:
    found: dict[str, int] = {}
    for view in views:
        found[view.camera] = found.get(view.camera, 0) + 1

    def by_camera(keys: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
        return {c: [f for camera, f in keys if camera == c and f in moments] for c in sorted({c for c, _ in keys})}

    return [
        *check_votes([(p.cameras, p.frames, p.votes) for p in association.pairs], board.two_sided, params),
        *check_dropped(found, by_camera(lost), moments, params),
        *check_dropped(found, by_camera(blind), moments, params, "The depth of "),
        *check_copies(views, sigma_px, params),
        *check_clipped(views, params),
    ]


def _scale(eq: Equations, tests: Sequence[Outcome]) -> dict[str, float]:
    """How long the board's squares are by the depth, and how sure that is: distances as such are known no better."""
    score = next(t.score for t in tests if t.hypothesis.name == "scale")
    if not score.freedom:
        return {}
    return {
        "percent": round(100 * float(score.estimate[0]), 4),
        "sd_percent": round(100 * float(np.sqrt(score.covariance[0, 0])), 4),
        "distance_m": round(usual_distance_m(eq), 3),
    }


def _ordered(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda f: f.level != "distrust"))


def _worst(tests: Sequence[Outcome]) -> list[Outcome]:
    """Of tests of one kind and camera, the one that fits best."""
    best: dict[tuple[str, tuple[str, ...]], Outcome] = {}
    for t in tests:
        key = t.hypothesis.name, t.hypothesis.cameras
        if key not in best or t.gain > best[key].gain:
            best[key] = t
    return list(best.values())


def _folds(eq: Equations, params: SelfCheckParams) -> list[dict[str, Any]]:
    """Parts in time held out in turn: the solution without them against what they say."""
    moment = np.full(eq.n_boards, NO_MOMENT)
    moment[eq.frame] = np.where(eq.shared, eq.moment, NO_MOMENT)
    present = np.unique(moment[moment != NO_MOMENT])
    rows: list[dict[str, Any]] = []
    for part in np.array_split(present, params.folds):
        gone = np.isin(moment, part)
        if len(part) < params.min_side or len(present) - len(part) < params.min_side:
            continue
        held = delete(eq, gone)
        moved_m = _moved_by(eq, held.step, held.covariance - eq.honest_covariance, gone)
        rows.append(
            {
                "frames": f"{eq.moments[part[0]]} to {eq.moments[part[-1]]}",
                "chi2": round(held.statistic, 2),
                "freedom": held.freedom,
                "p": float(f"{held.p:.2g}"),
                "moves_mm": round(1e3 * moved_m, 3),
            }
        )
    return rows


def _fold_findings(rows: Sequence[Mapping[str, Any]], params: SelfCheckParams, n_tests: int) -> list[Finding]:
    limit = params.significance / (n_tests + params.folds)
    return [
        Finding(
            "held out",
            "distrust" if row["moves_mm"] > params.distrust_mm else "caution",
            (),
            f"Without the frames {row['frames']} the result changes by {row['moves_mm']:.1f} mm more than its covariance "
            "allows: these frames and the others are not of one rig",
            "Calibrate each part of the recording by itself and compare; film again where they differ",
            row["moves_mm"],
            row["p"],
        )
        for row in rows
        if row["p"] < limit and row["moves_mm"] > params.caution_mm
    ]


def _moved_by(eq: Equations, step: FloatArray, covariance: FloatArray, gone: IntArray) -> float:
    """RMS of what a step of the cameras' parameters moves the held-out corners by, beyond its own noise, metres."""
    views = np.flatnonzero(gone[eq.frame])
    total = 0.0
    for v in views:
        at, E = eq.index[v], eq.size[v][np.ix_(eq.model, eq.model)] * np.outer(eq.active[v], eq.active[v])
        total += float(step[at] @ E @ step[at] - np.sum(E * covariance[np.ix_(at, at)]))
    return float(np.sqrt(max(total, 0.0) / max(int(eq.corners[views].sum()), 1)))


def _noise_of_bundle(solved: BundleResult, eq: Equations) -> dict[str, Noise]:
    out = {}
    w = solved.weights
    for i, name in enumerate(solved.cameras):
        mine = (eq.camera == i) & eq.shared
        if not mine.any():
            continue
        n, z = float(np.mean(eq.corners[mine])), float(np.mean(eq.distance_m[mine]))
        has_depth = solved.has_bias[i]
        # the pose part's 6 (3) of 2 n (n) residuals have `ratio` times the deviation of the others
        px = w.ratio_pixel * w.sigma_2d_px[i] * np.sqrt(6 / n)
        mm = 1e3 * w.ratio_depth * w.k_depth[i] * z**2 * np.sqrt(3 / n)
        out[name] = Noise(
            float(w.sigma_2d_px[i]),
            float(w.k_depth[i]) if has_depth else None,
            float(1e3 * px * z / solved.state.intrinsics[i, 0]),
            float(mm) if has_depth else 0.0,
        )
    return out


def _ratios_of_bundle(
    solved: BundleResult, eq: Equations, params: SelfCheckParams
) -> dict[tuple[str, str, str], float]:
    obs = solved.obs
    sigma_px = solved.weights.sigma_2d_px[obs.camera]
    of_frame = {name: k for k, name in enumerate(eq.moments)}
    moment = np.array([of_frame.get(name, NO_MOMENT) for name in solved.frames])[obs.frame]
    out: dict[tuple[str, str, str], float] = {}
    for i, name in enumerate(solved.cameras):
        lens = solved.priors[name].intrinsics
        for kind, used, r in (
            ("pixels", obs.has_pixel, np.linalg.norm(solved.residual_pixel, axis=-1) / np.sqrt(2) / sigma_px[:, None]),
            ("depth", obs.has_depth, solved.residual_depth / solved.weights.k_depth[obs.camera][:, None]),
        ):
            mine = used & (obs.camera == i)[:, None]
            size = np.array([lens.width, lens.height])
            out |= _parts(
                name,
                kind,
                r[mine],
                obs.pixels_px[mine] / size,
                obs.depth_m[mine] if kind == "depth" else None,
                np.broadcast_to(moment[:, None], mine.shape)[mine],
                len(eq.moments),
                params,
            )
    return out


def _ratios_of_residuals(
    r: Residuals, moments: Sequence[str], params: SelfCheckParams
) -> dict[tuple[str, str, str], float]:
    at = {name: k for k, name in enumerate(moments)}
    out: dict[tuple[str, str, str], float] = {}
    for name in np.unique(r.camera):
        own = r.of(str(name))
        moment = np.array([at.get(str(f), NO_MOMENT) for f in own.frame])
        size = np.maximum(own.pixels_px.max(axis=0), 1.0)
        length = np.linalg.norm(own.residual_px, axis=1)
        for kind, used, value in (
            ("pixels", own.used_pixel & np.isfinite(length), length),
            ("depth", own.used_depth & np.isfinite(own.residual_depth_m), own.residual_depth_m / own.depth_m**2),
        ):
            out |= _parts(
                str(name),
                kind,
                value[used],
                own.pixels_px[used] / size,
                own.depth_m[used] if kind == "depth" else None,
                moment[used],
                len(moments),
                params,
            )
    return out


def _parts(
    name: str,
    kind: str,
    r: FloatArray,
    at: FloatArray,
    depth_m: FloatArray | None,
    moment: IntArray,
    n_moments: int,
    params: SelfCheckParams,
) -> dict[tuple[str, str, str], float]:
    """Noise of parts of one camera's residuals over its whole: in time, over the image, over the range."""
    out = {}
    rig = moment != NO_MOMENT
    cuts = [
        (
            "time",
            np.where(rig, 2 * moment // max(n_moments, 1), 2),
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
