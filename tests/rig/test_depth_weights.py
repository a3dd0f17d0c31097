"""Depth that errs as a whole: boards weighed by it, time of flight along the ray, walls that look bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from test_bundle import draw, priors_of, solved

from rgbd_calib.cameras.wall import wall_cells
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import Assembly
from rgbd_calib.rig import solve
from rgbd_calib.rig.blocks import Kind
from rgbd_calib.rig.bundle import bundle
from rgbd_calib.rig.observations import SeenWall, Walls
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.recording import camera_infos, true_rig_of
from rgbd_calib.simulation.views import ViewNoise
from rgbd_calib.types import DepthBias

OFF_AS_A_WHOLE = ViewNoise(0.1, 0.7e-3, 3e-3)
"""Boards whose depth is offset by 3e-3 z^2, beside single corners' 0.7e-3 z^2."""


@pytest.fixture(scope="module")
def found():
    rng, rig = np.random.default_rng(2), sv.arc(3, biased=True)
    return rig, solved(rig, draw(rig, sv.BOARD, 14, rng, OFF_AS_A_WHOLE), sv.BOARD, rng)


def test_the_gradient_is_that_of_the_cost(found):
    """By central differences, where whole boards are weighed less: rows, and what is taken off them."""
    problem, state = found[1].problem, found[1].state
    assert problem.weights.ratio_depth[0] > 10
    gradient = problem.equations(state).gradient
    for name in ("pose", "intrinsics", "depth bias"):
        at = problem.index(name, 1)[0]
        sd = np.sqrt(found[1].covariance[at, at])
        step = np.zeros(problem.n_globals)
        step[at] = sd
        ahead, behind = (
            problem.cost(problem.moved(state, s * step, 0.0 * problem.unit_vector(state))) for s in (1, -1)
        )
        curvature = problem.equations(state).U[at, at]
        assert (ahead - behind) / 2 == pytest.approx(gradient[at] * sd, abs=1e-3 * curvature * sd**2)


def test_what_is_taken_off_makes_the_weight_matrix(found):
    problem, state = found[1].problem, found[1].state
    some, look, rows = next(own for own in problem.rows(state) if own[1].kind is Kind.DEPTH)
    out = Assembly(problem.pattern)
    out.add(rows)
    taken = problem.weights.taken_off(look.kind, some, rows)
    assert taken is not None
    out.add(taken, -1.0)
    U, h = np.zeros((problem.n_globals,) * 2), np.zeros(problem.pattern.n_units)
    Q, ratio = problem.weights.parts(look.kind)
    for k, v in enumerate(some):
        J = np.zeros((rows.r.shape[1], problem.n_globals))
        J[:, rows.columns] = rows.J[k, :, 0]
        np.add.at(J, (np.arange(len(J))[:, None], rows.point_columns[k]), rows.J_point[k, :, 0])
        W = np.eye(len(J)) - Q[v] * (1 - ratio**-2) @ Q[v].T
        U += J.T @ W @ J
        h[rows.units[k]] += (rows.J_unit[k, :, 0].T @ W @ rows.r[k, :, 0])[0]
    equations = out.equations()
    np.testing.assert_allclose(equations.U, U, rtol=1e-9, atol=1e-9 * np.abs(U).max())
    np.testing.assert_allclose(equations.unit_gradient[:, 0], h, rtol=1e-9, atol=1e-9 * np.abs(h).max())


def test_boards_off_as_a_whole_are_weighed_by_it():
    """The error of the pose beside that of an estimate that weighs them alike, over six rigs."""
    weighed, alike = [], []
    for seed in range(6):
        rng, rig = np.random.default_rng(seed), sv.arc(2, biased=True)
        result = solved(rig, draw(rig, sv.BOARD, 14, rng, OFF_AS_A_WHOLE), sv.BOARD, rng)
        w = result.problem.weights
        same = replace(result.problem, weights=replace(w, ratio_depth=np.ones(3)))
        for values, state in ((weighed, result.state), (alike, solve.minimize(same, result.state, 50, 1e-10).state)):
            xi = se3.difference(rig.cameras["C2"].T_world_color, state.T_world_color[1])
            values.append(np.sum(xi[3:] ** 2))
    assert np.mean(weighed) < 0.5 * np.mean(alike)


