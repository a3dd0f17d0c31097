"""The refinement as a whole: honest covariances and sigmas, the printed formulas, robustness, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from refinement_cases import make

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.rig.biobjective import RefinementParams, refine


def error(result, truth):
    """Left perturbations (6 N,) from the truth to the result, in the order of the cameras."""
    return np.concatenate([se3.difference(result.T_world_color[c], truth[c]) for c in result.cameras])


def nees(result, truth):
    """Squared error in the metric of the reported covariance, per degree of freedom."""
    xi, C = error(result, truth)[6:], result.joint_covariance[6:, 6:]
    return xi @ np.linalg.solve(C, xi) / len(xi)


@pytest.mark.parametrize(
    ("cameras", "points", "visible", "known"),
    [(2, (60, 60), 1.0, True), (2, (60, 60), 1.0, False), (4, (40, 40), 0.7, True), (4, (40, 40), 0.7, False)],
)
def test_covariance_and_sigmas_are_honest(cameras, points, visible, known):
    rng = np.random.default_rng([cameras, known])
    n, sigmas = 60, (1.0, 0.018)
    given = {"sigma_2d_px": sigmas[0], "sigma_3d_m": sigmas[1]} if known else {}
    values, pulls = [], []
    for _ in range(n):
        data, K, start, truth = make(rng, cameras, points, sigmas, visible)
        result = refine(data, K, start, "C1", RefinementParams(**given))
        values.append(nees(result, truth))
        if not known:
            pulls.append(
                [
                    (result.sigma_2d_px - sigmas[0]) / result.sigma_2d_se_px,
                    (result.sigma_3d_m - sigmas[1]) / result.sigma_3d_se_m,
                ]
            )
    dof = 6 * (cameras - 1)
    # a chi-square over its degrees of freedom has the variance 2 / dof; 4.5 standard errors: 1 failure in 100,000
    assert abs(np.mean(values) - 1) < 4.5 * np.sqrt(2 / dof / n)
    if not known:
        assert np.all(np.abs(np.mean(pulls, axis=0)) < 4.5 / np.sqrt(n) + 0.1)  # a root's bias: sigma / (4 redundancy)
        assert np.all(np.abs(np.std(pulls, axis=0) - 1) < 4.5 / np.sqrt(2 * n))


def test_printed_formulas_divide_by_points():
    # METHOD: two cameras, 100 + 100 points, true sigmas 1 px and 18 mm: 0.69 px and 31 mm
    found = []
    rng = np.random.default_rng(5)
    for _ in range(10):
        data, K, start, _ = make(rng, 2, (100, 100))
        result = refine(data, K, start, "C1", RefinementParams(noise_estimator="paper"))
        found.append([result.sigma_2d_px, result.sigma_3d_m])
    # standard error of one sigma_2D: 0.69 / sqrt(2 97), of ten 0.016; of sigma_3D 31 / sqrt(2 297) / sqrt(10) = 0.4 mm
    assert np.all(np.abs(np.mean(found, axis=0) - [0.69, 0.031]) < [0.07, 0.0018])


def test_pairs_and_latent_are_the_same_for_two_cameras():
    data, K, start, _ = make(np.random.default_rng(6), 2)
    known = {"sigma_2d_px": 1.0, "sigma_3d_m": 0.018}
    a, b = (refine(data, K, start, "C1", RefinementParams(pairs=p, **known)) for p in ("latent", "paper"))
    np.testing.assert_allclose(a.T_world_color["C2"], b.T_world_color["C2"], atol=1e-9)
    np.testing.assert_allclose(a.joint_covariance, b.joint_covariance, rtol=1e-6, atol=1e-15)


def test_covariance_of_pairs_is_honest_too():
    # the estimate from pairs is not the likelihood's for four cameras; its covariance is the sandwich's
    rng = np.random.default_rng(7)
    params = RefinementParams(pairs="paper", sigma_2d_px=1.0, sigma_3d_m=0.018)
    values = []
    for _ in range(60):
        data, K, start, truth = make(rng, 4, (40, 40))
        values.append(nees(refine(data, K, start, "C1", params), truth))
    assert abs(np.mean(values) - 1) < 4.5 * np.sqrt(2 / 18 / 60)


@pytest.mark.parametrize("method", ["ba", "icp", "baicp+", "biobjective"])
def test_exact_data_give_exact_poses(method):
    data, K, start, truth = make(np.random.default_rng(8), 3, (40, 40), (0.0, 0.0), 0.8, lens=True)
    result = refine(data, K, truth if method == "ba" else start, "C1", RefinementParams(method=method))
    np.testing.assert_allclose(error(result, truth), 0, atol=1e-7)  # cost to 1e-10: its root
    np.testing.assert_allclose(np.nan_to_num(result.residuals_2d_px), 0, atol=1e-4)
    np.testing.assert_allclose(np.nan_to_num(result.residuals_3d_m), 0, atol=1e-7)


def test_ba_keeps_the_scale_of_the_start():
    data, K, start, _ = make(np.random.default_rng(9), 3)
    result = refine(data, K, start, "C1", RefinementParams(method="ba"))
    size = [np.sum([T[:3, 3] @ T[:3, 3] for T in poses.values()]) for poses in (start, result.T_world_color)]
    assert size[1] == pytest.approx(size[0], rel=1e-12)
    gauge = np.concatenate([np.r_[0, 0, 0, T[:3, 3]] for T in result.T_world_color.values()])
    C = result.joint_covariance
    assert gauge @ C @ gauge < 1e-9 * np.trace(C) * (gauge @ gauge)


def test_weighting_by_the_rounds_is_in_the_history():
    data, K, start, _ = make(np.random.default_rng(10), 2)
    result = refine(data, K, start, "C1")
    assert result.status == "converged"
    assert result.history[-1].w == pytest.approx(result.w, rel=1e-3)
    assert result.w == pytest.approx(2 * result.sigma_3d_m**2 / result.sigma_2d_px**2)
    assert len(result.history) > 1
    # redundancies: 2 x 2 x 60 - 3 x 60 + 2 x 3 x 60 - 3 x 60 residuals beside 6 unknowns
    assert result.redundancy_2d + result.redundancy_3d == pytest.approx(60 + 180 - 6)
    assert result.variance_factor_2d == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_loss_survives_gross_errors(loss):
    rng = np.random.default_rng(11)
    data, K, start, truth = make(rng, 4, (100, 100))
    bad_2d, bad_3d = rng.random(len(data.pixels_px)) < 0.04, rng.random(len(data.xyz_m)) < 0.04
    data.pixels_px[bad_2d] += rng.normal(0, 60, (bad_2d.sum(), 2))
    data.xyz_m[bad_3d] += rng.normal(0, 0.5, (bad_3d.sum(), 3))
    result = refine(data, K, start, "C1", RefinementParams(loss=loss))
    assert result.status == "converged"
    sd = np.sqrt(np.diag(result.joint_covariance)[6:])
    # 18 standard normals stay within 4 sigmas; gross errors that a bounded influence lets in may double that
    assert np.all(np.abs(error(result, truth)[6:]) < 8 * sd)
    assert 0.8 < result.sigma_2d_px < 1.5
    assert 0.8 < result.sigma_3d_m / 0.018 < 1.5
    assert np.median(result.weights_2d[bad_2d]) < 0.3 < 0.9 < np.median(result.weights_2d[~bad_2d])


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_loss_is_honest_without_gross_errors(loss):
    rng = np.random.default_rng(12)
    values, sigmas = [], []
    for _ in range(20):
        data, K, start, truth = make(rng, 3, (50, 50))
        result = refine(data, K, start, "C1", RefinementParams(loss=loss))
        values.append(nees(result, truth))
        sigmas.append([result.sigma_2d_px, result.sigma_3d_m / 0.018])
    assert abs(np.mean(values) - 1) < 4.5 * np.sqrt(2 / 12 / 20) + 0.1  # asymptotic constants, 50 points
    np.testing.assert_allclose(np.mean(sigmas, axis=0), 1, atol=0.05)  # 20 runs of 5 and 3 %: 0.012


def test_each_camera_its_own_sigma():
    rng = np.random.default_rng(13)
    data, K, start, _ = make(rng, 4, (150, 150), (0.0, 0.0))
    px, m = np.array([0.5, 1.0, 1.5, 1.0]), np.array([0.01, 0.02, 0.01, 0.03])
    data.pixels_px[:] += rng.normal(0, 1, data.pixels_px.shape) * px[data.pixel_camera, None]
    data.xyz_m[:] += rng.normal(0, 1, data.xyz_m.shape) * m[data.xyz_camera, None]
    result = refine(data, K, start, "C1", RefinementParams(per_camera_sigmas=True))
    # about 150 x 5 / 4 and 150 x 9 / 4 redundancies a camera: standard errors of 5 and 4 %; 4 of them, and correlated
    np.testing.assert_allclose(list(result.sigmas_2d_px.values()), px, rtol=0.25)
    np.testing.assert_allclose(list(result.sigmas_3d_m.values()), m, rtol=0.2)


def test_a_covariance_for_each_point_weighs_it():
    rng = np.random.default_rng(14)
    data, K, start, truth = make(rng, 2, (20, 80), (1.0, 0.0))
    scale = np.where(rng.random(len(data.xyz_m)) < 0.5, 0.003, 0.06)
    spoiled = replace(data, xyz_m=data.xyz_m + rng.normal(0, 1, data.xyz_m.shape) * scale[:, None])
    told = replace(spoiled, xyz_covariance=scale[:, None, None] ** 2 * np.eye(3))
    params = RefinementParams(method="icp")
    blind, sighted = (refine(d, K, start, "C1", params) for d in (spoiled, told))
    assert sighted.sigma_3d_m == pytest.approx(1, abs=0.2)  # the common factor; 234 redundancies, 4.3 standard errors
    assert np.linalg.norm(error(sighted, truth)) < np.linalg.norm(error(blind, truth))


def test_reference_may_be_any_camera_anywhere():
    data, K, start, _ = make(np.random.default_rng(15), 3)
    world = se3.retract(np.eye(4), np.array([0.3, -2.0, 0.5, 4.0, -1.0, 2.0]))
    moved = {c: world @ T for c, T in start.items()}
    a = refine(data, K, start, "C1")
    b = refine(data, K, moved | {"C3": world @ a.T_world_color["C3"]}, "C3")
    for camera in ("C1", "C2"):
        np.testing.assert_allclose(b.T_world_color[camera], world @ a.T_world_color[camera], atol=2e-6)
    assert np.all(b.covariance["C3"] == 0)
    assert np.all(np.linalg.eigvalsh(b.covariance["C1"]) > 0)


def test_rows_without_a_partner_are_counted():
    data, K, start, _ = make(np.random.default_rng(16), 3, visible=0.5)
    result = refine(data, K, start, "C1")
    left_out = np.isnan(result.residuals_2d_px[:, 0]).sum() + np.isnan(result.residuals_3d_m[:, 0]).sum()
    assert left_out == sum(result.dropped.values()) > 0


def _only(data, rows_2d, rows_3d):
    return replace(
        data,
        pixel_camera=data.pixel_camera[rows_2d],
        pixel_point=data.pixel_point[rows_2d],
        pixels_px=data.pixels_px[rows_2d],
        xyz_camera=data.xyz_camera[rows_3d],
        xyz_point=data.xyz_point[rows_3d],
        xyz_m=data.xyz_m[rows_3d],
    )


def _line(data, noise_m=0.0):
    """3D points on a line, in C1's frame and in those of cameras that stand beside it without turning."""
    rng = np.random.default_rng(0)
    point = np.linspace(-0.5, 0.5, int(data.xyz_point.max()) + 1)
    x = np.stack([point, 0 * point, 2 + 0.3 * point], axis=1)[data.xyz_point]
    return replace(data, xyz_m=x + rng.normal(0, 1, x.shape) * noise_m)


