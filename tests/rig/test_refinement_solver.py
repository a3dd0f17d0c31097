"""The solver against definitions: dense Jacobians by differences, pairs summed one by one, and scipy's minimum."""

import numpy as np
import pytest
from refinement_cases import LENS, make
from scipy.optimize import least_squares

from rgbd_calib.geometry import camera, se3
from rgbd_calib.rig.biobjective import RefinementParams, groups, kernels, refine, solver
from rgbd_calib.rig.biobjective import problem as problems
from rgbd_calib.rig.biobjective.loss import Loss
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.terms import MeasuredPointTerm


def residuals_2d(data, K, T, X):
    """q - psi (eq. 2.3), (n2, 2), by geometry.camera."""
    p = se3.transform(se3.inverse(T)[data.pixel_camera], X[data.pixel_point])
    return data.pixels_px - camera.project(np.stack([K[c].vector for c in data.cameras])[data.pixel_camera], p)


def residuals_3d(data, T):
    """y - y_mean, (n3, 3)."""
    y = se3.transform(T[data.xyz_camera], data.xyz_m)
    n = len(data.labels)
    count = np.maximum(np.bincount(data.xyz_point, minlength=n), 1)
    mean = np.stack([np.bincount(data.xyz_point, y[:, i], n) for i in range(3)], axis=1) / count[:, None]
    return y - mean[data.xyz_point]


def shared(data):
    """Rows whose point has two pixels or more."""
    return np.bincount(data.pixel_point, minlength=len(data.labels))[data.pixel_point] >= 2


def scipy_minimum(data, K, start, sigmas):
    """Least cost (eq. 4.4 in its latent form) by scipy's trust region on the full residual vector."""
    rows = shared(data)
    labels = np.unique(data.pixel_point[rows])
    T0 = np.stack([start[c] for c in data.cameras])
    problem = problems.build(data, K, start, "C1", RefinementParams(sigma_2d_px=1.0, sigma_3d_m=1.0))
    X0 = np.full((len(data.labels), 3), np.nan)
    X0[problem.pixels.grouping.labels] = problem.start.points[0].T
    free = 6 * (len(T0) - 1)

    def fun(x):
        T = T0.copy()
        T[1:] = se3.retract(T0[1:], x[:free].reshape(-1, 6))
        X = X0.copy()
        X[labels] += x[free:].reshape(-1, 3)
        return np.concatenate(
            [residuals_2d(data, K, T, X)[rows].ravel() / sigmas[0], residuals_3d(data, T).ravel() / sigmas[1]]
        )

    x = np.zeros(free + 3 * len(labels))
    out = least_squares(fun, x, x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12)
    return 2 * out.cost


@pytest.mark.parametrize("seed", range(20))
def test_same_minimum_as_scipy(seed):
    rng = np.random.default_rng(seed)
    sigmas = rng.uniform(0.2, 1.8), rng.uniform(0.006, 0.03)
    data, K, start, _ = make(
        rng, int(rng.integers(2, 5)), (9, 9), sigmas, visible=rng.uniform(0.75, 1.0), lens=bool(seed % 2)
    )
    result = refine(data, K, start, "C1", RefinementParams(sigma_2d_px=sigmas[0], sigma_3d_m=sigmas[1]))
    assert result.status == "converged"
    assert result.cost == pytest.approx(scipy_minimum(data, K, start, sigmas), rel=1e-8)


