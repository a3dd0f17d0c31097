"""The self-checks: their algebra against dense least squares and real refits, silence on good data, words on bad."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from solved_rig import NOISE, moved_from, solved

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import NormalEquations, Pattern, Rows, assemble
from rgbd_calib.rig import solve
from rgbd_calib.simulation.views import true_views
from rgbd_calib.trust.self_check import (
    Equations,
    ResidualNoise,
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
    hold_out,
    outcomes_of,
    score_test,
)
from rgbd_calib.trust.self_check.calibration import check_bundle
from rgbd_calib.trust.self_check.model import SolvedModel, ViewRows
from rgbd_calib.trust.self_check.of_solution import equations_of, held_blocks
from rgbd_calib.views.association import AssociationResult

PARAMS = SelfCheckParams()


VIEWS, ROWS, BOARDS, GLOBALS = 12, 40, 5, 8


OF_CAMERA = (np.array([0, 1, 2, 3, 4]), np.array([5, 6, 7, 3, 4]))


def dense_problem(seed: int, excess: float = 0.0) -> tuple[Equations, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random rows of 12 views; the equations at the minimum, dense J with the prior's rows, residuals, A, noise factor."""
    rng = np.random.default_rng(seed)
    frame, camera = np.arange(VIEWS) % BOARDS, np.arange(VIEWS) % 2
    P, N = GLOBALS, VIEWS * ROWS
    by_globals, by_unit, extra = (rng.normal(size=(VIEWS, ROWS, k)) for k in (5, 6, 2))
    Q = np.stack([np.linalg.qr(rng.normal(size=(ROWS, 2)))[0] for _ in range(VIEWS)])
    J, A = np.zeros((N, P + 6 * BOARDS)), np.zeros((N, 2))
    where = np.arange(VIEWS) >= 6
    for v in range(VIEWS):
        at = slice(v * ROWS, (v + 1) * ROWS)
        J[at, OF_CAMERA[camera[v]]] = by_globals[v]
        J[at, P + 6 * frame[v] : P + 6 * frame[v] + 6] = by_unit[v]
        A[at] = extra[v] * where[v]
    prior = np.diag(rng.uniform(0.1, 2.0, P))
    sigma = np.eye(N)
    for v in range(VIEWS):
        at = slice(v * ROWS, (v + 1) * ROWS)
        sigma[at, at] += excess * Q[v] @ Q[v].T
    e = np.linalg.cholesky(sigma) @ rng.normal(size=N)
    known = rng.normal(0, 1 / np.sqrt(np.diag(prior)))
    J_all = np.vstack([J, np.hstack([np.sqrt(prior), np.zeros((P, 6 * BOARDS))])])
    x = np.linalg.lstsq(J_all, -np.concatenate([e, np.sqrt(prior) @ known]), rcond=None)[0]
    r, gradient = e + J @ x, prior @ (known + x[:P])
    left = r.reshape(VIEWS, ROWS)
    seen = [tuple(sorted(set(camera[frame == f]))) for f in range(BOARDS)]
    columns = {key: np.unique(np.concatenate([OF_CAMERA[c] for c in key])) for key in set(seen)}
    pattern = Pattern.of(seen, columns, P, 6)

    def part(views: np.ndarray) -> NormalEquations:
        batches = (views[camera[views] == c] for c in range(2))
        return assemble(
            pattern,
            (
                Rows(
                    frame[v], OF_CAMERA[c], by_globals[v][:, :, None], by_unit[v][:, :, None], left[v][..., None],
                    np.zeros((len(v), ROWS, 0), int), np.zeros((len(v), ROWS, 1, 0)),
                )
                for c, v in enumerate(batches)
            ),
        )  # fmt: skip

    base = part(np.arange(VIEWS)).plus(prior, gradient)
    low_globals = np.zeros((VIEWS, 2, P))
    for v in range(VIEWS):
        low_globals[v][:, OF_CAMERA[camera[v]]] = Q[v].T @ by_globals[v]
    Qt = Q.transpose(0, 2, 1)
    gram = np.einsum("vng,vnh->vgh", extra, extra)
    rows = ViewRows(
        frame[:, None], np.stack([OF_CAMERA[c] for c in camera]), gram, np.einsum("vng,vnh->vgh", extra, by_globals),
        np.einsum("vng,vnh->vgh", extra, by_unit)[:, None], np.einsum("vng,vn->vg", extra, left),
        Qt @ extra, low_globals, Qt @ by_unit, np.zeros((VIEWS, 2)), gram, np.zeros(2, int),
    )  # fmt: skip
    free = np.ones(P, bool)
    eq = Equations(
        ("C1", "C2"), camera, frame, np.ones(VIEWS, bool), tuple("01234"), {"extra": slice(0, 2)},
        SolvedModel(rows, base.covariance(free), free), prior, gradient, np.full(VIEWS, ROWS), np.ones(VIEWS), np.zeros(2, int),
        np.ones(2), np.full(2, excess), part, part, lambda views: np.zeros((0, P)),
    )  # fmt: skip
    return eq, J_all, r, A, sigma


