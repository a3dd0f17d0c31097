"""The self-checks of a calibration: what the solved bundle, or the refinement, gives them, and what they say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import BoardScaleEstimate, Finding, HeldOutPart, ScoreOutcome, SelfCheck
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.rig.motion.problem import MotionProblem
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.self_check import (
    Equations,
    Outcome,
    ResidualNoise,
    SelfCheckParams,
    check_clipped,
    check_copies,
    check_dropped,
    check_factors,
    check_groups,
    check_noise,
    check_steps,
    check_votes,
    findings_of,
    held_out_findings,
    hold_out,
    outcomes_of,
    usual_distance_m,
)
from rgbd_calib.trust.self_check.motion import check_motion
from rgbd_calib.trust.self_check.of_solution import equations_of, held_blocks
from rgbd_calib.trust.self_check.parts import noise_of_bundle, parts, ratios_of_bundle, ratios_of_residuals
from rgbd_calib.trust.self_check.walls import check_bends, check_walls, walls_of_bundle
from rgbd_calib.types import Board, BoardView, Correspondences
from rgbd_calib.views.association import AssociationResult


def of_calibration(
    solution: Solution | RefinementResult | None,
    residuals: Residuals,
    views: Sequence[BoardView],
    association: AssociationResult,
    board: Board,
    frames_in_time: Sequence[str],
    stated_mm: float,
    params: SelfCheckParams,
    of_images: Sequence[Finding] = (),
) -> SelfCheck:
    """What the checks say of a calibration; `solution` is None where nothing was refined.

    A bundle is checked with its rigid board, also where its structure was freed afterwards. `of_images` is what the images
    showed beside the corners.
    """
    if isinstance(solution, Solution):
        try:
            check = check_bundle(solution, board, views, association, frames_in_time, stated_mm, params)
        except np.linalg.LinAlgError as error:
            check = with_findings(SelfCheck(True, (), tested=0), [_not_checked(error)])
    else:
        sigmas_px = _sigmas_px(solution)
        factors = _factors(solution) if isinstance(solution, RefinementResult) else {}
        check = check_refined(residuals, sigmas_px, factors, views, association, board, frames_in_time, params)
    return with_findings(check, [*check.findings, *of_images])


def _not_checked(error: Exception) -> Finding:
    text = f"The result could not be checked: its equations are numerically singular ({error})"
    advice = "Film more: the recording hardly determines the rig (see what is said to be fixed by what was assumed)"
    return Finding("self-check", "distrust", (), text, advice)


def _sigmas_px(solution: Solution | RefinementResult | None) -> Mapping[str, float]:
    if isinstance(solution, Solution):
        return dict(zip(solution.cameras, solution.problem.weights.sigma_2d_px.tolist(), strict=True))
    return {} if solution is None else solution.sigmas_2d_px


def check_bundle(
    solved: Solution,
    board: Board,
    views: Sequence[BoardView],
    association: AssociationResult,
    frames_in_time: Sequence[str],
    stated_mm: float,
    params: SelfCheckParams,
) -> SelfCheck:
    """Checks of the joint bundle.

    Parameters
    ----------
    views : all that were found in the rig's recording.
    frames_in_time : its frames in order of time.
    stated_mm : the expected error that the result states; what is much smaller is no news.
    """
    held = held_blocks(solved.problem)
    eq = equations_of(solved, held, frames_in_time)
    params = params.at(usual_distance_m(eq))
    tests = outcomes_of(eq, solved.problem, held, params)
    errors, explained = findings_of(eq, tests, params, stated_mm)
    noise = noise_of_bundle(solved, eq)
    carried = isinstance(solved.problem, MotionProblem)
    apart_mm = {name: own.apart_px_mm for name, own in noise.items()}
    motion = [] if carried else check_motion(eq, explained, apart_mm, errors, params)
    by_cameras = any(own.cameras for own in errors)  # then boards are wrong, and would be blamed on the walls
    wrong_walls = [] if by_cameras else [*check_walls(walls_of_bundle(solved), params), *check_bends(solved, params)]
    noisy = any(own.sigma_px is not None and own.sigma_px > params.max_sigma_px for own in noise.values())
    steps = check_steps(association.views, frames_in_time, params) if (motion or noisy) and not carried else []
    if steps or motion:
        errors = [*(steps or motion), *(own for own in errors if not own.cameras)]
    folds = hold_out(eq, params)
    of_explained = folds if explained is eq else hold_out(explained, params)
    of_folds = held_out_findings(of_explained, params, len(tests), stated_mm)
    dropped, used = solved.course.dropped, np.any(solved.problem.obs.has_pixel, axis=1).tolist()
    with_pixels = {(p.view.camera, p.view.frame) for p, v in zip(solved.course.views, used, strict=True) if v}
    blind = [key for key in dropped if key in with_pixels]
    lost = [*association.dropped, *(key for key in dropped if key not in blind)]
    ratios = ratios_of_bundle(solved, eq, params)
    findings = [
        *_before(
            views,
            association,
            lost,
            blind,
            float(np.median(solved.problem.weights.sigma_2d_px)),
            board,
            frames_in_time,
            params,
            carried,
        ),
        *errors,
        *of_folds,
        *(f for f in check_noise(noise, params, stated_mm) if not (errors and f.effect_mm)),
        *check_groups(ratios, params),
        *wrong_walls,
    ]
    statistics = SelfCheck(
        True,
        (),
        scale=_scale(eq, tests),
        tests=tuple(
            ScoreOutcome(
                test=t.hypothesis.name,
                camera=t.hypothesis.cameras[0] if len(t.hypothesis.cameras) == 1 else None,
                chi2=round(t.score.statistic, 2),
                dof=t.score.dof,
                p=_two_digits(t.score.p),
                effect_mm=round(1e3 * t.score.effect_m, 3),
            )
            for t in _worst(tests)
        ),
        tested=len(tests) + params.folds,
        held_out=tuple(
            HeldOutPart(
                frames=f"{f.first} to {f.last}",
                chi2=round(f.chi2, 2),
                dof=f.dof,
                others=round(f.others, 2),
                p=_two_digits(f.p),
                moves_mm=round(f.moves_mm, 3),
            )
            for f in folds
        ),
        noise_of_parts=_named(ratios),
    )
    return with_findings(statistics, findings)


def check_refined(
    residuals: Residuals,
    sigmas_px: Mapping[str, float],
    factors: Mapping[str, tuple[float, float]],
    views: Sequence[BoardView],
    association: AssociationResult,
    board: Board,
    frames_in_time: Sequence[str],
    params: SelfCheckParams,
) -> SelfCheck:
    """Checks of the estimators that take the lenses as given: noise, agreement and parts of the data."""
    noise = {name: ResidualNoise(s, None) for name, s in sigmas_px.items() if np.isfinite(s)}
    ratios = ratios_of_residuals(residuals, frames_in_time, params)
    sigma_px = float(np.median([s for s in sigmas_px.values() if np.isfinite(s)] or [0.1]))
    findings = [
        *_before(views, association, list(association.dropped), [], sigma_px, board, frames_in_time, params),
        *check_factors(factors, params),
        *check_noise(noise, params, 0.0),
        *check_groups(ratios, params),
    ]
    return with_findings(SelfCheck(True, (), tested=0, noise_of_parts=_named(ratios)), findings)


def of_correspondences(refined: RefinementResult, data: Correspondences, params: SelfCheckParams) -> SelfCheck:
    """What the checks say of an estimate from bare correspondences, whose noise may be any."""
    frames = sorted({frame for frame, _ in data.labels})
    at = {name: k for k, name in enumerate(frames)}
    time_index = np.array([at[frame] for frame, _ in data.labels])
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
                ratios |= parts(name, kind, r[used], place, depth, time_index[point], len(frames), params)
    findings = [*check_factors(_factors(refined), params), *check_groups(ratios, params)]
    return with_findings(SelfCheck(True, (), tested=0, noise_of_parts=_named(ratios)), findings)


def _factors(refined: RefinementResult) -> dict[str, tuple[float, float]]:
    return {
        "Pixels": (refined.variance_factor_2d, refined.redundancy_2d),
        "Measured points": (refined.variance_factor_3d, refined.redundancy_3d),
    }


def with_findings(check: SelfCheck, findings: Sequence[Finding]) -> SelfCheck:
    """The same with all of these findings, and what they mean."""
    own = sorted((replace(f, p=f.p and _two_digits(f.p)) for f in findings), key=lambda f: f.level != "distrust")
    return replace(check, trusted=all(f.level != "distrust" for f in own), findings=tuple(own))


def _named(ratios: Mapping[tuple[str, str, str], float]) -> dict[str, float]:
    return {" ".join(part): round(ratio, 3) for part, ratio in ratios.items()}


def _two_digits(p: float) -> float:
    return float(f"{p:.2g}")


def _before(
    views: Sequence[BoardView],
    association: AssociationResult,
    lost: Sequence[tuple[str, str]],
    blind: Sequence[tuple[str, str]],
    sigma_px: float,
    board: Board,
    frames_in_time: Sequence[str],
    params: SelfCheckParams,
    carried: bool = False,
) -> list[Finding]:
    found: dict[str, list[str]] = {}
    for view in views:
        found.setdefault(view.camera, []).append(view.frame)

    def by_camera(keys: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
        return {
            c: [f for camera, f in keys if camera == c and f in frames_in_time] for c in sorted({c for c, _ in keys})
        }

    return [
        *check_votes([(p.cameras, p.frames, p.votes, p.cause) for p in association.pairs], board.two_sided, params),
        *check_dropped(found, by_camera(lost), frames_in_time, params),
        *check_dropped(found, by_camera(blind), frames_in_time, params, "The depth of "),
        *([] if carried else check_copies(views, sigma_px, params)),  # of a video, neighbours are alike
        *check_clipped(views, params),
    ]


def _scale(eq: Equations, tests: Sequence[Outcome]) -> BoardScaleEstimate | None:
    score = next((t.score for t in tests if t.hypothesis.name == "scale"), None)
    if score is None or not score.dof:
        return None
    sd = float(np.sqrt(score.covariance[0, 0]))
    return BoardScaleEstimate(
        round(100 * float(score.estimate[0]), 4), round(100 * sd, 4), distance_m=round(usual_distance_m(eq), 3)
    )


def _worst(tests: Sequence[Outcome]) -> list[Outcome]:
    """Of tests of one kind and camera, the one that fits best."""
    best: dict[tuple[str, tuple[str, ...]], Outcome] = {}
    for t in tests:
        key = t.hypothesis.name, t.hypothesis.cameras
        if key not in best or t.gain > best[key].gain:
            best[key] = t
    return list(best.values())
