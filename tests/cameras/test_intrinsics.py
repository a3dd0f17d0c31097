"""Zhang's method: truth within its standard deviations, views that do not fit, views that cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import BOARD, HEIGHT, WIDTH, lens_of

from rgbd_calib.cameras.intrinsics import IntrinsicsParams, calibrate_intrinsics
from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, se3, so3
from rgbd_calib.types import BoardView

LENS = lens_of(1)
SIGMA_PX = 0.1


def close_views(
    rng: np.random.Generator,
    n: int,
    max_tilt_rad: float = 0.6,
    z_m: tuple[float, float] = (0.6, 1.1),
    lens: camera.Intrinsics = LENS,
    spread: float = 1.0,
):
    """Views of a board whose middle is anywhere in the image; `spread` is larger where the lens is wider."""
    views, middle = [], BOARD.corners_m().mean(axis=0)
    while len(views) < n:
        R = so3.exp(rng.uniform(-max_tilt_rad, max_tilt_rad, 3) * [1, 1, 0.3])
        at = np.array([*(spread * rng.uniform([-0.4, -0.3], [0.4, 0.3])), 1.0]) * rng.uniform(*z_m)
        p = se3.transform(se3.make(R, at - R @ middle), BOARD.corners_m())
        px = lens.project(p)
        if np.all((px > 5) & (px < [WIDTH - 6, HEIGHT - 6])):
            px = px + rng.normal(0, SIGMA_PX, px.shape)
            k = BOARD.n_corners
            views.append(BoardView("C2", f"{len(views):06d}", np.arange(k), px, np.full(k, np.nan), np.zeros(k, int)))
    return views


@pytest.mark.parametrize("seed", range(4))
def test_recovers_the_lens(seed):
    result = calibrate_intrinsics(close_views(np.random.default_rng(seed), 14), BOARD, (WIDTH, HEIGHT))
    sd = result.standard_deviation
    off = np.abs(result.intrinsics.vector - LENS.vector)
    # k3 is 0 in truth: where it is held there, its standard deviation is 0 too
    assert np.all(off <= 5 * sd)
    assert np.all(sd[:8] > 0)
    assert result.dropped == {}
    assert len(result.view_rms_px) == 14
    # OpenCV's RMS is of both coordinates together: 0.1 sqrt(2) px, less 5 % for 9 + 14 * 6 unknowns; 1512 values: 2 %
    assert result.rms_px == pytest.approx(SIGMA_PX * np.sqrt(2), rel=0.10)


def test_standard_deviations_are_those_of_many_recordings():
    z = []
    for seed in range(8):
        result = calibrate_intrinsics(close_views(np.random.default_rng(100 + seed), 10), BOARD, (WIDTH, HEIGHT))
        z.append(((result.intrinsics.vector - LENS.vector)[:4] / result.standard_deviation[:4]) ** 2)
    # 32 squares, of which fx and fy are nearly one number: 24 independent ones, standard deviation sqrt(2 / 24) = 0.29
    assert 0.3 < np.mean(z) < 2.2  # 2.5 of these below, 4 above


def test_a_view_that_does_not_fit_is_left_out_and_named():
    rng = np.random.default_rng(1)
    views = close_views(rng, 12)
    # the detector took another grid: one column of squares off, and one view 133 px off in places
    shifted = views[3].corners_px.reshape(BOARD.rows, BOARD.cols, 2).copy()
    shifted[:, 4:] += [25.0, 4.0]
    views[3] = replace(views[3], corners_px=shifted.reshape(-1, 2))
    views[8] = replace(views[8], corners_px=views[8].corners_px + rng.normal(0, 133, (BOARD.n_corners, 2)))
    result = calibrate_intrinsics(views, BOARD, (WIDTH, HEIGHT))
    assert set(result.dropped) == {"000003", "000008"}
    assert all("px, " in why and "allowed" in why for why in result.dropped.values())
    assert "000003" not in result.view_rms_px
    assert np.all(np.abs(result.intrinsics.vector - LENS.vector)[:8] <= 5 * result.standard_deviation[:8])


def test_turned_views_are_as_good():
    """Intrinsics do not care from which end the board was read."""
    views = close_views(np.random.default_rng(5), 8)
    turned = [replace(v, ids=v.ids[::-1].copy()) if i % 2 else v for i, v in enumerate(views)]
    a, b = (calibrate_intrinsics(v, BOARD, (WIDTH, HEIGHT)).intrinsics.vector for v in (views, turned))
    np.testing.assert_allclose(a[:4], b[:4], atol=1e-2)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_views(n):
    name = "C2" if n else "camera"
    with pytest.raises(CalibrationError, match=rf"^{name}: {n} usable view\(s\) .* 3 needed. Film the board"):
        calibrate_intrinsics(close_views(np.random.default_rng(0), n), BOARD, (WIDTH, HEIGHT))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("n", [3, 12])
def test_a_board_always_square_to_the_camera_tells_nothing(n, seed):
    """The focal length and the distance cannot be told apart."""
    views = close_views(np.random.default_rng(seed), n, 0.0, (0.7, 0.9))
    with pytest.raises(CalibrationError, match=r"^C2: .*focal length.* needed. Film the board tilted"):
        calibrate_intrinsics(views, BOARD, (WIDTH, HEIGHT))


def test_the_same_view_again_and_again_tells_nothing():
    views = close_views(np.random.default_rng(0), 1) * 12
    views = [replace(view, frame=f"{i:06d}") for i, view in enumerate(views)]
    with pytest.raises(CalibrationError, match=r"^C2: .*focal length.* needed. Film the board tilted"):
        calibrate_intrinsics(views, BOARD, (WIDTH, HEIGHT))


def test_of_many_views_those_that_tell_most():
    """A sixth of the views, chosen: surer of the lens than a sixth spread evenly, and still the truth."""
    views = close_views(np.random.default_rng(0), 120, z_m=(0.6, 1.6))
    few = IntrinsicsParams(max_views=20)
    best = calibrate_intrinsics(views, BOARD, (WIDTH, HEIGHT), few)
    assert len(best.view_rms_px) + len(best.dropped) == 20
    assert sorted([*best.view_rms_px, *best.dropped, *best.not_needed]) == [v.frame for v in views]
    spread = calibrate_intrinsics(views[::6], BOARD, (WIDTH, HEIGHT), few)
    assert spread.not_needed == ()
    # log det, what is maximised, over the four numbers that matter: less volume than one seed in many would give evenly
    assert np.prod(best.standard_deviation[:4]) < 0.5 * np.prod(spread.standard_deviation[:4])
    assert np.all(np.abs(best.intrinsics.vector - LENS.vector)[:8] <= 5 * best.standard_deviation[:8])
    assert calibrate_intrinsics(views, BOARD, (WIDTH, HEIGHT), few).not_needed == best.not_needed