EXTRA = np.array([0, 1])


@pytest.mark.parametrize("seed", range(5))
def test_the_score_test_is_the_gain_of_a_new_solution(seed):
    """With independent noise the statistic is exactly by how much the squares fall when A joins the model."""
    eq, J, r, A, _ = dense_problem(seed)
    where = np.arange(VIEWS) >= 6
    score = score_test(eq, EXTRA, where)
    gradient = np.sqrt(eq.prior) @ np.linalg.solve(eq.prior, eq.prior_gradient)
    left = np.concatenate([r, gradient])
    wider = np.hstack([J, np.vstack([A, np.zeros((len(J) - len(A), 2))])])
    step, *_ = np.linalg.lstsq(wider, -left, rcond=None)
    gain = float(left @ left - np.sum((left + wider @ step) ** 2))
    assert score.statistic == pytest.approx(gain, rel=1e-8)
    np.testing.assert_allclose(score.estimate, step[-2:], rtol=1e-8)
    again = score_test(eq.with_error(EXTRA, where), EXTRA, where)
    assert again.dof == 0  # the model has it now


def test_the_statistic_is_chi2_where_views_err_together():
    """2,000 draws of errors with a common part of each view: mean and variance of chi2(2) within five standard errors."""
    values = []
    eq, J, _, A, sigma = dense_problem(0, excess=8.0)
    rng, n, P = np.random.default_rng(1), VIEWS * ROWS, 8
    chol, C = np.linalg.cholesky(sigma), np.linalg.inv(J.T @ J)
    local_rows = J[:n]
    where = np.arange(VIEWS) >= 6
    prior_sqrt = np.sqrt(np.diag(eq.prior))
    reference = score_test(eq, EXTRA, where)
    M_A = np.vstack([A, np.zeros((P, 2))])
    M_A = M_A - J @ (C @ (J.T @ M_A))
    variance = np.linalg.inv(
        np.linalg.inv(M_A.T @ M_A) @ (M_A[:n].T @ sigma @ M_A[:n] + M_A[n:].T @ M_A[n:]) @ np.linalg.inv(M_A.T @ M_A)
    )
    np.testing.assert_allclose(np.linalg.inv(reference.covariance), variance, rtol=1e-6)
    for _ in range(2000):
        e = np.concatenate([chol @ rng.normal(size=n), prior_sqrt * rng.normal(0, 1 / prior_sqrt)])
        a = -np.linalg.solve(M_A.T @ M_A, M_A.T @ e)
        values.append(a @ variance @ a)
    assert np.mean(values) == pytest.approx(2.0, abs=5 * 2 / np.sqrt(2000))
    assert np.var(values) == pytest.approx(4.0, abs=5 * np.sqrt(8 * 4**2 / 2000))
    assert local_rows.shape == (n, P + 6 * BOARDS)


@pytest.mark.parametrize("seed", range(3))
def test_a_second_error_is_tested_beside_one_that_was_taken_into_the_model(seed):
    """As if the first had been a part of the model from the start: dense least squares with both."""
    eq, J, r, A, _ = dense_problem(seed)
    where, other = np.arange(VIEWS) >= 6, np.arange(VIEWS) % 3 == 0
    B = np.repeat(other, ROWS)[:, None] * np.where(np.repeat(where, ROWS)[:, None], A, all_of(seed))
    left = np.concatenate([r, np.sqrt(eq.prior) @ np.linalg.solve(eq.prior, eq.prior_gradient)])
    nothing = np.zeros((len(J) - len(A), 2))
    wider = np.hstack([J, np.vstack([A, nothing])])
    widest = np.hstack([wider, np.vstack([B, nothing])])
    without, both = (np.linalg.lstsq(M, -left, rcond=None)[0] for M in (wider, widest))
    gain = np.sum((left + wider @ without) ** 2) - np.sum((left + widest @ both) ** 2)
    score = score_test(eq.with_error(EXTRA, where), EXTRA, other)
    assert score.statistic == pytest.approx(gain, rel=1e-7)
    np.testing.assert_allclose(score.estimate, both[-2:], rtol=1e-6)