def test_projection_and_jacobian_are_those_of_the_camera():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.5, 0.5, (2, 2, 50))
    z = rng.uniform(1, 3, (2, 50))
    lens = np.tile(np.array(LENS)[:, None, None], (1, 2, 1))
    focal = np.array([[500.0, 510.0], [520.0, 530.0]])[:, :, None]
    A = kernels.pixel_jacobian(np.tile(np.eye(3), (2, 1, 1)), xy, 1 / z, focal, lens, kernels.Memory())
    for l in range(2):  # noqa: E741  (the paper's index)
        vector = np.array([*focal[l, :, 0], 0, 0, *LENS])
        p = np.stack([*(xy[l] * z[l]), z[l]], axis=1)
        pixels, J, _ = camera.project_jacobian(vector, p)
        np.testing.assert_allclose(kernels.distort(lens, xy)[l] * focal[l], pixels.T, rtol=1e-13)
        np.testing.assert_allclose(A[l].transpose(2, 1, 0), J, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("visible", [1.0, 0.6])
@pytest.mark.parametrize("kind", ["pixels", "measured"])
def test_reduced_normal_equations_are_those_of_the_dense_jacobian(kind, visible):
    rng = np.random.default_rng(1)
    data, K, start, _ = make(rng, 3, (15, 15), visible=visible, lens=True)
    cov = rng.normal(0, 1, (len(data.xyz_m), 3, 3))
    number = np.arange(3)
    params = RefinementParams(sigma_2d_px=0.7, sigma_3d_m=0.02)
    problem = problems.build(data, K, start, "C1", params)
    if kind == "pixels":
        term, X = problem.pixels, problem.start.points[0]
        term.set_sigmas(np.array([0.7, 0.8, 0.9]))
    else:
        grouping = groups.by_visibility(number[data.xyz_camera], data.xyz_point, 3)
        term = MeasuredPointTerm(grouping, data.xyz_m, cov @ cov.transpose(0, 2, 1) + np.eye(3), 3, Loss())
        X = rng.uniform([[-1.0], [-1.0], [2.0]], [[1.0], [1.0], [3.0]], (3, len(grouping.labels)))
        term.set_sigmas(np.array([0.02, 0.03, 0.01]))
    T = problem.start.T

    def r(x):
        moved = T.copy()
        moved[1:] = se3.retract(T[1:], x[:12].reshape(2, 6))
        term.evaluate(moved, X + x[12:].reshape(X.shape))
        table = term.residuals()[0]
        return table[np.isfinite(table[:, 0])].ravel()

    h = 1e-6
    zero = np.zeros(12 + X.size)
    J = -np.stack([(r(zero + h * e) - r(zero - h * e)) / (2 * h) for e in np.eye(len(zero))], axis=1)
    H, b = J.T @ J, J.T @ r(zero)
    gain = np.linalg.solve(H[12:, 12:], np.column_stack([H[12:, :12], b[12:]]))
    S, g, U, _ = term.normal(0.0)
    size = np.abs(np.diag(S)).max()
    np.testing.assert_allclose(S, H[:12, :12] - H[:12, 12:] @ gain[:, :12], atol=1e-6 * size)  # differences: h^2
    np.testing.assert_allclose(g, b[:12] - H[:12, 12:] @ gain[:, 12], atol=1e-6 * np.abs(b).max())
    np.testing.assert_allclose(U, np.diag(H)[:12], rtol=1e-6)
    xi = rng.normal(0, 1, 12)
    step = np.linalg.solve(H[12:, 12:], b[12:] - H[12:, :12] @ xi).reshape(X.shape)
    np.testing.assert_allclose(term.step(xi), step, rtol=1e-4, atol=1e-5 * np.abs(step).max())


@pytest.mark.parametrize("visible", [1.0, 0.6])
def test_moments_give_the_cost_gradient_and_hessian_of_the_points(visible):
    rng = np.random.default_rng(2)
    data, _, start, truth = make(rng, 4, (5, 200), visible=visible)
    T0, T = (np.stack([poses[c] for c in data.cameras]) for poses in (start, truth))
    grouping = groups.by_visibility(data.xyz_camera, data.xyz_point, 4)
    moments = MomentTerm(grouping, data.xyz_m, T0, pairs=False)
    points = MeasuredPointTerm(grouping, data.xyz_m, None, 4, Loss())
    y = residuals_3d(data, T)
    X = np.stack([(se3.transform(T[data.xyz_camera], data.xyz_m) - y)[data.xyz_point == j][0] for j in grouping.labels])
    for term in (moments, points):
        term.set_sigmas(np.full(4, 0.018))
    cost = moments.evaluate(T)
    seen = np.bincount(data.xyz_point, minlength=len(data.labels))[data.xyz_point] >= 2
    assert cost == pytest.approx(np.sum(y[seen] ** 2) / 0.018**2, rel=1e-11)
    assert cost == pytest.approx(points.evaluate(T, X.T), rel=1e-11)
    S, g = moments.normal()
    S_points, g_points, _, _ = points.normal(0.0)
    # J of the latent form is at x, of the moments at y: equal but for the residual, 0.018 m on 2.5 m
    np.testing.assert_allclose(S, S_points, atol=0.02 * np.abs(S).max())
    np.testing.assert_allclose(g, g_points, atol=1e-9 * np.abs(g).max())


def test_moments_of_pairs_are_eq_2_6():
    rng = np.random.default_rng(3)
    data, _, start, truth = make(rng, 4, (5, 40), visible=0.7)
    T0, T = (np.stack([poses[c] for c in data.cameras]) for poses in (start, truth))
    term = MomentTerm(groups.by_visibility(data.xyz_camera, data.xyz_point, 4), data.xyz_m, T0, pairs=True)
    y = se3.transform(T[data.xyz_camera], data.xyz_m)
    total = 0.0
    for j in np.unique(data.xyz_point):
        own = y[data.xyz_point == j]
        total += sum(np.sum((own[a] - own[b]) ** 2) for a in range(len(own)) for b in range(a))
    assert term.evaluate(T) == pytest.approx(total / 2, rel=1e-11)  # V_ICP / (2 sigma_3D^2)


@pytest.mark.parametrize("seed", range(5))
def test_groups_hold_each_shared_observation_once(seed):
    rng = np.random.default_rng(seed)
    number, point = np.nonzero(rng.random((6, 300)) < rng.uniform(0.1, 1.0))
    shuffled = rng.permutation(len(number))
    number, point = number[shuffled], point[shuffled]
    grouping = groups.by_visibility(number, point, 6)
    rows = []
    for block in grouping.blocks:
        seen = np.ones(block.rows.shape, bool) if block.seen is None else block.seen
        assert np.all(point[block.rows] == grouping.labels[block.points], where=seen)
        assert np.all(number[block.rows] == block.cameras[:, None], where=seen)
        rows.append(block.rows[seen])
    views = np.bincount(point)[point]
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.flatnonzero(views >= 2))
    np.testing.assert_array_equal(grouping.alone, np.flatnonzero(views < 2))


def test_solver_says_why_it_stopped():
    data, K, start, _ = make(np.random.default_rng(4), 2)
    problem = problems.build(data, K, start, "C1", RefinementParams())
    for tolerance, limit, status in ((1e-10, 1, "iteration_limit"), (1e-10, 100, "converged")):
        out = solver.minimize(problem.terms, problem.start, False, tolerance, limit)
        assert out.status == status
        assert out.message
