"""`rgbd-calib detect`: the table, what it says, and when it refuses."""

import json

import numpy as np
import pytest
from small_recording import draw_recording

from rgbd_calib.io.correspondences import read_corners
from rgbd_calib.io.recording import CameraInfo, save_color, write_dataset
from rgbd_calib.types import Board


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("detect") / "recording", cameras=2, frames=2)


def test_writes_one_row_a_corner_and_says_what_was_missed(run, recording, tmp_path):
    outcome = run("detect", recording, "-o", tmp_path / "corners.csv", "--jobs", 1)
    assert outcome.status == 0 and outcome.stdout == ""
    assert "C1: board in 2 of 2 images, 108 corners, 108 of them with depth" in outcome.stderr
    views = read_corners(tmp_path / "corners.csv")
    assert [(view.camera, view.frame) for view in views] == [
        (camera, frame) for camera in ("C1", "C2") for frame in ("000000", "000001")
    ]
    assert all(len(view.ids) == 54 for view in views)


def test_does_not_overwrite_unless_asked(run, recording, tmp_path):
    output = tmp_path / "corners.csv"
    output.write_text("mine")
    outcome = run("detect", recording, "-o", output)
    assert outcome.status == 2 and "--overwrite" in outcome.stderr and output.read_text() == "mine"
    assert run("detect", recording, "-o", output, "--overwrite").status == 0
    assert output.read_text().startswith("camera,frame,feature")


def test_a_recording_without_its_board_is_the_datas_fault(run, tmp_path):
    save_color(tmp_path, "C1", "000000", np.full((48, 64, 3), 90, np.uint8))
    write_dataset(tmp_path, {"C1": CameraInfo(64, 48)}, Board(9, 6, 0.06))
    outcome = run("detect", tmp_path, "-o", tmp_path / "corners.csv")
    assert outcome.status == 1 and "found in none of 1 images" in outcome.stderr
    assert not (tmp_path / "corners.csv").exists()


def test_results_as_json(run, recording, tmp_path):
    outcome = run("detect", recording, "-o", tmp_path / "corners.csv", "--json")
    own = {"images": 2, "views": 2, "corners": 108, "corners_with_depth": 108, "not_found": []}
    assert json.loads(outcome.stdout)["cameras"] == {"C1": own, "C2": own}
