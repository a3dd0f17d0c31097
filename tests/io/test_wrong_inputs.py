"""Wrong inputs: one line that names the camera, the file or the key, the right exit status, and nothing written."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recording import draw_recording
from synthetic_views import BOARD, arc, lens_of, make_recording

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.correspondences import read_corners, write_corners
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.rig import write_intrinsics


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("good"), arc(4, 10.0), frames=10)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Two cameras, two frames, with a board that can be found."""
    return draw_recording(tmp_path_factory.mktemp("drawn") / "recording", 2, 2)


@pytest.fixture
def refused(run, tmp_path: Path):
    """Run a command that must fail; its message, after checks of form and of what lies in the folder."""

    def call(status: int, *args: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        out = run(*args)
        assert out.status == status, (out.status, out.stderr)
        assert out.stdout == ""
        assert sorted(tmp_path.rglob("*")) == before
        lines = [line for line in out.stderr.strip().splitlines() if not line.endswith("from the cache")]
        assert len(lines) == 1, out.stderr
        assert lines[0].startswith("Error: ")
        return lines[0]

    return call


@pytest.fixture
def spoilt(drawn, tmp_path: Path) -> Path:
    """A copy of the drawn recording, to be spoilt."""
    return Path(shutil.copytree(drawn, tmp_path / "recording"))


def edit(path: Path, change) -> None:
    data = load_yaml(path)
    change(data)
    path.write_text(dump_yaml(data))


@pytest.mark.parametrize("command", ["calibrate", "intrinsics", "depth-bias", "detect"])
def test_no_such_folder(refused, tmp_path, command):
    says = refused(2, command, tmp_path / "absent", "-o", tmp_path / "out")
    assert f"{tmp_path / 'absent'}: no such folder" in says


def test_a_camera_without_images(refused, spoilt, tmp_path):
    shutil.rmtree(spoilt / "C2" / "color")
    says = refused(2, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert "camera C2 of dataset.yaml has no images" in says


def test_a_board_of_another_size_than_stated(refused, spoilt, tmp_path):
    edit(spoilt / "dataset.yaml", lambda data: data["board"].update(cols=11, rows=8))
    says = refused(1, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert "the board (11 x 8 inner corners) was found in none of 4 images, one of " in says
    assert " in 4 of 4 that were tried. Check cols and rows" in says


@pytest.mark.parametrize(("square", "metres"), [(60, "60 mm write 0.06"), (6.0, "6 cm write 0.06")])
def test_a_square_in_another_unit(refused, spoilt, tmp_path, square, metres):
    edit(spoilt / "dataset.yaml", lambda data: data["board"].update(square=square))
    assert f"metres needed, at most 1: for {metres}" in refused(2, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")


def test_no_board_stated(refused, spoilt, tmp_path):
    edit(spoilt / "dataset.yaml", lambda data: data.pop("board"))
    says = refused(2, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert "dataset.yaml: board is missing" in says


def test_depth_of_another_size_than_colour(refused, spoilt, tmp_path):
    cv2.imwrite(str(spoilt / "C2" / "depth" / "000001.png"), np.full((240, 320), 1500, np.uint16))
    says = refused(2, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert f"{Path('C2/depth/000001.png')}: 320x240 px seen, the colour image has 640x480" in says


def test_8_bit_depth(refused, spoilt, tmp_path):
    cv2.imwrite(str(spoilt / "C1" / "depth" / "000000.png"), np.full((480, 640), 150, np.uint8))
    says = refused(2, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert "C1/depth/000000.png: 8 bits and 1 channel(s) seen, depth needs 16 bits and one" in says


@pytest.mark.parametrize("kind", ["color", "depth"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_png(refused, spoilt, tmp_path, kind, share):
    path = spoilt / "C2" / kind / "000001.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    says = refused(2, "detect", spoilt, "-o", tmp_path / "corners.csv")
    assert f"{path}: damaged or no image" in says


def test_a_rig_file_of_another_version(refused, good, tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text(good.truth.read_text().replace("version: 1", "version: 7"))
    for args in (
        ("evaluate", rig, "--truth", good.truth),
        ("calibrate", good.path, "--corners", good.corners, "--intrinsics", rig, "-o", tmp_path / "out.yaml"),
    ):
        assert f"{rig}: version: 7 seen, this program reads version 1" in refused(2, *args)


@pytest.mark.parametrize("method", ["init", "ba", "icp", "baicp+", "biobjective"])
def test_correspondences_with_one_camera(refused, good, tmp_path, method):
    path = tmp_path / "c.csv"
    path.write_text(
        "camera,frame,feature,u_px,v_px,x_m,y_m,z_m\n"
        + "".join(f"C1,0,{i},{10 * i},{7 * i},0.{i},0.1,2.{i}\n" for i in range(9))
    )
    says = refused(1, "refine", path, "--intrinsics", good.intrinsics, "--method", method, "-o", tmp_path / "rig.yaml")
    assert "1 camera (C1)" in says
    assert "two or more needed" in says


def test_two_groups_of_cameras_that_share_no_view(refused, good, tmp_path):
    half = sorted(good.boards)[:5]
    views = [v for v in good.views if (v.frame in half) == (v.camera in ("C1", "C2"))]
    write_corners(tmp_path / "corners.csv", views)
    says = refused(
        1,
        "calibrate",
        good.path,
        "--corners",
        tmp_path / "corners.csv",
        "--intrinsics",
        good.intrinsics,
        "-o",
        tmp_path / "rig.yaml",
    )
    assert "{C1, C2} | {C3, C4}" in says
    assert "Film C2 with C3 together" in says


def test_a_camera_that_sees_no_board(refused, good, tmp_path):
    write_corners(tmp_path / "corners.csv", [v for v in good.views if v.camera != "C3"])
    args = ("calibrate", good.path, "--corners", tmp_path / "corners.csv", "-o", tmp_path / "rig.yaml")
    assert "C3: the board was found in none of its" in refused(1, *args)
    assert "{C1, C2, C4} | {C3}" in refused(1, *args, "--intrinsics", good.intrinsics)


def test_one_camera_alone(refused, tmp_path):
    recording = make_recording(tmp_path / "one", replace(arc(2), cameras={"C1": arc(2).cameras["C1"]}), frames=5)
    for method in ("init", "biobjective", "bundle"):
        says = refused(
            1,
            "calibrate",
            recording.path,
            "--corners",
            recording.corners,
            "--method",
            method,
            "-o",
            tmp_path / "rig.yaml",
        )
        assert "1 camera (C1)" in says, says
        assert "two or more needed" in says


def test_intrinsics_of_another_image_size(refused, good, tmp_path):
    path = tmp_path / "intrinsics.yaml"
    lenses = {name: lens_of(i) for i, name in enumerate(good.rig.cameras)}
    lenses["C3"] = Intrinsics(1280, 960, 1100.0, 1100.0, 640.0, 480.0)
    write_intrinsics(path, lenses, {}, {}, {})
    says = refused(
        2, "calibrate", good.path, "--corners", good.corners, "--intrinsics", path, "-o", tmp_path / "r.yaml"
    )
    assert f"{path}: C3: for images of 1280x960 px, the recording has 640x480" in says


def test_an_intrinsic_recording_of_another_image_size(refused, good, tmp_path):
    other = tmp_path / "other"
    cameras = {
        name: replace(own, intrinsics=Intrinsics(320, 240, 280.0, 280.0, 160.0, 120.0))
        for name, own in good.rig.cameras.items()
    }
    small = make_recording(other, replace(good.rig, cameras=cameras), frames=4)
    args = ("calibrate", good.path, "--corners", good.corners, "-o", tmp_path / "r.yaml")
    assert f"{small.path}: C1: for images of 320x240 px" in refused(2, *args, "--intrinsics", small.path)
    assert f"{small.path}: C1: for images of 320x240 px" in refused(2, *args, "--depth-bias", small.path)


@pytest.mark.parametrize("option", ["--intrinsics", "--depth-bias"])
def test_sources_that_do_not_fit(refused, good, tmp_path, option):
    args = ("calibrate", good.path, "--corners", good.corners, "-o", tmp_path / "r.yaml", option)
    assert "absent.yaml: no such file" in refused(2, *args, tmp_path / "absent.yaml")
    assert "Is it the right file?" in refused(2, *args, good.path / "dataset.yaml")
    fewer = tmp_path / "fewer.yaml"
    bias = {"coefficients": [0.0], "min_m": 0.5, "max_m": 3.0}
    part = {"intrinsics": load_yaml(good.intrinsics)["cameras"]["C1"]["intrinsics"], "depth_bias": bias}
    fewer.write_text(dump_yaml({"format": "rgbd-calib/rig", "version": 1, "cameras": {"C1": part}}))
    says = refused(2, *args, fewer)
    assert f"{fewer}: no {option[2:].replace('-', '_')} of C2, C3, C4; seen: C1" in says


def test_settings_that_are_not_there(refused, run, good, tmp_path):
    args = ("calibrate", good.path, "--corners", good.corners, "-o", tmp_path / "rig.yaml")
    assert "reference: 'C9' seen, one of C1, C2, C3, C4 needed" in refused(2, *args, "--reference", "C9")
    config = tmp_path / "config.yaml"
    config.write_text("bundel: {}\n")
    assert "bundel: no such setting. Did you mean 'bundle'?" in refused(2, *args, "--config", config)
    assert "--sigma-2d, --sigma-3d: given with method bundle" in refused(2, *args, "--sigma-2d", "0.3")
    unknown = run(*args, "--method", "magic")
    assert unknown.status == 2
    assert "'magic' is not one of" in unknown.stderr
    assert not (tmp_path / "rig.yaml").exists()


def test_refine_with_settings_that_are_not_there(refused, good, tmp_path):
    c = tmp_path / "c.csv"
    c.write_text("camera,frame,feature,u_px,v_px,x_m,y_m,z_m\nC1,0,1,3,4,0.1,0.1,2\nC9,0,1,3,4,0.1,0.1,2\n")
    args = ("refine", c, "--intrinsics", good.intrinsics, "-o", tmp_path / "rig.yaml")
    assert "no intrinsics of C9" in refused(2, *args)
    assert "c9.csv: no such file" in refused(2, "refine", tmp_path / "c9.csv", *args[2:])
    c.write_text("camera,frame,feature,u_px,v_px,x_m,y_m,z_m\nC1,0,1,3,x,0.1,0.1,2\n")
    assert f"{c}: line 2: v_px: 'x' seen, a number needed" in refused(2, *args)


@pytest.mark.parametrize(
    ("command", "name"),
    [("calibrate", "rig.yaml"), ("calibrate", "rig.residuals.csv"), ("calibrate", "c.csv")]
    + [(c, "rig.yaml") for c in ("intrinsics", "depth-bias", "detect", "refine")],
)
def test_what_exists_is_not_replaced(refused, good, tmp_path, command, name):
    (tmp_path / name).write_text("precious")
    extra = ["--correspondences", tmp_path / "c.csv"] if name == "c.csv" else []
    extra += ["--intrinsics", good.intrinsics] if command == "refine" else []
    says = refused(2, command, good.path, *extra, "-o", tmp_path / "rig.yaml")
    assert f"{tmp_path / name}: exists already. Choose another name, or replace it with --overwrite" in says
    assert (tmp_path / name).read_text() == "precious"


def test_corners_of_another_recording_or_board(refused, good, tmp_path):
    corners = tmp_path / "corners.csv"
    args = ("calibrate", good.path, "--corners", corners, "-o", tmp_path / "rig.yaml")
    views = list(read_corners(good.corners))
    write_corners(corners, [replace(views[0], camera="C7"), *views[1:]])
    assert f"{corners}: camera C7, frame {views[0].frame} is not in" in refused(2, *args)
    write_corners(corners, [replace(views[0], ids=views[0].ids + 6), *views[1:]])
    assert f"features 0 to {BOARD.n_corners - 1}, each once" in refused(2, *args)
    corners.write_text("camera,frame\n")
    assert f"{corners}: line 1: column 'feature' is missing" in refused(2, *args)
    corners.write_text("camera,frame,feature,u_px,v_px,depth_m,depth_pixels\n")
    assert f"{corners}: no corners in it" in refused(2, *args)


def test_depth_images_that_hold_nothing(refused, spoilt, tmp_path):
    for path in (spoilt / "C2" / "depth").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((480, 640), np.uint16))
    says = refused(1, "calibrate", spoilt, "-o", tmp_path / "rig.yaml")
    assert says.startswith("Error: C2: depth on the board expected, no measurement found in its ")
