"""Red and blue against green: shifted planes and lateral chromatic aberration are measured and named."""

import cv2
import numpy as np
import pytest
from small_recording import HEIGHT, WIDTH, draw_recording

from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.color_planes import color_plane_findings, shifts_of
from rgbd_calib.pipeline.detection import detect
from rgbd_calib.views.detect import DetectParams

SHIFTS = {
    "shifted": np.array([[1.0, 0, 1.0], [0, 1, -0.5]]),  # red is 1 px to the right and 0.5 px up
    "magnified": np.array([[1.0025, 0, -0.8], [0, 1.0025, -0.6]]),  # 1 px in the corner, 400 px from the middle
}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("planes") / "in", cameras=2, frames=4)


def views_of(recording):
    return detect(recording, DetectParams()).views


def test_planes_that_lie_on_each_other_are_no_finding(drawn):
    recording = open_recording(drawn)
    views = views_of(recording)
    shifts = shifts_of(recording, recording.board, views)
    assert set(shifts) == {"C1", "C2"}
    assert all(abs(s.at_corner_px) < 0.1 and np.abs(s.shift_px).max() < 0.1 for own in shifts.values() for s in own)
    assert color_plane_findings(recording, recording.board, views) == []


@pytest.mark.parametrize("kind", SHIFTS)
def test_red_of_one_camera_beside_green_is_named(run, drawn, tmp_path, kind):
    folder = tmp_path / "in"
    folder.mkdir()
    for path in sorted(drawn.rglob("*.*")):
        target = folder / path.relative_to(drawn)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    for path in sorted((folder / "C2" / "color").iterdir()):
        image = cv2.imread(str(path))
        image[..., 2] = cv2.warpAffine(
            image[..., 2], SHIFTS[kind], (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.imwrite(str(path), image)
    recording = open_recording(folder)
    red = shifts_of(recording, recording.board, views_of(recording))["C2"][0]
    expected = {"shifted": ([1.0, -0.5], 0.0), "magnified": ([0.0, 0.0], 1.0)}[kind]
    np.testing.assert_allclose(red.shift_px, expected[0], atol=0.1)  # a corner of one plane is good to 0.1 px
    assert red.at_corner_px == pytest.approx(expected[1], abs=0.2)
    for command in (("doctor", folder), ("calibrate", folder, "-o", tmp_path / "rig.yaml")):
        out = run(*command)
        assert "C2: colour planes are apart: red is" in out.stdout + out.stderr
        assert "C1: colour planes" not in out.stdout + out.stderr