def _poison(data, name):
    values = getattr(data, name).copy()
    values[3, 0] = np.nan
    return replace(data, **{name: values})


@pytest.mark.parametrize(
    ("method", "spoil", "cause"),
    [
        ("biobjective", lambda d: replace(d, cameras=("C1",)), "1 camera"),
        ("icp", lambda d: _only(d, slice(None), np.isin(d.xyz_point, d.xyz_point[:2])), "C1: 2 3D points"),
        ("biobjective", lambda d: _only(d, slice(0, 0), slice(None)), "no pixel feature"),
        ("biobjective", lambda d: _only(d, slice(None), d.xyz_camera == 0), "no 3D point"),
        ("icp", _line, "collinear"),
        ("icp", lambda d: _line(d, 0.01), "collinear"),
        ("biobjective", lambda d: _poison(d, "pixels_px"), "C1: 1 pixel values are not finite .*0/q3"),
        ("icp", lambda d: _poison(d, "xyz_m"), "C1: 1 3D point values are not finite"),
        ("biobjective", lambda d: replace(d, pixel_point=d.pixel_point * 0), "rows, one needed"),
        ("biobjective", lambda d: _only(d, d.pixel_point < 2, slice(None)), "sigma_2d"),
    ],
)
def test_degenerate_problems_name_the_cause(method, spoil, cause):
    data, K, start, _ = make(np.random.default_rng(17), 2)
    poses = {c: se3.make(np.eye(3), np.zeros(3)) for c in data.cameras} if spoil is _line else start
    with pytest.raises(CalibrationError, match=cause):
        refine(spoil(data), K, poses, "C1", RefinementParams(method=method))


