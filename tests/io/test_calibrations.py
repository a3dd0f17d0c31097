"""Foreign calibrations read: as other programs write them, and what is exported comes back."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_exports import a_rig, exported

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io import exports
from rgbd_calib.io.calibrations import FORMATS, read_calibration
from rgbd_calib.io.exports.common import Options
from rgbd_calib.io.rig import read_intrinsics, read_rig, write_rig
from rgbd_calib.types import Rig

LENSES: dict[str, tuple[str, tuple[float, ...]]] = {
    "four": ("opencv", (0.06, -0.11, 0.0008, -0.0013)),
    "five": ("opencv", (0.06, -0.11, 0.0008, -0.0013, 0.045)),
    "rational": ("opencv", (0.4, -0.1, 0.0008, -0.0013, 0.01, 0.36, -0.08, 0.02)),
    "prism": ("opencv", (0.06, -0.11, 0.0008, -0.0013, 0.045, 0.01, 0.0, 0.0, 1e-4, 0.0, -1e-4, 0.0)),
    "fisheye": ("kannala_brandt", (0.02, -0.01, 0.003, -0.001)),
}


CARRIED = {
    "ros": tuple(LENSES),
    "opencv": tuple(LENSES),
    "json": tuple(LENSES),
    "kalibr": ("four", "fisheye"),
    "colmap": ("four", "five", "rational", "fisheye"),
    "nerfstudio": ("four", "five", "fisheye"),
    "open3d": (),
    "mrcal": ("four", "five", "rational", "prism"),
}


def rig_of(kind: str, n: int = 3) -> Rig:
    model, distortion = LENSES[kind]
    rig = a_rig(identity=True, n=n)
    cameras = {
        name: replace(c, intrinsics=replace(c.intrinsics, model=model, distortion=distortion), depth_bias=None)
        for name, c in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def same_lens(a: Intrinsics | None, b: Intrinsics) -> None:
    """The same pixels for the same rays, whatever zeros stand in the file."""
    assert a is not None and (a.width, a.height, a.model) == (b.width, b.height, b.model)
    pixels = np.stack(np.meshgrid(np.linspace(0, b.width - 1, 9), np.linspace(0, b.height - 1, 7)), -1).reshape(-1, 2)
    np.testing.assert_allclose(a.project(b.rays(pixels)), pixels, atol=1e-9)


@pytest.mark.parametrize("to", exports.FORMATS)
@pytest.mark.parametrize("kind", LENSES)
def test_what_is_exported_comes_back(tmp_path, to, kind):
    rig = rig_of(kind)
    suffixes = exports.FORMATS[to].suffixes or ("",)
    if kind not in CARRIED[to]:
        with pytest.raises(ConfigError, match="does not have"):
            exports.export(rig, to, Options(max_px=0.0))
        return
    for suffix in suffixes:
        found = read_calibration(exported(rig, to, tmp_path / f"out{suffix}"))
        order = {"C1": "C1", "C0": "C0", "C2": "C2"}
        assert set(found.cameras) == set(order)
        for name, camera in rig.cameras.items():
            own = found.cameras[name]
            same_lens(own.intrinsics, camera.intrinsics)
            np.testing.assert_allclose(own.T_world_color, camera.T_world_color, atol=1e-9)


def test_open3d_keeps_the_order(tmp_path):
    rig = rig_of("five")
    path = exported(rig, "open3d", tmp_path / "out.json", undistorted=True)
    found = read_calibration(path)
    for own, camera in zip(found.cameras.values(), rig.cameras.values(), strict=True):
        same_lens(own.intrinsics, camera.intrinsics.without_distortion())
        np.testing.assert_allclose(own.T_world_color, camera.T_world_color, atol=1e-9)


def test_colmap_binary_of_pycolmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rig = rig_of("rational")
    text = exported(rig, "colmap", tmp_path / "text")
    (tmp_path / "binary").mkdir()
    pycolmap.Reconstruction(str(text)).write_binary(str(tmp_path / "binary"))
    found = read_calibration(tmp_path / "binary")
    for name, camera in rig.cameras.items():
        same_lens(found.cameras[name].intrinsics, camera.intrinsics)
        np.testing.assert_allclose(found.cameras[name].T_world_color, camera.T_world_color, atol=1e-9)


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_stereo_as_its_sample_writes_it(tmp_path, suffix):
    T_2_1 = se3.make(so3.exp(np.array([0.1, -0.2, 0.05])), np.array([-0.3, 0.01, 0.02]))
    K = [np.array([[500.0 + i, 0, 320.5], [0, 501, 240.25], [0, 0, 1]]) for i in (0, 1)]
    D = [np.array([[0.1, -0.2, 0.001, 0.002, 0.03]]), np.arange(8)[None] * 1e-3]
    path = tmp_path / f"stereo{suffix}"
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ("M1", K[0]),
        ("D1", D[0]),
        ("M2", K[1]),
        ("D2", D[1]),
        ("R", T_2_1[:3, :3]),
        ("T", T_2_1[:3, 3]),
    ):
        store.write(name, value)
    store.release()
    found = read_calibration(path, (640, 480))
    assert list(found.cameras) == ["C1", "C2"] and "stereoCalibrate" in found.notes[0]
    one, two = found.cameras["C1"], found.cameras["C2"]
    same_lens(one.intrinsics, Intrinsics(640, 480, 500.0, 501.0, 320.5, 240.25, tuple(D[0][0])))
    same_lens(two.intrinsics, Intrinsics(640, 480, 501.0, 501.0, 320.5, 240.25, tuple(D[1][0])))
    np.testing.assert_allclose(se3.inverse(two.T_world_color) @ one.T_world_color, T_2_1, atol=1e-12)
    with pytest.raises(ConfigError, match="the size of the images is not in it"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("keys", "name"),
    [
        (("camera_matrix", "distortion_coefficients"), "calib"),
        (("cameraMatrix", "distCoeffs"), "calib"),
        (("mtx", "dist"), "calib"),
        (("K", "D"), "calib"),
        (("Camera_Matrix", "Distortion_Coefficients"), "calib"),
        (("camera_matrix_left", "dist_coeffs_left"), "calib"),
    ],
)
def test_opencv_under_the_names_that_people_give(tmp_path, keys, name):
    store = cv2.FileStorage(str(tmp_path / "calib.yaml"), cv2.FILE_STORAGE_WRITE)
    store.write("image_width", 640)
    store.write("image_height", 480)
    store.write(keys[0], np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
    store.write(keys[1], np.array([[0.1], [-0.2], [0.001], [0.002], [0.03]]))
    store.release()
    found = read_calibration(tmp_path / "calib.yaml")
    assert found.cameras[name].intrinsics == Intrinsics(
        640, 480, 500.0, 501.0, 320.0, 240.0, (0.1, -0.2, 0.001, 0.002, 0.03)
    )


ROS = """\
image_width: 640
image_height: 480
camera_name: {name}
camera_matrix: {{rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {n}, data: {data}}}
"""


@pytest.mark.parametrize(
    ("model", "data", "lens"),
    [
        ("plumb_bob", [0.1, -0.2, 0.001, 0.002, 0.03], "opencv"),
        ("rational_polynomial", [0.1, -0.2, 0.001, 0.002, 0.03, 0.4, -0.1, 0.02], "opencv"),
        ("equidistant", [0.1, -0.2, 0.03, 0.002], "kannala_brandt"),
        ("fisheye", [0.1, -0.2, 0.03, 0.002, 0.0], "kannala_brandt"),
    ],
)
def test_ros_camera_info(tmp_path, model, data, lens):
    path = tmp_path / "left.yaml"
    path.write_text(ROS.format(name="cam", model=model, n=len(data), data=data))
    own = read_calibration(path).cameras["cam"].intrinsics
    assert own.model == lens and own.distortion == tuple(data[: 4 if lens == "kannala_brandt" else 8])


@pytest.mark.parametrize(
    ("model", "data", "needle"),
    [
        ("plumb_bob", [0.1] * 8, "8 coefficients seen, plumb_bob has 5"),
        ("thin_lens", [0.1] * 5, "distortion_model 'thin_lens' seen; plumb_bob"),
        ("rational_polynomial", [0.1] * 7, "7 numbers, 4 or 5 or 8"),
        ("plumb_bob", ["a"] * 5, "numbers needed"),
        ("plumb_bob", [float("nan")] * 5, "finite numbers needed"),
    ],
)
def test_a_lens_that_ros_has_and_this_program_has_not(tmp_path, model, data, needle):
    path = tmp_path / "left.yaml"
    path.write_text(ROS.format(name="cam", model=model, n=len(data), data=str(data).replace("nan", ".nan")))
    with pytest.raises(ConfigError, match=needle) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)


KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.3, 362.7, 246.4]
  distortion_model: radtan
  distortion_coeffs: [-0.27, 0.06, 0.0001, 0.0001]
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  timeshift_cam_imu: -0.0001
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [460.6, 459.3, 379.7, 255.4]
  distortion_model: equidistant
  distortion_coeffs: [-0.27, 0.06, 0.0001, 0.0001]
  T_cn_cnm1:
  - [0.99999, 0.0023, 0.0004, -0.11]
  - [-0.0023, 0.9999, 0.0141, 0.0004]
  - [-0.0003, -0.0141, 0.9999, -0.0008]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""


def test_kalibr_with_poses_of_single_precision(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    found = read_calibration(path)
    assert list(found.cameras) == ["cam0", "cam1"] and "cam0.T_cam_imu" in found.notes[0]
    T = found.cameras["cam1"].T_world_color
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(T[:3, 3], [0.11, 0, 0], atol=3e-3)
    assert found.cameras["cam1"].intrinsics.model == "kannala_brandt"
    path.write_text(KALIBR.replace("pinhole", "omni"))
    with pytest.raises(ConfigError, match="cam0: 'omni'-'radtan' seen"):
        read_calibration(path)


def test_nerfstudio_of_one_camera_that_was_carried_around(tmp_path):
    frames = [{"file_path": f"images/frame_{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    tree = {
        "w": 1920,
        "h": 1080,
        "fl_x": 1500.0,
        "fl_y": 1501.0,
        "cx": 960.0,
        "cy": 540.0,
        "k1": 0.01,
        "frames": frames,
    }
    (tmp_path / "transforms.json").write_text(json.dumps(tree | {"camera_model": "OPENCV"}))
    found = read_calibration(tmp_path / "transforms.json")
    assert list(found.cameras) == ["transforms"] and found.cameras["transforms"].T_world_color is None
    own = found.cameras["transforms"].intrinsics
    assert (own.cx, own.cy, own.distortion) == (
        959.5,
        539.5,
        (0.01, 0.0, 0.0, 0.0, 0.0),
    ) and "carried" not in found.what


CALISCOPE = """\
[cameras.1]
cam_id = 1
rotation_count = 0
size = [1280, 720]
matrix = [[900.5, 0.0, 640.0], [0.0, 901.5, 360.0], [0.0, 0.0, 1.0]]
distortions = [0.1, -0.2, 0.001, 0.002, 0.03]
translation = [0.1, 0.2, 0.3]
rotation = [0.4, -0.5, 0.6]