def all_of(seed):
    """The columns A of every view, also of those that `dense_problem` leaves out."""
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(VIEWS, ROWS, k)) for k in (5, 6, 2)][2].reshape(-1, 2)


@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_frame_taken_away_by_formula_and_in_truth(seed, taken):
    eq, J, r, A, _ = dense_problem(seed)
    if taken:
        eq = eq.with_error(EXTRA, np.arange(VIEWS) >= 6)
        J = np.hstack([J, np.vstack([A, np.zeros((len(J) - len(A), 2))])])
    gone = np.isin(np.arange(VIEWS) % BOARDS, [1, 4])
    held = delete(eq, gone)
    keep = np.concatenate([np.repeat(~gone, ROWS), np.ones(GLOBALS, bool)])
    left = np.concatenate([r, np.sqrt(eq.prior) @ np.linalg.solve(eq.prior, eq.prior_gradient)])
    own = [*range(GLOBALS), *range(GLOBALS + 6 * BOARDS, J.shape[1])]
    step = np.linalg.lstsq(J[keep], -left[keep], rcond=None)[0][own]
    np.testing.assert_allclose(held.step, step, rtol=1e-6)
    seen = J[keep].T @ J[keep]
    np.testing.assert_allclose(held.covariance, np.linalg.pinv(seen)[np.ix_(own, own)], rtol=1e-6)


def test_what_errors_of_all_views_move_the_solution_without_a_frame_by():
    """Three errors, each a number added to the same rows of every view, against the dense solution without the frames."""
    eq, J, _, _, _ = dense_problem(3)
    shared = np.tile(np.random.default_rng(4).normal(size=(3, ROWS)), VIEWS)  # (3, N)
    of_globals, of_units = J[:-GLOBALS, :GLOBALS], J[:-GLOBALS, GLOBALS:]

    def reduced(views):
        rows = np.repeat(np.isin(np.arange(VIEWS), views), ROWS)
        own = np.where(rows, shared, 0.0)
        return own @ of_globals - own @ of_units @ np.linalg.pinv(of_units.T @ of_units) @ of_units.T @ of_globals

    gone = np.isin(np.arange(VIEWS) % BOARDS, [1, 4])
    held = delete(replace(eq, common=reduced), gone)
    keep = np.concatenate([np.repeat(~gone, ROWS), np.ones(GLOBALS, bool)])
    added = np.concatenate([shared, np.zeros((3, GLOBALS))], axis=1)[:, keep]
    moved = np.linalg.lstsq(J[keep], -added.T, rcond=None)[0][:GLOBALS].T
    np.testing.assert_allclose(held.common, moved, rtol=1e-6, atol=1e-12)
    assert held.statistic < delete(eq, gone).statistic  # more is allowed


def test_frames_held_out_by_formula_and_by_a_real_refit():
    """One Gauss-Newton step: what it leaves out is of second order, some hundredths of a standard deviation."""
    result, frames = solved(sv.arc(3, biased=True), 0)
    problem = result.problem
    eq = equations_of(result, held_blocks(problem), frames)
    alone = solve.sandwich_covariance(problem, result.state, result.plain)
    as_solved = replace(eq, excess=np.concatenate([problem.weights.excess_pixel, np.zeros(3)]))
    nothing = np.zeros(len(eq.camera), bool)
    assert np.abs(delete(as_solved, nothing).covariance - alone).max() < 1e-3 * np.abs(alone).max()
    gone_frames = np.isin(result.course.frames, frames[:4])
    gone = gone_frames[eq.rows.units[:, 0]]
    held = delete(eq, gone)
    rows = ~gone_frames[problem.obs.frame][:, None]
    kept = problem.using(problem.obs.keep(problem.obs.has_pixel & rows, problem.obs.has_depth & rows))
    refit = solve.minimize(kept, result.state, 30, 1e-12)
    for i in range(3):
        real = np.concatenate(
            [
                se3.difference(refit.state.T_world_color[i], result.state.T_world_color[i]),
                refit.state.intrinsics[i] - result.state.intrinsics[i],
                refit.state.values["depth bias"][i] - result.state.values["depth bias"][i],
            ]
        )
        own = np.concatenate([problem.index(name, i) for name in ("pose", "intrinsics", "depth bias")])
        sd = np.sqrt(np.maximum(np.diag(held.covariance)[own], 1e-30))
        moving = eq.free[own]
        assert np.abs((held.step[own] - real) / sd)[moving].max() < 0.1