def test_a_camera_without_a_chain_to_the_reference_is_named():
    data, K, start, _ = make(np.random.default_rng(18), 4)
    apart = data.pixel_point % 2 == (data.pixel_camera >= 2)
    apart_3d = data.xyz_point % 2 == (data.xyz_camera >= 2)
    with pytest.raises(CalibrationError, match="C3, C4: no chain of common points leads to the reference C1"):
        refine(_only(data, apart, apart_3d), K, start, "C1")


def test_missing_camera_and_bad_parameters_are_named():
    data, K, start, _ = make(np.random.default_rng(19), 2)
    with pytest.raises(CalibrationError, match="C2: no intrinsics"):
        refine(data, {"C1": K["C1"]}, start, "C1")
    with pytest.raises(CalibrationError, match="C2: no starting pose"):
        refine(data, K, {"C1": start["C1"]}, "C1")
    with pytest.raises(CalibrationError, match="reference C9"):
        refine(data, K, start, "C9")
    with pytest.raises(CalibrationError, match="two cameras see only the sum"):
        refine(data, K, start, "C1", RefinementParams(per_camera_sigmas=True))
    for wrong in ({"sigma_2d_px": -1.0}, {"baicp_c": 2.0}, {"loss": "huber", "pairs": "paper"}, {"loss_scale": 0.0}):
        with pytest.raises(ConfigError):
            RefinementParams(**wrong)
