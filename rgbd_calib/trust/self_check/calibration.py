"""The self-checks of a calibration: what the solved bundle, or the refinement, gives them, and what they say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.rig.bundle import BundleResult
from rgbd_calib.trust.self_check import (
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
    check_factors,
    check_groups,
    check_noise,
    check_votes,
    delete,
    findings_of,
    outcomes_of,
    usual_distance_m,
)
from rgbd_calib.trust.self_check.bundle_equations import equations_of
from rgbd_calib.trust.self_check.parts import noise_of_bundle, parts, ratios_of_bundle, ratios_of_residuals
from rgbd_calib.types import Board, BoardView, Correspondences, IntArray
from rgbd_calib.views.association import AssociationResult


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
    """What the checks say of a calibration, for its quality; `solution` is None where nothing was refined.

    A bundle is checked with its rigid board, also where its structure was freed afterwards.
    """
    if isinstance(solution, BundleResult):
        try:
            check = check_bundle(solution, board, views, association, moments, stated_mm, params)
        except np.linalg.LinAlgError as error:
            check = SelfCheck((_not_checked(error),), {"tested": 0})
    else:
        sigmas_px = _sigmas_px(solution)
        factors = _factors(solution) if isinstance(solution, RefinementResult) else {}
        check = check_refined(residuals, sigmas_px, factors, views, association, board, moments, params)
    return as_quality(check)


def _not_checked(error: Exception) -> Finding:
    text = f"The result could not be checked: its equations are numerically singular ({error})"
    advice = "Film more: the recording hardly determines the rig (see what is said to be fixed by what was assumed)"
    return Finding("self-check", "distrust", (), text, advice)


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
    of_folds = _fold_findings(_folds(explained, params), params, len(tests), stated_mm)
    blind = [key for key, why in solved.dropped.items() if why.startswith("depth only")]
    lost = [*association.dropped, *(key for key in solved.dropped if key not in blind)]
    ratios = ratios_of_bundle(solved, eq, params)
    findings = [
        *_before(views, association, lost, blind, float(np.median(solved.weights.sigma_2d_px)), board, moments, params),
        *errors,
        *of_folds,
        *(f for f in check_noise(noise_of_bundle(solved, eq), params, stated_mm) if not (errors and f.effect_mm)),
        *check_groups(ratios, params),
    ]
    statistics = {
        "scale": _scale(eq, tests),
        "tests": [
            {
                "test": t.hypothesis.name,
                "camera": t.hypothesis.cameras[0] if len(t.hypothesis.cameras) == 1 else None,
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
    factors: Mapping[str, tuple[float, float]],
    views: Sequence[BoardView],
    association: AssociationResult,
    board: Board,
    moments: Sequence[str],
    params: SelfCheckParams,
) -> SelfCheck:
    """Checks of the estimators that take the lenses as given: noise, agreement and parts of the data."""
    noise = {name: Noise(s, None) for name, s in sigmas_px.items() if np.isfinite(s)}
    ratios = ratios_of_residuals(residuals, moments, params)
    sigma_px = float(np.median([s for s in sigmas_px.values() if np.isfinite(s)] or [0.1]))
    findings = [
        *_before(views, association, list(association.dropped), [], sigma_px, board, moments, params),
        *check_factors(factors, params),
        *check_noise(noise, params, 0.0),
        *check_groups(ratios, params),
    ]
    named = {f"{camera} {kind} {part}": round(r, 3) for (camera, kind, part), r in ratios.items()}
    return SelfCheck(_ordered(findings), {"tested": 0, "noise_of_parts": named})


def of_correspondences(refined: RefinementResult, data: Correspondences, params: SelfCheckParams) -> dict[str, Any]:
    """What the checks say of an estimate from bare correspondences, whose noise may be any."""
    frames = sorted({frame for frame, _ in data.labels})
    at = {name: k for k, name in enumerate(frames)}
    moment = np.array([at[frame] for frame, _ in data.labels])
    length = np.linalg.norm(refined.residuals_2d_px, axis=1)
    length_3d = np.linalg.norm(refined.residuals_3d_m, axis=1) / np.maximum(data.xyz_m[:, 2], 1e-3) ** 2
    ratios: dict[tuple[str, str, str], float] = {}
    for i, name in enumerate(data.cameras):
        mine, mine_3d = data.pixel_camera == i, data.xyz_camera == i
        mine, mine_3d = mine & np.isfinite(length), mine_3d & np.isfinite(length_3d)
        for kind, used, r, where, z in (
            ("pixels", mine, length, data.pixels_px, None),
            ("points", mine_3d, length_3d, data.xyz_m[:, :2] / np.maximum(data.xyz_m[:, 2:], 1e-3), data.xyz_m[:, 2]),
        ):
            if used.any():
                point = (data.pixel_point if kind == "pixels" else data.xyz_point)[used]
                low, high = where[used].min(axis=0), where[used].max(axis=0)
                place = (where[used] - low) / np.maximum(high - low, 1e-9)
                depth = None if z is None else z[used]
                ratios |= parts(name, kind, r[used], place, depth, moment[point], len(frames), params)
    findings = [*check_factors(_factors(refined), params), *check_groups(ratios, params)]
    named = {f"{camera} {kind} {part}": round(r, 3) for (camera, kind, part), r in ratios.items()}
    return as_quality(SelfCheck(_ordered(findings), {"tested": 0, "noise_of_parts": named}))


def _factors(refined: RefinementResult) -> dict[str, tuple[float, float]]:
    return {
        "Pixels": (refined.variance_factor_2d, refined.redundancy_2d),
        "Measured points": (refined.variance_factor_3d, refined.redundancy_3d),
    }


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


def _fold_findings(
    rows: Sequence[Mapping[str, Any]], params: SelfCheckParams, n_tests: int, stated_mm: float
) -> list[Finding]:
    limit = params.significance / (n_tests + params.folds)
    return [
        Finding(
            "held out",
            "distrust" if row["moves_mm"] > max(params.distrust_mm, stated_mm) else "caution",
            (),
            f"Calibrated without the frames {row['frames']}, the cameras put the board in them {row['moves_mm']:.1f} mm apart, "
            "beyond what the covariance allows: these frames and the others are not of one rig",
            "Calibrate each part of the recording by itself and compare; film again where they differ",
            row["moves_mm"],
            row["p"],
        )
        for row in rows
        if row["p"] < limit and row["moves_mm"] > max(params.caution_mm, stated_mm)
    ]


def _moved_by(eq: Equations, step: FloatArray, covariance: FloatArray, gone: IntArray) -> float:
    """RMS of what a step of the cameras' parameters moves the held-out corners by, beyond its own noise, metres.

    Each frame's board follows as well as it can: what is left is how far cameras then put one board apart.
    """
    of_model, board = eq.model, np.arange(eq.board.start, eq.board.stop)
    total = 0.0
    for f in np.flatnonzero(gone):
        views = np.flatnonzero(eq.frame == f)
        P = len(eq.free)
        own, cross, E = np.zeros((P, P)), np.zeros((P, len(board))), np.zeros((len(board), len(board)))
        for v in views:
            at, on = eq.index[v], eq.active[v]
            own[np.ix_(at, at)] += eq.size[v][np.ix_(of_model, of_model)] * np.outer(on, on)
            cross[at] += eq.size[v][np.ix_(of_model, board)] * on[:, None]
            E += eq.size[v][np.ix_(board, board)]
        left = own - cross @ np.linalg.pinv(E, hermitian=True) @ cross.T
        total += float(step @ left @ step - np.sum(left * covariance))
    return float(np.sqrt(max(total, 0.0) / max(int(eq.corners[gone[eq.frame]].sum()), 1)))
