"""A carried board before free-running cameras whose depth is not registered to colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from synthetic_views import without_depth

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.simulation.session import draw_scene
from rgbd_calib.simulation.wave import WaveSession, film_wave, write_wave

LENS = Intrinsics(128, 106, 91.5, 91.5, 63.5, 52.5, (0.0,) * 5)
T_COLOR_DEPTH = se3.retract(np.eye(4), np.array([0.010, -0.008, 0.004, 0.052, -0.002, 0.001]))
STATED = T_COLOR_DEPTH @ se3.retract(np.eye(4), np.array([0.003, 0.002, -0.002, 0.003, -0.002, 0.001]))


def film(folder: Path) -> WaveSession:
    """Corners of colour, and depth images of the plane that each board is in, at the depth camera's instant."""
    rng = np.random.default_rng(5)
    scene = draw_scene(2, "arc", 0, 0, rng)
    session = film_wave(scene, WaveParams(seconds=3.0, rate_hz=10.0, offset_s=3.0), rng)
    session = replace(session, views=tuple(without_depth(v) for v in session.views))
    write_wave(session, folder)
    u, v = np.meshgrid(np.arange(LENS.width), np.arange(LENS.height))
    rays = LENS.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    for c in session.truth.cameras:
        (folder / "wave" / c / "depth").mkdir()
    for view in session.views:
        clock, T = session.clocks[view.camera], session.truth.cameras[view.camera].T_world_color
        at = np.array([session.t_s[view.camera][view.frame] + clock.depth_delay_s])
        board = se3.inverse(T @ T_COLOR_DEPTH) @ session.motion.poses(at)[0]
        back = bool(looks_at_back(board, session.board))
        n, p = board[:3, 2], board[:3, 3] + back * session.board.thickness_m * board[:3, 2]
        z = (p @ n) / (rays @ n)
        z = np.where((z > 0.3) & (z < 8), z + rng.normal(0, 0.001, z.shape) * z**2, np.nan).astype(np.float32)
        np.save(folder / "wave" / view.camera / "depth" / f"{view.frame}.npy", z.reshape(LENS.height, LENS.width))
    stated = {
        "width": LENS.width,
        "height": LENS.height,
        "intrinsics": {"model": "opencv", "width": LENS.width, "height": LENS.height, "fx": LENS.fx, "fy": LENS.fy,
                       "cx": LENS.cx, "cy": LENS.cy, "distortion": [0.0] * 5},
        "T_color_depth": STATED.tolist(),
    }  # fmt: skip
    dataset = folder / "wave" / "dataset.yaml"
    said = yaml.safe_load(dataset.read_text())
    said["depth_registered"] = False
    for own in said["cameras"].values():
        own["depth"] = stated
    dataset.write_text(yaml.safe_dump(said))
    return session


def test_rig_clocks_and_depth_cameras_of_a_carried_board(run, tmp_path):
    session, path = film(tmp_path), tmp_path / "rig.yaml"
    outcome = run("calibrate", tmp_path / "wave", "--corners", tmp_path / "wave.csv", "-o", path)
    assert outcome.status == 0 and "C1/depth" in outcome.stderr, outcome
    rig = read_rig(path)
    assert list(rig.cameras) == ["C1", "C2"]
    assert not open_recording(tmp_path / "wave").depth_registered
    for c, truth in session.clocks.items():
        own, clock = rig.cameras[c], rig.cameras[c].clock
        assert clock is not None and own.depth_camera is not None and own.depth_camera.covariance is not None
        assert abs(clock.offset_s - truth.offset_s) <= 4 * clock.offset_sd_s + 1e-12 < 0.002
        assert abs(clock.depth_delay_s - truth.depth_delay_s) <= 4 * clock.depth_delay_sd_s < 0.012
        left = se3.difference(own.depth_camera.T_color_depth, T_COLOR_DEPTH)
        assert left @ np.linalg.solve(own.depth_camera.covariance[4:, 4:], left) < 30  # chi^2 of 6: once in 25 000
    assert rig.quality.expected_alignment is not None
    assert list(rig.quality.expected_alignment.pairs) == ["C1 - C2"]
