"""The expected alignment error: against drawn rigs, and its derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.trust import uncertainty
from rgbd_calib.types import DepthBias, Rig, RigCamera

BIAS = 2
WIDTH = 6 + 9 + BIAS
SD = np.array([1e-3] * 3 + [2e-3] * 3 + [1.0, 1.0, 0.7, 0.7, 2e-3, 2e-3, 2e-4, 2e-4, 1e-3] + [2e-3, 1e-3])
"""One sigma of each parameter, of the size that a calibration from a dozen views has."""


def a_rig() -> Rig:
    lens = Intrinsics(640, 480, 575.0, 577.0, 318.0, 243.0, (0.05, -0.1, 0.001, -0.001, 0.02))
    turned = se3.make(so3.exp(np.array([0.05, -0.4, 0.02])), np.array([0.8, 0.05, 0.1]))
    bias = DepthBias((0.01, -0.012), 0.5, 4.0, 0.001)
    return Rig("A", {n: RigCamera(lens, T, np.zeros((6, 6)), bias) for n, T in (("A", np.eye(4)), ("B", turned))})


def moved(rig: Rig, name: str, step: np.ndarray) -> Rig:
    own = rig.cameras[name]
    bias = own.depth_bias
    assert bias is not None
    new = replace(
        own,
        T_world_color=se3.retract(own.T_world_color[None], step[None, :6])[0],
        intrinsics=own.intrinsics.with_vector(own.intrinsics.vector + step[6:15]),
        depth_bias=replace(bias, coefficients=tuple(np.array(bias.coefficients) + step[15:])),
    )
    return replace(rig, cameras={**rig.cameras, name: new})


def a_covariance(rng: np.random.Generator) -> np.ndarray:
    """Joint, with correlations between all parameters and the two cameras; A's pose is held."""
    sd = np.tile(SD, 2)
    A = rng.normal(size=(2 * WIDTH, 2 * WIDTH))
    S = A @ A.T
    S /= np.sqrt(np.outer(np.diag(S), np.diag(S)))
    S *= np.outer(sd, sd)
    S[:6] = S[:, :6] = 0
    return S


POINTS_M = uncertainty.volume(np.array([[-0.2, -0.3, 1.0], [0.6, 0.3, 2.4]]), 4)
BLOCKS = {"pose": np.arange(6), "intrinsics": np.arange(6, 15), "depth bias": np.arange(15, WIDTH)}
PARAMETERS = {n: {block: at + i * WIDTH for block, at in BLOCKS.items()} for i, n in enumerate("AB")}
POSES = {n: {"pose": np.arange(6) + 6 * i} for i, n in enumerate("AB")}


def expected(rig, covariance, parameters=PARAMETERS, cameras=("A", "B")):
    return uncertainty.expected_alignment(
        rig, uncertainty.JointCovariance(covariance, parameters), POINTS_M, list(cameras)
    )


def test_derivatives_are_those_of_differences():
    rig = a_rig()
    for name in rig.cameras:
        seen = uncertainty.observe(rig, name, POINTS_M)
        ok = seen.seen
        derivatives = uncertainty.place_derivatives(rig, name, seen)
        J = np.concatenate([derivatives[block] for block in BLOCKS], axis=-1)[ok]
        for k in range(WIDTH):
            step = np.zeros(WIDTH)
            step[k] = 1e-5 * max(SD[k] / 1e-3, 1)
            high, low = (uncertainty.place(moved(rig, name, s * step), name, seen.only(ok)) for s in (1, -1))
            # central differences: rounding 1e-15 / 1e-5, and the third derivative times 1e-10 / 6, of order 1e1
            np.testing.assert_allclose(J[..., k], (high - low) / (2 * step[k]), atol=1e-8, rtol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_drawn_rigs_differ_as_expected(seed):
    rng = np.random.default_rng(seed)
    rig, covariance = a_rig(), a_covariance(rng)
    found = expected(rig, covariance)
    assert found is not None
    seen = {name: uncertainty.observe(rig, name, found.points_m) for name in rig.cameras}
    draws = 1500
    steps = rng.multivariate_normal(np.zeros(2 * WIDTH), covariance, draws, method="eigh")
    distance = np.empty((draws, len(found.points_m)))
    for row, step in zip(distance, steps, strict=True):
        drawn = moved(moved(rig, "A", step[:WIDTH]), "B", step[WIDTH:])
        a, b = (uncertainty.place(drawn, n, seen[n]) for n in ("A", "B"))
        row[:] = np.linalg.norm(a - b, axis=1)
    both = np.isfinite(found.pairs["A", "B"])
    assert both.sum() > 20
    # the mean of 1500 draws is off by sd / sqrt(1500); 5 of these, and 1 % for what is not linear (1 sigma turns 1e-3 rad)
    error = 5 * distance.std(axis=0) / np.sqrt(draws) + 0.01 * distance.mean(axis=0)
    assert np.all(np.abs(distance.mean(axis=0) - found.pairs["A", "B"])[both] < error[both])


def test_an_isotropic_shift_has_the_mean_length_of_a_gaussian():
    covariance = np.zeros((12, 12))
    covariance[9:, 9:] = 1e-6 * np.eye(3)  # camera B may be 1 mm off along each axis, nothing else
    found = expected(a_rig(), covariance, POSES)
    assert found is not None
    np.testing.assert_allclose(found.mean_m, 1e-3 * 2 * np.sqrt(2 / np.pi), rtol=1e-12)


def test_errors_that_both_cameras_share_do_not_part_them():
    """One motion of the whole rig: covariance of full correlation, no distance between the places."""
    common = np.tile(np.eye(6) * 1e-3, (2, 1))
    found = expected(a_rig(), common @ common.T, POSES)
    assert found is not None
    assert found.mean_m.max() < 1e-9


def test_nothing_is_expected_where_cameras_share_no_point():
    rig = a_rig()
    away = se3.make(so3.exp(np.array([0, np.pi, 0])), np.zeros(3))
    apart = replace(rig, cameras={**rig.cameras, "B": replace(rig.cameras["B"], T_world_color=away)})
    assert expected(apart, np.zeros((34, 34))) is None
    assert expected(rig, np.zeros((34, 34)), cameras=["A"]) is None
    assert expected(rig, np.zeros((34, 34)), cameras=[]) is None  # no camera with depth is not all of them
