"""The joint bundle: derivatives, the minimum, the honesty of its covariance, gross errors, what it cannot tell."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import synthetic_views as sv
from scipy.optimize import least_squares

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.rig import solve
from rgbd_calib.rig.blocks import ESTIMATED, HELD, DepthBiasBlock, Kind
from rgbd_calib.rig.blocks.block import Scope
from rgbd_calib.rig.bundle import bundle, free_structure, freed, problem_of
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.setup import BundleParams, CameraPrior
from rgbd_calib.rig.solution import Solution
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.types import Board, DepthBias, PlacedView, Rig, RigCamera

NOISE = ViewNoise(0.1, 0.7e-3, 0.0)


BIAS_SD = np.diag([1e-3, 1e-3, 5e-4]) ** 2


"""What a wall recording leaves: a millimetre or so."""


def draw(rig: Rig, board: Board, frames: int, rng: np.random.Generator, noise: ViewNoise = NOISE) -> list[PlacedView]:
    """Views of drawn board poses, with true face and pose."""
    boards = sv.board_poses(rig, board, frames, rng)
    return list(sv.placed_truly(rig, boards, true_views(rig, boards, board, noise, rng), board))


def priors_of(rig: Rig, rng: np.random.Generator, with_bias: bool = True) -> dict[str, CameraPrior]:
    """Lenses a little off, and depth biases drawn about the truth with the covariance that they claim."""
    out = {}
    for name, own in rig.cameras.items():
        lens = own.intrinsics.vector + rng.normal(0, 1, 9) * [2, 2, 2, 2, 0.01, 0.01, 1e-4, 1e-4, 0]
        bias = None
        if with_bias and own.depth_bias is not None:
            drawn = rng.multivariate_normal(own.depth_bias.coefficients, BIAS_SD)
            bias = DepthBias(tuple(drawn), own.depth_bias.min_m, own.depth_bias.max_m, 0.0, BIAS_SD)
        out[name] = CameraPrior(own.intrinsics.with_vector(lens), None, True, bias)
    return out


def solved(rig: Rig, views: Sequence[PlacedView], board: Board, rng: np.random.Generator) -> Solution:
    T = {name: se3.retract(own.T_world_color, rng.normal(0, 0.005, 6)) for name, own in rig.cameras.items()}
    T["C1"] = rig.cameras["C1"].T_world_color
    return bundle(views, board, priors_of(rig, rng), T, "C1")


def rig_of(result: Solution) -> Rig:
    cameras = {
        name: RigCamera(result.intrinsics(name), result.T_world_color(name), np.zeros((6, 6)), result.depth_bias(name))
        for name in result.cameras
    }
    return Rig("C1", cameras)


def alignment_m(result: Solution, truth: Rig) -> float:
    """Mean over what two cameras see between 1 and 3 m."""
    return float(against_truth(rig_of(result), truth, {}, None).distance_m.mean())


def problem(seed: int, every_block: bool = False, hold: tuple[str, ...] = ()) -> tuple[Problem, State]:
    """A small two-sided problem with a single-camera frame, away from its minimum."""
    rng = np.random.default_rng(seed)
    rig, board = sv.ring(3, biased=True), sv.TWO_SIDED
    views = draw(rig, board, 4, rng)
    views[0] = replace(views[0], view=replace(views[0].view, frame="alone", alone=True))
    T = {name: se3.retract(own.T_world_color, rng.normal(0, 0.003, 6)) for name, own in rig.cameras.items()}
    params = BundleParams(sigma_2d_px=0.1, k_depth_per_m=7e-4, hold=hold)
    own, state, _ = problem_of(views, board, priors_of(rig, rng), T, "C1", params)
    if every_block:
        own = Problem.of(own.setup, (*ESTIMATED, *HELD))
        state = own.start(state.boards)
    off = {"pose": 0.0, "intrinsics": 0.0, "depth bias": 0.0, "pixel field": 0.0, "corner offsets": 1e-4}
    steps = [rng.normal(0, off.get(b.name, 1e-3), b.size) for b in own.blocks]
    return own, own.moved(state, np.concatenate(steps), np.zeros((own.obs.n_frames, 6)))


def test_what_bends_a_bias_is_known_from_what_makes_it() -> None:
    """Nobody is told to film for it."""
    own, _ = problem(0)
    unknown = tuple(replace(prior, bias=None) for prior in own.setup.priors)
    assumed = DepthBiasBlock(replace(own.setup, priors=unknown)).prior().assumed
    assert assumed.reshape(3, -1).tolist() == [[True, True, True, False]] * 3


@pytest.mark.parametrize("structure", ["board", "free"])
@pytest.mark.parametrize("seed", range(2))
def test_derivatives_of_every_block_agree_with_central_differences(seed: int, structure: str) -> None:
    own, state = problem(seed, every_block=True)
    if structure == "free":
        own, state = freed(own, state)
        off = np.random.default_rng(seed).normal(0, 0.01, state.boards.corners_m.shape)
        state = replace(state, boards=replace(state.boards, corners_m=state.boards.corners_m + off))
    P, F, D = own.n_globals, own.obs.n_frames, own.unit_size
    h = 1e-6
    analytic = np.zeros((len(own.obs.camera), own.obs.has_pixel.shape[1], 3, P + D))
    ones = (own.obs.has_pixel.astype(float), own.obs.has_depth.astype(float))
    for views, look, rows in own.rows(state, scales=ones):
        at = slice(0, 2) if look.kind is Kind.PIXEL else slice(2, 3)
        analytic[views[:, None], :, at, rows.columns] += np.moveaxis(rows.J, -1, 1)
        analytic[views, :, at, P:] += rows.J_unit
        for view, corner in np.ndindex(rows.point_columns.shape[:2]):
            analytic[views[view], corner, at, rows.point_columns[view, corner]] += rows.J_point[view, corner].T
    held = {k for b in own.blocks if b.name in HELD_IN_PREDICTION for k in own.index(b.name)}
    for k in range(P + D):
        step, units = np.zeros(P), np.zeros((F, D))
        if k < P:
            step[k] = h
        else:
            units[:, k - P] = h
        if k in held:
            continue
        plus, minus = (own.residuals(own.moved(state, s * step, s * units)) for s in (1, -1))
        for rows_of, a, b in ((analytic[:, :, :2, k], plus[0], minus[0]), (analytic[:, :, 2, k], plus[1], minus[1])):
            numeric = (a - b) / (2 * h)
            # central differences: h^2 third derivatives and 1e-13 / h rounding, of values up to 1e3
            assert np.abs(rows_of - numeric).max() < 1e-5 * max(1.0, np.abs(numeric).max()), k


HELD_IN_PREDICTION = {"pixel field"}


"""Held at zero, where their derivative is taken: a test of their own."""


def test_the_minimum_is_that_of_scipy() -> None:
    own, state = problem(7, hold=("depth field", "corner offsets"))  # linear, and slow by differences
    found = solve.minimize(own, state, 100, 1e-14)
    free = np.flatnonzero(own.prior.free)
    F = own.obs.n_frames
    w_pixel, w_depth = own.weights.scales(own.obs)
    root = np.linalg.cholesky(own.prior.information + 1e-30 * np.eye(own.n_globals)).T

    def residuals(x: np.ndarray) -> np.ndarray:
        step = np.zeros(own.n_globals)
        step[free] = x[: len(free)]
        moved = own.moved(state, step, x[len(free) :].reshape(F, 6))
        pixel, depth = own.residuals(moved)
        known = root @ (own.vector(moved) - own.prior.mean)
        return np.concatenate([(pixel * w_pixel[..., None]).ravel(), (depth * w_depth).ravel(), known])

    independent = least_squares(
        residuals, np.zeros(len(free) + 6 * F), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    assert found.cost == pytest.approx(independent.cost, rel=1e-8)


def test_the_covariance_of_the_poses_is_honest() -> None:
    seeds, values = 24, []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        rig = sv.arc(3, biased=True)
        result = solved(rig, draw(rig, sv.BOARD, 14, rng), sv.BOARD, rng)
        error, at = [], []
        for i, name in enumerate(result.cameras[1:], start=1):
            error.append(se3.difference(rig.cameras[name].T_world_color, result.state.T_world_color[i]))
            at.append(result.index("pose", name))
        e, index = np.concatenate(error), np.concatenate(at)
        values.append(e @ np.linalg.solve(result.covariance[np.ix_(index, index)], e) / len(e))
    # chi^2 with 12 degrees of freedom over 24 seeds: standard error sqrt(2 / 12 / 24) = 0.083, 4 of them, and 0.1 for
    # the weights, which are estimated from a few hundred residuals
    assert abs(np.mean(values) - 1) < 0.43


@cache
def clean_views() -> tuple[Rig, list[PlacedView], float, np.random.Generator]:
    """A rig, its views, the alignment that these give, and what they were drawn by."""
    rng, rig = np.random.default_rng(11), sv.arc(4, 15.0, biased=True)
    views = draw(rig, sv.BOARD, 20, rng)
    return rig, views, alignment_m(solved(rig, views, sv.BOARD, np.random.default_rng(0)), rig), rng


@pytest.mark.parametrize("kind", ["moved", "late depth", "wrong corners", "hand"])
def test_a_tenth_of_spoiled_views_does_not_matter(kind: str) -> None:
    rig, views, clean, rng = deepcopy(clean_views())
    bad = set(rng.choice(len(views), len(views) // 10, replace=False).tolist())
    spoiled = [spoil(placed, kind, rig, rng) if i in bad else placed for i, placed in enumerate(views)]
    result = solved(rig, spoiled, sv.BOARD, np.random.default_rng(0))
    named = {(views[i].view.camera, views[i].view.frame) for i in bad}
    if kind != "hand":  # single corners go there, and are counted
        assert named <= set(result.course.dropped)
        # a rule of four medians cuts no good view but by a rare accident
        assert len(set(result.course.dropped) - named) <= 2
    else:
        assert result.course.dropped_depth_corners + len(result.course.dropped) >= len(bad)
    # 1.2 of the clean result, with 0.2 mm for the views that are missing
    assert alignment_m(result, rig) < 1.2 * clean + 2e-4


def spoil(placed: PlacedView, kind: str, rig: Rig, rng: np.random.Generator) -> PlacedView:
    view = placed.view
    if kind == "moved":  # the board went 2 cm sideways before this camera's shot
        return replace(placed, view=replace(view, corners_px=view.corners_px + rng.choice([-6.0, 6.0], 2)))
    if kind == "late depth":  # it went 3 cm before the depth was taken
        return replace(placed, view=replace(view, depth_m=view.depth_m + 0.03))
    if kind == "wrong corners":  # a blurred frame
        return replace(
            placed, view=replace(view, corners_px=view.corners_px + rng.normal(0, 1.0, view.corners_px.shape))
        )
    hand = np.arange(len(view.ids)) % 9 < 3
    return replace(placed, view=replace(view, depth_m=np.where(hand, view.depth_m - 0.1, view.depth_m)))


def test_a_camera_that_no_view_joins_any_more_is_an_error() -> None:
    rng = np.random.default_rng(5)
    rig = sv.arc(3, biased=True)
    views = draw(rig, sv.BOARD, 12, rng)
    spoiled = [
        replace(p, view=replace(p.view, corners_px=p.view.corners_px + rng.normal(0, 30, 2)))
        if p.view.camera == "C3" and k % 3
        else p
        for k, p in enumerate(views)
    ]
    lone = [p for k, p in enumerate(spoiled) if p.view.camera != "C3" or k % 3]
    with pytest.raises(CalibrationError, match=r"C3: too few views are left that agree .* film again"):
        solved(rig, lone, sv.BOARD, rng)


def test_what_one_square_view_cannot_tell_is_said_and_left_to_what_is_assumed() -> None:
    rng = np.random.default_rng(2)
    rig = sv.arc(2)
    T = se3.make(np.eye(3), np.array([-0.2, -0.1, 2.0]))
    views = sv.placed_truly(rig, {"0": T}, true_views(rig, {"0": T}, sv.BOARD, NOISE, rng), sv.BOARD)
    priors = {name: CameraPrior(own.intrinsics, None, False, None) for name, own in rig.cameras.items()}
    poses = {name: own.T_world_color for name, own in rig.cameras.items()}
    result = bundle(views, sv.BOARD, priors, poses, "C1")
    assert any("C1's principal point cx" in sentence for sentence in result.observability.sentences)
    at = result.index("intrinsics", "C1")[2]
    assert result.observability.undetermined[at]
    # the noise of 54 corners draws it by less than what is assumed of it
    sd_px = result.problem.prior.information[at, at] ** -0.5
    assert abs(result.state.intrinsics[0][2] - rig.cameras["C1"].intrinsics.cx) < 0.1 * sd_px


def test_a_camera_without_depth_takes_part() -> None:
    rng = np.random.default_rng(4)
    rig = sv.arc(3, biased=True)
    views = [
        replace(p, view=sv.without_depth(p.view)) if p.view.camera == "C2" else p for p in draw(rig, sv.BOARD, 14, rng)
    ]
    result = solved(rig, views, sv.BOARD, rng)
    assert result.has_depth == (True, False, True)
    error = se3.difference(rig.cameras["C2"].T_world_color, result.state.T_world_color[1])
    sd = np.sqrt(np.diag(result.covariance)[result.index("pose", "C2")])
    assert np.all(np.abs(error) < 5 * sd)  # 5 sigma, 6 numbers: 1 failure in 300,000


def test_free_structure_does_not_mind_a_board_that_is_not_what_was_printed() -> None:
    """Corners off by 1 mm, each by its own: 0.3 px, three times the noise."""
    poses = []
    for misprint_m in (0.0, 1e-3):
        rng = np.random.default_rng(2)
        rig, board = sv.arc(3, biased=True), sv.BOARD
        boards = sv.board_poses(rig, board, 12, rng)
        off_m = misprint_m * rng.normal(0, 1, (board.n_corners, 3))

        class Misprinted(Board):
            def corners_m(self, back: bool = False, off_m: FloatArray = off_m) -> FloatArray:
                return super().corners_m(back) + off_m

        filmed = Misprinted(**{field.name: getattr(board, field.name) for field in fields(board)})
        views = sv.placed_truly(rig, boards, true_views(rig, boards, filmed, NOISE, rng), board)
        rigid = solved(rig, views, board, rng)
        free = free_structure(rigid)
        assert free.course.converged
        # a variance from n residuals is known to sqrt(2 / n): 2,000 rows and more, a third of them absorbed by the points
        assert np.abs(free.problem.weights.sigma_2d_px / NOISE.sigma_2d_px - 1).max() < 0.15
        error = np.concatenate(
            [
                se3.difference(rig.cameras[n].T_world_color, free.state.T_world_color[i])
                for i, n in enumerate(free.cameras)
            ][1:]
        )
        at = np.concatenate([free.index("pose", name) for name in free.cameras[1:]])
        covariance = free.covariance[np.ix_(at, at)]
        assert (
            error @ np.linalg.solve(covariance, error) < 36
        )  # chi^2 with 12 degrees of freedom: 3 in 10,000 are larger
        poses.append((error, np.sqrt(np.diag(covariance)), rigid.problem.weights.sigma_2d_px.min()))
    (right, sd, fits), (wrong, _, does_not) = poses
    assert np.abs(right - wrong).max() < 0.2 * sd.max()
    # the board's shape takes what lies in its plane; what stands out of it by a millimetre, at 45 degrees, is left
    assert fits < 0.12 < does_not


def test_the_third_radial_coefficient_that_few_views_started_with_is_no_knowledge() -> None:
    """k3 = 8 would bend the image's corner by hundreds of px: it is taken back as far as the views do not ask for it."""
    rig, rng = sv.arc(2, biased=True), np.random.default_rng(3)
    placed = draw(rig, sv.BOARD, 8, rng)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    priors = priors_of(rig, rng)
    plain = bundle(placed, sv.BOARD, priors, T, "C1")
    for name, prior in priors.items():
        lens = prior.intrinsics.vector
        lens[8] = 8.0
        priors[name] = replace(prior, intrinsics=prior.intrinsics.with_vector(lens))
    wild = bundle(placed, sv.BOARD, priors, T, "C1")
    for name in rig.cameras:
        np.testing.assert_allclose(wild.intrinsics(name).vector, plain.intrinsics(name).vector, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    "block, said",
    [
        ("depth field", "C2's depth does not follow the board"),
        ("intrinsics", "does not determine C2's intrinsics"),
        ("print", "does not determine the print"),
    ],
)
def test_singular_equations_name_what_is_not_determined(monkeypatch, block: str, said: str) -> None:
    own, state = problem(0)
    equations = own.equations(state)
    at = own.index(block, own.setup.cameras.index("C2") if own.block(block).scope is Scope.CAMERA else None)[0]
    U, free = equations.U.copy(), np.flatnonzero(own.prior.free)
    alone = 1 / symmetric_inverse(equations.reduced[np.ix_(free, free)])[np.searchsorted(free, at)].max()
    assert alone < equations.reduced[at, at]
    U[at, at] -= (alone + equations.reduced[at, at]) / 2  # indefinite, with a positive diagonal
    monkeypatch.setattr(Problem, "equations", lambda *_: replace(equations, U=U))
    with pytest.raises(CalibrationError, match=said):
        solve.covariance(own, state)