def test_nothing_is_said_of_good_recordings():
    """Six recordings, 80 tests each: the statistics have the size of their degrees of freedom, and none is a finding."""
    ratios = []
    for seed in range(6):
        result, frames = solved(sv.arc(3, biased=True), seed)
        held = held_blocks(result.problem)
        eq = equations_of(result, held, frames)
        tests = outcomes_of(eq, result.problem, held, PARAMS)
        assert findings_of(eq, tests, PARAMS, 0.0)[0] == []
        ratios += [t.score.statistic / t.score.dof for t in tests if t.score.dof]
    # tests of one recording overlap: some 30 independent ones a recording, each sqrt(2 / 4) or less about one
    assert np.mean(ratios) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 4 / (6 * 30)))


def test_parts_that_are_held_out_of_a_sound_recording_fit_and_say_it_in_all_their_numbers():
    """One camera is not in the first part: what that part says of it is nothing, and no rounding becomes a statistic."""

    def without_c3(views, rng):
        return [v for v in views if v.camera != "C3" or v.frame > "000003"]

    result, frames = solved(sv.arc(3, biased=True), 2, frames=16, change=without_c3)
    held = hold_out(equations_of(result, held_blocks(result.problem), frames), PARAMS)
    assert len(held) == PARAMS.folds
    for part in held:
        assert part.dof > 60, part  # corners of four boards and what they say of lenses and depth
        assert 0.5 < part.chi2 / part.dof < 2, part