[cameras.2]
cam_id = 2
rotation_count = 0
size = [1280, 720]
matrix = [[900.5, 0.0, 640.0], [0.0, 901.5, 360.0], [0.0, 0.0, 1.0]]
distortions = [0.1, -0.2, 0.03, 0.002]
fisheye = true
translation = [0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
"""


def test_caliscope(tmp_path):
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE)
    found = read_calibration(path)
    assert list(found.cameras) == ["cam_1", "cam_2"]
    own = found.cameras["cam_1"]
    T_cam_world = se3.make(so3.exp(np.array([0.4, -0.5, 0.6])), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(own.T_world_color, se3.inverse(T_cam_world), atol=1e-12)
    assert found.cameras["cam_2"].intrinsics.model == "kannala_brandt"
    path.write_text(CALISCOPE.replace("rotation_count = 0", "rotation_count = 1"))
    with pytest.raises(ConfigError, match="rotation_count 1 seen"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("name", "text", "needle"),
    [
        ("a.yaml", "x: 1\n", "no calibration that is known"),
        ("a.yaml", "x: [1\n", "cannot be read"),
        ("a.json", "{", "cannot be read"),
        ("a.json", "[1, 2]", "no calibration that is known"),
        ("a.xml", "<a><b></a>", "cannot be read"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "plain XML is needed"),
        ("a.toml", "a = ", "cannot be read"),
        ("a.bin", "\0\1", "no calibration that is known"),
        ("cameras.txt", "1 OPENCV 640 480\n", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS needed"),
        ("cameras.txt", "1 FOV 640 480 1 1 1 1 1\n", "model 'FOV' seen"),
        ("cameras.txt", "1 OPENCV 640 480 1 1 1 1 1\n", "5 numbers seen, 8 needed"),
        ("cameras.bin", "\1\0\0\0\0\0\0\0\1\0", "ends early"),
        ("c.json", '{"CalibrationInformation": {}}', "give it|Give it"),
    ],
)
def test_what_is_no_calibration_says_so(tmp_path, name, text, needle):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=needle):
        read_calibration(tmp_path / name)


def test_command_writes_a_rig(run, tmp_path):
    rig = rig_of("five")
    path = exported(rig, "kalibr", tmp_path / "chain.yaml", undistorted=True)
    out = run("import-calibration", path, "-o", tmp_path / "rig.yaml", "--rename", "C2=right")
    assert out.status == 0, out.stderr
    assert "a rig of 3 cameras" in out.stderr and "C0: 640x480 px, opencv 4, pose (from Kalibr camchain" in out.stderr
    back = read_rig(tmp_path / "rig.yaml")
    assert back.reference == "C1" and set(back.cameras) == {"C0", "C1", "right"}
    assert run("import-calibration", path, "-o", tmp_path / "rig.yaml").status == 2
    wrong = run("import-calibration", path, "-o", tmp_path / "b.yaml", "--rename", "C7=x")
    assert wrong.status == 2 and "--rename C7: no such camera" in wrong.stderr and not (tmp_path / "b.yaml").exists()
    assert run("report", tmp_path / "rig.yaml", "-o", tmp_path / "report").status == 0


def test_command_joins_files_of_one_camera_each(run, tmp_path):
    for name in ("left", "right"):
        text = ROS.format(name="same", model="rational_polynomial", n=8, data=[0.1] * 8)
        (tmp_path / f"{name}.yaml").write_text(text)
    files = [f"{c}={tmp_path / f'{c}.yaml'}" for c in ("left", "right")]
    out = run("import-calibration", *files, "-o", tmp_path / "intrinsics.yaml")
    assert out.status == 0 and "intrinsics of 2 cameras" in out.stderr
    assert read_intrinsics(tmp_path / "intrinsics.yaml")["right"].distortion == (0.1,) * 8
    both = run("import-calibration", tmp_path / "left.yaml", tmp_path / "right.yaml", "-o", tmp_path / "b.yaml")
    assert both.status == 2 and "camera same is in ROS camera_info" in both.stderr


def test_units_of_translations(run, tmp_path):
    path = tmp_path / "calibration.toml"
    path.write_text(CALISCOPE.replace("[cameras.", "[cam_").replace("[0.1, 0.2, 0.3]", "[100.0, 200.0, 300.0]"))
    assert run("import-calibration", path, "-o", tmp_path / "rig.yaml", "--unit", "mm").status == 0
    T = read_rig(tmp_path / "rig.yaml").cameras["cam_1"].T_world_color
    np.testing.assert_allclose(np.linalg.norm(T[:3, 3]), np.linalg.norm([0.1, 0.2, 0.3]), rtol=1e-12)


def test_the_rig_file_itself(tmp_path):
    rig = rig_of("rational")
    write_rig(tmp_path / "rig.yaml", rig)
    found = read_calibration(tmp_path / "rig.yaml")
    assert found.what == "rig" and found.cameras["C0"].intrinsics == rig.cameras["C0"].intrinsics


def test_every_format_has_a_module_that_says_where_its_conventions_come_from():
    import importlib

    for name in FORMATS:
        module = importlib.import_module(f"rgbd_calib.io.calibrations.{name}_")
        assert module.__doc__ and callable(module.read) and callable(module.recognises)


def test_a_mistyped_key_makes_no_lens_without_distortion(run, tmp_path):
    text = (
        "camera_name: A\nimage_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
    )
    (tmp_path / "info.yaml").write_text(text + "distorsion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n")
    refused = run("import-calibration", tmp_path / "info.yaml", "-o", tmp_path / "out.yaml")
    assert refused.status == 2 and "distortion_coefficients expected" in refused.stderr
    assert "'distorsion_coefficients' found" in refused.stderr
