"""`import rgbd_calib`: the functions for Python programs, in a script without a main guard, in a thread, quietly."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from small_recording import FOCAL_PX, HEIGHT, WIDTH, camera_pose, draw_recording

import rgbd_calib as rc
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.residuals import residuals_path
from rgbd_calib.io.rig import write_intrinsics
from rgbd_calib.pipeline.workers import FEW

CAMERAS = ("C1", "C2", "C3")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A folder with a recording of more images than are looked at before worker processes start, and its lenses."""
    folder = tmp_path_factory.mktemp("api")
    draw_recording(folder / "recording", cameras=3, frames=6)
    lens = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    write_intrinsics(folder / "intrinsics.yaml", dict.fromkeys(CAMERAS, lens), {}, {}, {})
    return folder


@pytest.fixture(scope="module")
def result(drawn):
    recording = rc.open_recording(str(drawn / "recording"))
    return rc.calibrate(recording, intrinsics=str(drawn / "intrinsics.yaml"), workers=1)


def python(code, *args, **options):
    env = os.environ | {"PYTHONPATH": str(Path(rc.__file__).parents[1])}
    return subprocess.run(
        [sys.executable, *code, *map(str, args)], capture_output=True, text=True, env=env, timeout=120, **options
    )


def test_importing_loads_nothing():
    code = (
        "import sys, time; t = time.perf_counter(); import rgbd_calib; t = time.perf_counter() - t; "
        "assert not {'numpy', 'cv2', 'scipy', 'rgbd_calib.api'} & set(sys.modules); assert t < 0.1, t; "
        "assert set(dir(rgbd_calib)) == set(rgbd_calib.__all__); rgbd_calib.ConfigError"
    )
    out = python(["-c", code])
    assert out.returncode == 0, out.stderr


def test_every_stable_name_is_there_and_others_are_not():
    assert all(getattr(rc, name) is not None for name in rc.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = rc.calibrat


def test_a_calibration_from_python(result, tmp_path, drawn):
    assert result.verdict.level in ("good", "fair") and str(result.verdict) == result.verdict.headline
    assert result.expected_mm == result.rig.quality.expected_alignment.mean_mm
    assert result.report(tmp_path / "report").read_text().count("<section") > 5
    result.rig.save(tmp_path / "rig.yaml")
    assert residuals_path(tmp_path / "rig.yaml").exists()
    again = rc.load_rig(tmp_path / "rig.yaml")
    assert list(again) == list(CAMERAS) and len(again) == 3
    assert again.verdict == result.verdict and set(again.boards) == set(result.rig.boards)
    again.save(str(tmp_path / "copy.yaml"))
    assert rc.load_rig(tmp_path / "copy.yaml").verdict == result.verdict
    with pytest.raises(KeyError, match="no camera 'C9' in this rig; it has C1, C2, C3"):
        again["C9"]


def test_the_rig_is_right_and_its_cloud_projects_to_where_it_came_from(result, drawn):
    rig = result.rig
    for i, name in enumerate(CAMERAS):
        # drawn without noise; 2 mm is many times what corner finding leaves
        assert np.linalg.norm(rig[name].T_world_color[:3, 3] - camera_pose(i, 3)[:3, 3]) < 2e-3
    points, colors = rig.fuse(result.recording, "000002")
    assert points.shape == colors.shape and points.shape[1] == 3 and colors.dtype == np.uint8
    near, _ = rig.fuse(drawn / "recording", "000002", max_depth_m=3.0)  # the wall is 4 m away
    assert 0 < len(near) < len(points)
    uv = rig["C2"].project(points)
    assert uv.shape == (len(points), 2)
    inside = ((uv >= -0.5) & (uv < [WIDTH - 0.5, HEIGHT - 0.5])).all(axis=1)
    assert 0.3 < inside.mean() <= 1
    center = rig["C2"].T_world_color[:3, 3]
    behind = center - rig["C2"].T_world_color[:3, 2]
    assert np.isnan(rig["C2"].project(behind)).all()


def test_verify_from_python(result, drawn, tmp_path):
    rig = rc.load_rig(_saved(result, tmp_path))
    new = draw_recording(tmp_path / "new", cameras=3, frames=4, seed=5)
    found = rc.verify(rig, new, max_mm=5)
    assert found.holds and str(found).startswith("PASS")
    assert rc.verify(tmp_path / "rig.yaml", str(new), max_mm=5).holds


def _saved(result, folder):
    result.rig.save(folder / "rig.yaml")
    return folder / "rig.yaml"


def test_a_notebook_shows_results_and_nothing_runs_in_them(result):
    for shown in (result, result.rig, result.verdict):
        html = shown._repr_html_()
        assert html.startswith("<") and "<script" not in html
    assert "C2" in result.rig._repr_html_() and "mm" in repr(result)
    evil = rc.CalibratedRig("<b>", {"<b>": result.rig["C1"]})
    assert "<b>" not in evil._repr_html_()


SCRIPT = """
import sys, rgbd_calib as rc
recording = rc.open_recording(sys.argv[1])
result = rc.calibrate(recording, intrinsics=sys.argv[2], workers=2)
result.rig.save(sys.argv[3])
print(result.expected_mm > 0)
"""


def test_a_script_needs_no_main_guard_and_prints_nothing(drawn, tmp_path):
    images = list((drawn / "recording").glob("*/color/*.png"))
    assert len(images) > FEW  # so that processes are started
    (tmp_path / "script.py").write_text(SCRIPT)
    out = python(
        [tmp_path / "script.py"], drawn / "recording", drawn / "intrinsics.yaml", tmp_path / "rig.yaml", cwd=tmp_path
    )
    assert out.returncode == 0, out.stderr
    assert out.stdout == "True\n" and out.stderr == ""


def test_it_runs_in_a_thread(drawn, result):
    made = []

    def work():
        made.append(rc.calibrate(drawn / "recording", intrinsics=drawn / "intrinsics.yaml", workers=2))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    for name in CAMERAS:
        assert np.array_equal(made[0].rig[name].T_world_color, result.rig[name].T_world_color)


def test_messages_go_to_logging(drawn, tmp_path, caplog):
    recording = draw_recording(tmp_path / "recording", cameras=2, frames=6)
    (recording / "C1" / "color" / "notes.txt").write_text("x")
    with caplog.at_level(logging.INFO, "rgbd_calib"):
        rc.calibrate(recording, intrinsics=drawn / "intrinsics.yaml", workers=1)
    assert any("not read" in record.message for record in caplog.records)


def test_settings_are_checked(drawn):
    with pytest.raises(rc.ConfigError, match=r"Did you mean 'refinement\.sigma_2d_px'"):
        rc.calibrate(drawn / "recording", refinement__sigma_2d=0.3)
    with pytest.raises(rc.ConfigError, match="no such folder"):
        rc.open_recording(drawn / "nothing")
    assert issubclass(rc.ConfigError, rc.RgbdCalibError)