FAULTS = {
    "pose over time": lambda views, rng: moved_from(
        views, "000007", "C2", lambda v: replace(v, corners_px=v.corners_px + [1.5, 0.7])
    ),
    "depth over time": lambda views, rng: moved_from(
        views, "000007", "C2", lambda v: replace(v, depth_m=v.depth_m + 0.012)
    ),
    "bias given": lambda views, rng: moved_from(views, "", "C2", lambda v: replace(v, depth_m=v.depth_m + 0.02)),
    "lens between recordings": lambda views, rng: moved_from(
        views, "", "C2", lambda v: replace(v, corners_px=(v.corners_px - [320, 240]) * 1.04 + [320, 240])
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_error_is_named_with_its_camera(fault):
    result, frames = solved(sv.arc(3, biased=True), 1, change=FAULTS[fault])
    nothing = AssociationResult((), {}, {}, (), "C1")
    views = [p.view for p in result.course.views if p.view.frame in frames]
    check = check_bundle(result, sv.BOARD, views, nothing, frames, 0.0, PARAMS)
    assert not check.trusted
    first = check.findings[0]
    also = {
        "pose over time": {"lens over time"},  # a small turn is a shift of the centre
        "depth over time": {"views left out"},
        "bias given": {"depth between recordings", "views left out"},
        "lens between recordings": {"depth between recordings", "bias given", "views left out"},
    }
    assert first.check in {fault} | also.get(fault, set()), [f.text for f in check.findings]
    assert first.cameras == ("C2",)
    assert "C2" in first.text


def test_depth_that_errs_over_the_image_is_taken_into_the_model():
    def change(views, rng):
        return moved_from(
            views, "", "C2", lambda v: replace(v, depth_m=v.depth_m * (1 + 0.03 * (v.corners_px[:, 0] / 320 - 1) ** 3))
        )

    result, frames = solved(sv.arc(3, biased=True), 1, change=change)
    views = [p.view for p in result.course.views if p.view.frame in frames]
    assert check_bundle(result, sv.BOARD, views, AssociationResult((), {}, {}, (), "C1"), frames, 0.0, PARAMS).trusted
    # 60 mm at two metres and the images' rims; a variance from 1000 depths is known to 4 %
    assert result.problem.weights.k_depth == pytest.approx(NOISE.k_depth_per_m, rel=0.15)


def view(frame: str, camera: str = "C1", shift: float = 0.0, depth: float = 2.0):
    v = true_views(sv.arc(2), {frame: se3.make(np.eye(3), np.array([-0.24, -0.15, 2.0]))}, sv.BOARD, sv.EXACT, np.random.default_rng(0))[0]  # fmt: skip
    return replace(v, camera=camera, corners_px=v.corners_px + shift, depth_m=np.full(len(v.ids), depth))


@pytest.mark.parametrize("distance_m", [0.5, 2.0, 6.0])
def test_the_same_error_counts_by_the_distance_at_which_it_is(distance_m):
    limits = SelfCheckParams().at(distance_m)
    own = {"C1": ResidualNoise(0.1, 1e-3, apart_px_mm=6e-3 * 1e3 * distance_m)}
    assert [f.level for f in check_noise(own, limits, 0.0)] == ["caution"]
    assert limits.caution_mm == pytest.approx(0.5 * distance_m)
    assert limits.distrust_mm == pytest.approx(1.5 * distance_m)
    assert limits.max_sigma_px == SelfCheckParams().max_sigma_px  # pixels are pixels at any distance


def test_checks_without_equations():
    assert check_votes([(("C1", "C2"), 10, 6, None)], True, PARAMS) == []
    (found,) = check_votes([(("C1", "C2"), 10, 4, None)], False, PARAMS)
    assert "only 4 of 10 common frames agree" in found.text
    assert "two_sided" in found.advice
    frames = [f"{k:03d}" for k in range(20)]
    assert check_dropped({"C1": frames}, {"C1": frames[:6]}, frames, PARAMS) == []
    (found,) = check_dropped({"C1": frames}, {"C1": frames[12:]}, frames, PARAMS)
    assert "8 of C1's 20 views" in found.text
    assert "all between 012 and 019" in found.text
    (found,) = check_dropped({"C1": frames[::2]}, {"C1": frames[12::2]}, frames, PARAMS)  # half of the frames seen
    assert "4 of C1's 10 views" in found.text and "all between 012 and 018" in found.text
    (found,) = check_dropped({"C1": frames}, {"C1": [frames[2], *frames[11:15], *frames[16:]]}, frames, PARAMS)
    assert "9 of C1's 20 views" in found.text and "8 of them between 011 and 019" in found.text
    (found,) = check_dropped({"C1": frames}, {"C1": frames[::2]}, frames, PARAMS)
    assert "between" not in found.text
    assert check_noise({"C1": ResidualNoise(0.2, 2e-3)}, PARAMS, 0.5) == []
    levels = [
        f.level for f in check_noise({"C1": ResidualNoise(0.7, 7e-3), "C2": ResidualNoise(1.4, 2e-2)}, PARAMS, 0.5)
    ]
    assert levels == ["caution", "caution", "distrust", "distrust"]
    assert check_noise({"C1": ResidualNoise(None, None, 20.0, 0.0)}, PARAMS, 0.5)[0].check == "boards apart"
    still = [view(f"{k:03d}", shift=0.01 * k) for k in range(5)]
    moving = [view(f"{k:03d}", shift=20.0 * k) for k in range(5)]
    assert check_copies(moving, 0.1, PARAMS) == []
    assert "5 frames show the board in 1 places" in check_copies(still, 0.1, PARAMS)[0].text
    depths = [view(f"{k:03d}", depth=min(1.5 + 0.1 * k, 1.8)) for k in range(8)]
    assert "1.80 m, and none is more" in check_clipped(depths, PARAMS)[0].text
    rng = np.random.default_rng(0)
    spread = [replace(v, depth_m=v.depth_m + rng.normal(0, 3e-3, len(v.ids))) for v in moving]
    assert check_clipped(spread, PARAMS) == []
    ratios = group_ratios(np.concatenate([np.ones(300), 5 * np.ones(100)]), np.repeat([0, 1], [300, 100]), 100)
    assert check_groups({("C1", "pixels", "in its first half"): ratios[0]}, PARAMS) == []
    assert len(check_groups({("C1", "pixels", "near the image's edge"): 2.5}, PARAMS)) == 1
