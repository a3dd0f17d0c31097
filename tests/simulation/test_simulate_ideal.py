"""What a simulation made before it knew of prints, depth fields and walls, it makes still where nothing of that is asked for."""

from __future__ import annotations

import numpy as np

from rgbd_calib.cli.options import progress
from rgbd_calib.io.recording import open_recording
from rgbd_calib.quality import Quality
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.session import draw_scene, film


def test_ideal_sessions_are_what_they_were():
    # figures of release 0.3, to the rounding of other machines' libraries
    for realism in (None, IDEAL, Realism().without("print", "depth_field", "registration", "walls", "images")):
        session = film(draw_scene(2, "arc", 3, 1, np.random.default_rng(7), realism=realism), np.random.default_rng(8))
        view = session.views[0]
        np.testing.assert_allclose(view.corners_px[0], [434.49857558417784, 210.12871458570623], atol=1e-9)
        np.testing.assert_allclose(view.depth_m[0], 1.1566160822877154, atol=1e-12)
        assert session.close is not None and session.walls is not None
        np.testing.assert_allclose(session.close[0].corners_px[-1], [458.7368753830742, 429.81420362362877], atol=1e-9)
        np.testing.assert_allclose(session.walls["C2"][3], [1.4966926160998157, 1.5, 0.000675], atol=1e-12)
        assert session.wall_cells is None
        assert session.truth.quality == Quality()


def test_ideal_images_are_what_they_were(tmp_path):
    simulate(
        tmp_path,
        SimulationParams(cameras=2, frames=1, intrinsic_views=0, distances_m=(1.5,), width=160, height=120, seed=5),
        1,
        progress,
    )
    assert "realism" not in (tmp_path / "truth.yaml").read_text()
    for name, frame, grey, spread, depth_m, measured in (
        ("extrinsic", "000000", 87.40315972222223, 37.754919157266265, 4.139437447270097, 16594),
        ("depth_bias", "201000", 175.42534722222223, 9.331758603255697, 1.50429109375, 19200),
    ):
        recording = open_recording(tmp_path / name)
        color, depth = recording.color("C1", frame), recording.depth_m("C1", frame)
        # another processor's rounding decides otherwise whether an edge crosses a pixel, and every later pixel then
        # draws other light samples: over draws, mean and spread have standard deviations of 0.03 and 0.025
        np.testing.assert_allclose([color.mean(), color.std()], [grey, spread], atol=0.12)
        np.testing.assert_allclose(np.nanmean(depth), depth_m, atol=1e-4)
        assert abs(int(np.isfinite(depth).sum()) - measured) < 5
