"""Rotations and rigid motions: laws that hold for every input, half turns included."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rgbd_calib.geometry import align, se3, so3

vectors = arrays(float, 3, elements=st.floats(-10, 10))
# up to a half turn: beyond it the same rotation has a shorter vector
rotvecs = st.builds(
    lambda axis, angle: angle * axis / np.linalg.norm(axis),
    vectors.filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.floats(0, np.pi - 1e-6),
)
poses = st.builds(lambda r, t: se3.make(so3.exp(r), t), rotvecs, vectors)
xis = st.builds(lambda r, t: np.concatenate([r, t]), rotvecs, vectors)

# translations are up to 10, of machine precision 2e-16, through a few products: 1e-13 is 50 times what is due; near a
# half turn scipy takes the vector from the quaternion, whose error of 1e-16 is not magnified
TIGHT = 1e-12


@given(rotvecs)
def test_log_inverts_exp(r):
    assert np.allclose(so3.log(so3.exp(r)), r, atol=1e-9)


@given(vectors.filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_log_of_a_half_turn_is_the_axis_either_way(axis):
    axis = axis / np.linalg.norm(axis)
    R = 2 * np.outer(axis, axis) - np.eye(3)
    r = so3.log(R)
    assert np.linalg.norm(r) == pytest.approx(np.pi, abs=1e-7)
    assert abs(r @ axis) == pytest.approx(np.pi, abs=1e-7)
    assert np.allclose(so3.exp(r), R, atol=1e-7)
    assert so3.angle_rad(R) == pytest.approx(np.pi, abs=1e-7)


@given(rotvecs)
def test_exp_is_a_rotation_with_the_axis_fixed(r):
    R = so3.exp(r)
    assert np.allclose(R.T @ R, np.eye(3), atol=TIGHT) and np.linalg.det(R) > 0
    assert np.allclose(R @ r, r, atol=TIGHT)
    assert so3.angle_rad(R) == pytest.approx(np.linalg.norm(r), abs=1e-9)


@given(vectors, vectors)
def test_hat_is_the_cross_product(v, p):
    assert np.allclose(so3.hat(v) @ p, np.cross(v, p), atol=1e-13 * 200)
    assert np.array_equal(so3.hat(v), -so3.hat(v).T)


@given(rotvecs)
def test_quaternion_has_w_first_and_positive(r):
    q = so3.quaternion_wxyz(so3.exp(r))
    angle = np.linalg.norm(r)
    assert q[0] >= 0 and np.linalg.norm(q) == pytest.approx(1)
    assert q[0] == pytest.approx(np.cos(angle / 2), abs=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_mean_of_179_and_minus_179_degrees_is_a_half_turn(axis):
    R = so3.exp(np.radians([179.0, -179.0])[:, None] * axis)
    assert so3.angle_rad(so3.mean(R)) == pytest.approx(np.pi, abs=1e-9)


def test_weighted_mean_of_rotations_about_one_axis():
    R = so3.exp(np.array([[0, 0, 0.0], [0, 0, 0.2]]))
    assert np.allclose(so3.mean(R, np.array([1.0, 1.0])), so3.exp([0, 0, 0.1]), atol=TIGHT)
    assert np.allclose(so3.mean(R, np.array([1.0, 0.0])), np.eye(3), atol=TIGHT)


@given(poses, vectors)
def test_inverse_undoes_a_motion(T, p):
    assert np.allclose(se3.inverse(T) @ T, np.eye(4), atol=TIGHT)
    assert np.allclose(se3.transform(se3.inverse(T), se3.transform(T, p[None]))[0], p, atol=TIGHT)


@given(poses, poses, vectors)
def test_inner_names_cancel(T_a_b, T_b_c, p_c):
    once = se3.transform(T_a_b @ T_b_c, p_c[None])
    assert np.allclose(once, se3.transform(T_a_b, se3.transform(T_b_c, p_c[None])), atol=TIGHT * 10)


@given(poses, xis)
def test_difference_inverts_retract(T, xi):
    moved = se3.retract(T, xi)
    # the translation of T (10) is rotated and taken off again; a rotation's error of 1e-9 near a half turn times 10
    assert np.allclose(se3.difference(moved, T), xi, atol=1e-8)
    assert np.allclose(se3.retract(T, np.zeros(6)), T)


@given(poses, vectors, vectors, vectors)
def test_a_small_perturbation_moves_points_by_phi_cross_p_plus_rho(T, phi, rho, p):
    scale = 1e-7
    moved = se3.transform(se3.retract(T, scale * np.concatenate([phi, rho])), p[None])[0]
    p_world = se3.transform(T, p[None])[0]
    # second order: |phi|^2 |p| scale^2 / 2 < (17 scale)^2 (17 + 17) / 2, and rounding of 34
    assert np.allclose(moved - p_world, scale * (np.cross(phi, p_world) + rho), atol=5e3 * scale**2 + 1e-13)


@given(poses, poses, vectors, vectors)
def test_adjoint_carries_a_perturbation_into_the_outer_frame(T_a_b, T_b_c, phi, rho):
    xi_b = 1e-6 * np.concatenate([phi, rho])
    inside = T_a_b @ se3.retract(T_b_c, xi_b)
    outside = se3.retract(T_a_b @ T_b_c, se3.adjoint(T_a_b) @ xi_b)
    # second order in the angle of 1.7e-5, times translations of 34 at most, and rounding
    assert np.allclose(inside, outside, atol=(1.7e-5) ** 2 * 70)


def test_arrays_of_poses_work_as_each_pose_does():
    rng = np.random.default_rng(0)
    T = se3.make(so3.exp(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)))
    p = rng.normal(size=(5, 3))
    assert np.allclose(se3.inverse(T)[2], se3.inverse(T[2]))
    assert np.allclose(se3.transform(T, p)[3], se3.transform(T[3], p[3:4])[0])
    xi = rng.normal(size=(5, 6))
    assert np.allclose(se3.retract(T, xi)[1], se3.retract(T[1], xi[1]))
    assert np.allclose(se3.difference(se3.retract(T, xi), T)[4], se3.difference(se3.retract(T[4], xi[4]), T[4]))


@given(poses, st.integers(3, 20), st.integers(0, 1000))
def test_rigid_alignment_recovers_the_motion(T, n, seed):
    rng = np.random.default_rng(seed)
    p_b = rng.normal(size=(n, 3))
    found = align.rigid(se3.transform(T, p_b), p_b, rng.uniform(0.5, 2, n))
    # three points spread by about 1 m; badly spread ones magnify rounding, seldom more than a thousand times
    assert np.allclose(found, T, atol=1e-9)


def test_rigid_alignment_of_coplanar_points_is_no_reflection():
    rng = np.random.default_rng(3)
    p_b = np.column_stack([rng.normal(size=(10, 2)), np.zeros(10)])
    T = se3.make(so3.exp([0.3, -2.0, 0.5]), np.array([1.0, 2.0, 3.0]))
    found = align.rigid(se3.transform(T, p_b), p_b)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    assert np.allclose(found, T, atol=TIGHT)


def test_rigid_alignment_weighs_its_points():
    p_b = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    p_a = p_b.copy()
    p_a[3] += 1.0
    found = align.rigid(p_a, p_b, np.array([1.0, 1.0, 1.0, 0.0]))
    assert np.allclose(found, np.eye(4), atol=TIGHT)


def test_the_motion_between_two_poses_has_a_length_and_an_angle():
    T = se3.make(so3.exp([0.1, 0.2, -0.3]), np.array([1.0, 2.0, 3.0]))
    step = se3.make(so3.exp([0.0, 0.0, 0.02]), np.array([0.003, 0.0, 0.004]))
    assert se3.moved(T, T @ step) == pytest.approx((0.005, 0.02))
    assert se3.moved(T, T) == pytest.approx((0.0, 0.0), abs=1e-12)
