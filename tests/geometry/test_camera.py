"""The lens model: round trips, derivatives, agreement with OpenCV, and NaN where it has no inverse."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rgbd_calib.geometry.camera import Intrinsics, fold_radius, project, project_jacobian, rays, unproject

# of the size that real depth cameras have. The worst of them, k = -0.1, -0.05, -0.02, turns at r_d = 0.85; the corner
# farthest from the centre, (340 / 560, 260 / 549), is at r_d = 0.77: every pixel has its ray
lenses = st.builds(
    lambda f, a, cx, cy, k1, k2, p1, p2, k3: Intrinsics(640, 480, f, f * a, cx, cy, (k1, k2, p1, p2, k3)),
    st.floats(560, 800),
    st.floats(0.98, 1.02),
    st.floats(300, 340),
    st.floats(220, 260),
    st.floats(-0.1, 0.15),
    st.floats(-0.05, 0.2),
    st.floats(-0.003, 0.003),
    st.floats(-0.003, 0.003),
    st.floats(-0.02, 0.05),
)
LENS = Intrinsics(640, 480, 571.2, 569.8, 318.4, 243.2, (0.06, -0.11, 0.0008, -0.0013, 0.045))


def grid(width=640, height=480, n=12):
    u, v = np.meshgrid(np.linspace(0, width - 1, n), np.linspace(0, height - 1, n))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@given(lenses, st.floats(0.3, 8))
def test_project_undoes_unproject(lens, z_m):
    pixels = grid()
    p_color = unproject(lens.vector, pixels, np.full(len(pixels), z_m))
    assert np.allclose(p_color[:, 2], z_m)
    # Newton's method ends below 1e-15 of a unit ray, times f < 816 px
    assert np.abs(project(lens.vector, p_color) - pixels).max() < 1e-9


@given(lenses)
def test_agrees_with_opencv(lens):
    p_color = rays(lens.vector, grid()) * np.linspace(0.5, 5, 144)[:, None]
    theirs = cv2.projectPoints(p_color, np.zeros(3), np.zeros(3), lens.K, np.array(lens.distortion))[0][:, 0]
    assert np.abs(project(lens.vector, p_color) - theirs).max() < 1e-9


def test_the_axis_meets_the_image_at_the_principal_point():
    assert project(LENS.vector, np.array([0.0, 0.0, 2.0])).tolist() == [318.4, 243.2]
    assert rays(LENS.vector, np.array([318.4, 243.2])).tolist() == [0.0, 0.0, 1.0]


@given(lenses)
def test_derivatives_against_the_complex_step(lens):
    p_color = rays(lens.vector, grid(n=4)) * np.linspace(0.5, 4, 16)[:, None]
    pixels, J_point, J_vector = project_jacobian(lens.vector, p_color)
    assert np.allclose(pixels, project(lens.vector, p_color), atol=1e-11)
    # the complex step has neither truncation nor cancellation: what is left is the rounding of some twenty products
    # of f / z < 1700 px/m with machine precision 2e-16
    for k in range(3):
        step = np.zeros(3, complex)
        step[k] = 1e-30j
        assert np.abs(J_point[..., k] - project(lens.vector, p_color + step).imag / 1e-30).max() < 1e-10
    for k in range(9):
        step = np.zeros(9, complex)
        step[k] = 1e-30j
        assert np.abs(J_vector[..., k] - project(lens.vector + step, p_color).imag / 1e-30).max() < 1e-10


def test_one_lens_for_each_point():
    vectors = np.stack([LENS.vector, LENS.vector + np.array([5, 5, 1, 1, 0.01, 0, 0, 0, 0])])
    p_color = np.array([[0.2, -0.1, 1.0], [0.1, 0.3, 2.0]])
    both = project(vectors, p_color)
    assert np.allclose(both[1], project(vectors[1], p_color[1]))
    each = project_jacobian(vectors, p_color)
    assert np.allclose(each[2][0], project_jacobian(vectors[0], p_color[:1])[2][0])


@pytest.mark.parametrize("k1", [-0.3, -0.15])
def test_pixels_beyond_the_turning_point_have_no_ray(k1):
    vector = Intrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, (k1, 0.0, 0.0, 0.0, 0.0)).vector
    turning = 1 / np.sqrt(-3 * k1)  # where d(r + k1 r^3) / dr = 0
    farthest_px = 300 * turning * 2 / 3
    inside = np.array([[320 + farthest_px - 1, 240.0], [320 - farthest_px + 1, 240.0]])
    outside = np.array(
        [[320 + d, 240.0] for d in (farthest_px + 1, farthest_px + 50, 3 * farthest_px, 9 * farthest_px)]
    )
    assert np.isfinite(rays(vector, inside)).all()
    assert np.isnan(rays(vector, outside)).all()
    assert np.isnan(rays(vector, 2 * np.array([320.0, 240.0]) - outside)).all()


WIDE = {
    "8 coefficients": Intrinsics(1280, 720, 605.3, 604.9, 639.2, 366.1, (0.52, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.4, 1.45)),
    "12 coefficients": Intrinsics(640, 480, 400.0, 401.0, 322.0, 238.0, (-0.28, 0.08, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003, 0.004, -0.002, 0.003, 0.001)),
    "14 coefficients": Intrinsics(640, 480, 400.0, 401.0, 322.0, 238.0, (-0.28, 0.08, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003, 0.004, -0.002, 0.003, 0.001, 0.03, -0.02)),
    "4 coefficients": Intrinsics(640, 480, 560.0, 561.0, 322.0, 238.0, (0.06, -0.11, 0.0008, -0.0013)),
    "fisheye": Intrinsics(640, 576, 380.0, 380.2, 321.0, 288.4, (-0.02, 0.01, -0.006, 0.001), "kannala_brandt"),
}  # fmt: skip


@pytest.mark.parametrize("lens", WIDE.values(), ids=WIDE)
class TestEveryLens:
    def test_every_pixel_has_its_ray(self, lens):
        pixels = grid(lens.width, lens.height, 25)
        assert np.abs(lens.project(2.0 * lens.rays(pixels)) - pixels).max() < 1e-9

    def test_opencv_puts_points_at_the_same_pixels(self, lens):
        p_color = lens.rays(grid(lens.width, lens.height)) * 1.7
        project_points = cv2.projectPoints if lens.model == "opencv" else cv2.fisheye.projectPoints
        args = [p_color[:, None], np.zeros(3), np.zeros(3), lens.K, np.array(lens.distortion)]
        theirs = project_points(*args)[0].reshape(-1, 2)
        assert np.abs(lens.project(p_color) - theirs).max() < 1e-9

    def test_derivatives_against_central_differences(self, lens):
        p_color = lens.rays(grid(lens.width, lens.height, 6)) * np.linspace(0.5, 4, 36)[:, None]
        pixels, J_point, J_vector = project_jacobian(lens.vector, p_color, lens.model)
        assert np.allclose(pixels, lens.project(p_color), atol=1e-11)
        # differences over 1e-6 are good to 1e-12 of third derivatives of some 1e4 px, and to 1e-13 px / 1e-6 of rounding
        for k in range(3):
            step = np.eye(3)[k] * 1e-6
            slope = (lens.project(p_color + step) - lens.project(p_color - step)) / 2e-6
            assert np.allclose(J_point[..., k], slope, rtol=1e-6, atol=1e-5)
        for k in range(len(lens.vector)):
            step = np.eye(len(lens.vector))[k] * 1e-6
            ahead, behind = (project(lens.vector + sign * step, p_color, lens.model) for sign in (1, -1))
            assert np.allclose(J_vector[..., k], (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-5)


def test_the_fold_of_a_lens():
    k1 = -0.3
    assert fold_radius((k1, 0.0, 0.0, 0.0, 0.0), "opencv") == pytest.approx(
        1 / np.sqrt(-3 * k1), abs=2e-3
    )  # the table's step
    assert fold_radius((0.1, 0.05, 0.0, 0.0, 0.0), "opencv") == np.inf


def test_a_lens_of_another_length_is_refused():
    with pytest.raises(ValueError, match="6 coefficients"):
        Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, (0.0,) * 6)


def test_vector_and_matrix_of_intrinsics():
    assert LENS.with_vector(LENS.vector) == LENS
    assert np.array_equal(LENS.K @ [0, 0, 1], [318.4, 243.2, 1])
    flat = Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5)
    assert np.allclose(flat.K @ [0.1, -0.2, 1], [*project(flat.vector, np.array([0.1, -0.2, 1.0])), 1])
