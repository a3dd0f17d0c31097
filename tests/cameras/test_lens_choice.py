"""Which kind of lens: the true one where the views tell, the simplest where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_views import BOARD, HEIGHT, WIDTH, lens_of
from test_intrinsics import SIGMA_PX, close_views

from rgbd_calib.cameras.intrinsics import IntrinsicsParams, IntrinsicsResult, calibrate_intrinsics
from rgbd_calib.cameras.lens_choice import LEAST_VIEWS, LensChoice, choose
from rgbd_calib.cameras.zhang import solve
from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.types import BoardView

SIZE = WIDTH, HEIGHT
FISHEYE = Intrinsics(WIDTH, HEIGHT, 330.0, 332.0, 321.0, 238.0, (0.02, -0.012, 0.004, -0.001), "kannala_brandt")
"""106 degrees across."""
RATIONAL = Intrinsics(WIDTH, HEIGHT, 400.0, 402.0, 318.0, 242.0, (5.26, 3.58, 0.0, 0.0, 0.189, 5.59, 5.21, 1.01))
"""Like the depth camera of an Azure Kinect; a fisheye's model follows it as well."""


def views_of(lens: Intrinsics, n: int, seed: int = 0):
    return close_views(np.random.default_rng(seed), n, z_m=(0.35, 0.8), lens=lens, spread=1.6)


@pytest.mark.parametrize("lens, kind", [(lens_of(1), "brown"), (FISHEYE, "fisheye"), (RATIONAL, "fisheye")])
def test_the_simplest_kind_that_follows_the_true_lens_is_chosen(lens: Intrinsics, kind: str) -> None:
    views = views_of(lens, 24)
    result = calibrate_intrinsics(views, BOARD, SIZE)
    assert result.choice.kind == kind
    follows(result, views, lens)
    if kind != "brown":
        brown = result.choice.held_out_px["brown"]
        assert brown is None or brown > 1.05 * result.choice.held_out_px[kind]
        assert f"lens {kind}" in result.choice.sentence


def test_a_rational_lens_is_estimated_where_it_is_asked_for() -> None:
    views = views_of(RATIONAL, 24)
    result = calibrate_intrinsics(views, BOARD, SIZE, IntrinsicsParams(lens="rational"))
    assert result.intrinsics.model == "opencv" and len(result.standard_deviation) == 12
    follows(result, views, RATIONAL)


def follows(result: IntrinsicsResult, views: list[BoardView], lens: Intrinsics) -> None:
    # 24 views of 54 corners: the noise, in both coordinates, to some per cent
    assert result.rms_px == pytest.approx(SIGMA_PX * np.sqrt(2), rel=0.1)
    at = np.concatenate([view.corners_px for view in views])
    # focal lengths and centres, and with them the rays, are known to some tenths of a pixel
    off = result.intrinsics.project(lens.rays(at)) - at
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 5 * SIGMA_PX


def test_standard_deviations_of_a_fisheye_lens_are_those_of_many_recordings() -> None:
    z = []
    for seed in range(8):
        result = calibrate_intrinsics(views_of(FISHEYE, 12, 50 + seed), BOARD, SIZE, IntrinsicsParams(lens="fisheye"))
        assert result.intrinsics.model == "kannala_brandt" and result.standard_deviation.shape == (8,)
        z.append(((result.intrinsics.vector - FISHEYE.vector)[:4] / result.standard_deviation[:4]) ** 2)
    assert 0.3 < np.mean(z) < 2.2  # as in test_intrinsics


def test_few_views_keep_the_usual_lens() -> None:
    assert choose(views_of(RATIONAL, LEAST_VIEWS - 1), BOARD, SIZE)[0] == LensChoice("brown", {})


def test_a_lens_that_folds_in_its_image_is_no_lens_of_it() -> None:
    lens = Intrinsics(WIDTH, HEIGHT, 500.0, 500.0, 320.0, 240.0, (-0.6, 0.0, 0.0, 0.0, 0.0))
    fitted = solve(views_of(FISHEYE, 24), BOARD, SIZE, "fisheye")
    assert not fitted.folds
    assert type(fitted)(lens, fitted.standard_deviation, 1.0, fitted.view_rms_px).folds


def test_views_that_fit_no_lens_are_refused_by_name() -> None:
    views = views_of(lens_of(1), 4)
    with pytest.raises(CalibrationError, match="no fisheye lens fits the 4 views"):
        for view in views:
            view.corners_px[:] = np.random.default_rng(0).uniform(0, 400, view.corners_px.shape)
        solve(views, BOARD, SIZE, "fisheye")