def test_time_of_flight_errs_along_the_ray():
    """5 mm too short on every ray are 5 mm over its length in z, whatever the depth."""
    bias = DepthBias((0.005,), 0.5, 4.0, 0.0, along_ray=True)
    np.testing.assert_allclose(bias.error_m(np.array([1.0, 2.0]), np.array([1.0, 1.25])), [0.005, 0.004])
    grows = DepthBias((0.0, 0.0, 0.001), 0.5, 4.0, 0.0, along_ray=True)
    np.testing.assert_allclose(grows.error_m(np.array([2.0]), np.array([1.25])), [0.001 * 2.5**2 / 1.25])
    across = replace(grows, along_ray=False)
    np.testing.assert_allclose(across.error_m(np.array([2.0]), np.array([1.25])), [0.004])


def with_walls(off_m):
    """C2's walls at eight distances, off by off_m(z, x) of them, x the pixel's ray."""
    rng, rig = np.random.default_rng(1), sv.arc(2, biased=True)
    walls, own = [], rig.cameras["C2"]
    for z_m in np.linspace(0.8, 3.2, 8):
        cells = wall_cells(np.full((480, 640), z_m) + rng.normal(0, 1e-3 * z_m**2, (480, 640)))
        reported = cells.depth_m - own.depth_bias.error_m(cells.depth_m)
        rays = own.intrinsics.rays(cells.pixels_px)
        walls.append(SeenWall(f"{z_m}", z_m, 0.002, replace(cells, depth_m=reported + off_m(z_m, rays))))
    seen = Walls.of(list(rig.cameras), {"C2": walls})
    T = {name: camera.T_world_color for name, camera in rig.cameras.items()}
    priors = {n: replace(p, bias=None) for n, p in priors_of(rig, rng).items()}
    return draw(rig, sv.BOARD, 14, rng), priors, T, seen


def test_the_bend_of_walls_is_found_and_estimated_in_size():
    bends = {}
    for size in (0.0, 0.004):
        signs = iter(np.tile([1.0, -1.0], 8))
        views, priors, T, walls = with_walls(lambda z, rays, s=size, g=signs: s * next(g) * z * rays[..., 0] ** 2)
        result = bundle(views, sv.BOARD, priors, T, "C1", walls=walls)
        bends[size] = result.state.walls.values[:, 3], result.problem.weights.wall_bend[1]
    assert bends[0.0][1] < 0.0005 and np.abs(bends[0.0][0]).max() < 0.0005
    assert 0.0015 < bends[0.004][1] < 0.004  # RMS of p, q and r, of which p alone is there
    signs = np.sign(bends[0.004][0])
    assert np.all(signs == signs[0] * np.tile([1, -1], 4))  # reported too far is a wall bent away
    assert 0.003 < np.abs(bends[0.004][0]).mean() < 0.005


@pytest.mark.parametrize(("common", "single"), [(0.0, 0.0), (0.02, 0.0), (0.0, 0.02)])
def test_how_far_walls_are_from_square_is_estimated(common, single):
    signs = iter(np.tile([1.0, -1.0], 8))

    def off_m(z_m, rays):
        a = common + single * next(signs)
        return z_m / (1 - a * rays[..., 0]) - z_m

    views, priors, T, walls = with_walls(off_m)
    result = bundle(views, sv.BOARD, priors, T, "C1", walls=walls)
    size, of_all = result.problem.weights.wall_tilt[1], result.state.values["wall tilt"][1]
    assert size < 0.0006 if not single else 0.009 < size < 0.02  # RMS of a and b, of which a alone is there
    sd = np.sqrt(np.diag(result.covariance)[result.index("wall tilt", "C2")])
    assert np.all(np.abs(of_all - [common, 0.0]) < 3 * sd) and np.all(sd < (0.003 if not single else 0.01))


def test_simulated_sensors_say_how_they_measure():
    for sensor, kind in (("tof", "time_of_flight"), ("stereo", "stereo"), ("structured-light", None)):
        params = SimulationParams(cameras=2, sensor=sensor)
        infos = camera_infos(params, true_rig_of(params))
        assert [info.kind for info in infos.values()] == [kind, kind]
        assert [info.depth for info in infos.values()] == [None, None]
