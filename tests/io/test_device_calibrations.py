"""Calibrations that makers of cameras, and programs for one make, write."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations import read_calibration

MRCAL = """\
# generated on 2024 with mrcal-calibrate-cameras
{{
    'lensmodel':  '{model}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1761.181055, 1761.250444, 1965.706996, 1087.518797, {k}],

    'valid_intrinsics_region': [
    [ 170, 100 ],
    [ 200, 300 ],
    ],

    # extrinsics are rt_fromref
    'extrinsics': [ 2e-2, -3e-2, 1e-2, 0.5, -0.25, 0.125],

    'imagersize': [ 4000, 2200],

    'icam_intrinsics': 0,

    'optimization_inputs':
b'P\\'K{{}}AA==',
}}
"""


def test_mrcal(tmp_path):
    path = tmp_path / "left.cameramodel"
    k = (-0.0127, 0.0364, -0.0002, 0.0005, 0.0021, 0.0119, 0.0461, 0.0027)
    path.write_text(MRCAL.format(model="LENSMODEL_OPENCV8", k=", ".join(map(str, k))))
    own = read_calibration(path).cameras["left"]
    assert own.intrinsics == Intrinsics(4000, 2200, 1761.181055, 1761.250444, 1965.706996, 1087.518797, k)
    T = se3.inverse(own.T_world_color)
    np.testing.assert_allclose(
        T, se3.make(so3.exp(np.array([2e-2, -3e-2, 1e-2])), np.array([0.5, -0.25, 0.125])), atol=1e-12
    )
    path.write_text(MRCAL.format(model="LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30", k="0"))
    with pytest.raises(ConfigError, match="mrcal-convert-lensmodel"):
        read_calibration(path)
    path.write_text(MRCAL.format(model="LENSMODEL_OPENCV8", k="0, open('/etc/passwd').read()"))
    with pytest.raises(ConfigError, match="cannot be read as a cameramodel"):
        read_calibration(path)


def realsense(model: str, coeffs: list[float]) -> dict:
    own = {"width": 640, "height": 480, "fx": 610.0, "fy": 611.0, "ppx": 320.5, "ppy": 241.5}
    return {
        "color": {"intrinsics": own | {"model": model, "coeffs": coeffs}},
        "depth": {"intrinsics": own | {"model": "distortion.brown_conrady", "coeffs": [0.0] * 5}},
        "depth_to_color": {
            "rotation": so3.exp(np.array([0.01, 0.02, -0.01])).T.ravel().tolist(),
            "translation": [0.015, 0.0, 0.001],
        },
    }


def test_realsense_with_its_depth_camera(tmp_path):
    path = tmp_path / "d435.json"
    path.write_text(json.dumps(realsense("Brown Conrady", [0.1, -0.2, 0.001, 0.002, 0.03])))
    camera = read_calibration(path).cameras["d435"]
    assert camera.intrinsics.distortion == (0.1, -0.2, 0.001, 0.002, 0.03) and camera.depth is not None
    np.testing.assert_allclose(camera.depth.T_color_depth[:3, :3], so3.exp(np.array([0.01, 0.02, -0.01])), atol=1e-12)


@pytest.mark.parametrize("model", ["distortion.inverse_brown_conrady", "Modified Brown Conrady"])
def test_other_lens_models_of_realsense_become_opencvs(tmp_path, model):
    k = [-0.055, 0.064, 0.0004, -0.0006, -0.02]
    path = tmp_path / "d435.json"
    path.write_text(json.dumps(realsense(model, k)))
    found = read_calibration(path)
    own = found.cameras["d435"].intrinsics
    assert any("as OpenCV's, within" in note for note in found.notes)
    # rs2_deproject_pixel_to_point and rs2_project_point_to_pixel, written out
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [639, 479], (500, 2))
    if "inverse" in model:
        x, y = ((pixels - [320.5, 241.5]) / [610.0, 611.0]).T
        r2 = x * x + y * y
        f = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
        ux = x * f + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
        uy = y * f + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y)
        np.testing.assert_allclose(own.project(np.stack([ux, uy, np.ones_like(ux)], 1)), pixels, atol=0.05)
    else:
        x, y = ((pixels - [320.5, 241.5]) / [610.0, 611.0]).T
        r2 = x * x + y * y
        f = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
        xf, yf = x * f, y * f
        u = 610.0 * (xf + 2 * k[2] * xf * yf + k[3] * (r2 + 2 * xf * xf)) + 320.5
        v = 611.0 * (yf + 2 * k[3] * xf * yf + k[2] * (r2 + 2 * yf * yf)) + 241.5
        directions = np.stack([x, y, np.ones_like(x)], 1)
        np.testing.assert_allclose(own.project(directions), np.stack([u, v], 1), atol=0.05)


def test_a_lens_that_opencv_cannot_come_near_is_refused(tmp_path):
    path = tmp_path / "d435.json"
    path.write_text(json.dumps(realsense("Inverse Brown Conrady", [3.0, -5.0, 0.1, 0.1, 9.0])))
    with pytest.raises(ConfigError, match="OpenCV's lens comes within"):
        read_calibration(path)
    path.write_text(json.dumps(realsense("F-Theta", [1.0] * 5)))
    with pytest.raises(ConfigError, match="lens model 'F-Theta' seen"):
        read_calibration(path)


def test_iai_kinect2(tmp_path):
    folder = tmp_path / "kinect2"
    folder.mkdir()
    for name, f in (("color", 1060.0), ("ir", 365.0)):
        store = cv2.FileStorage(str(folder / f"calib_{name}.yaml"), cv2.FILE_STORAGE_WRITE)
        store.write("cameraMatrix", np.array([[f, 0, 256.0], [0, f, 210.0], [0, 0, 1]]))
        store.write("distortionCoefficients", np.array([[0.09, -0.27, 0, 0, 0.1]]))
        store.release()
    found = read_calibration(folder)
    assert found.cameras["kinect2"].depth is None and "calib_pose.yaml" in found.notes[0]
    store = cv2.FileStorage(str(folder / "calib_pose.yaml"), cv2.FILE_STORAGE_WRITE)
    store.write("rotation", np.eye(3))
    store.write("translation", np.array([[-0.052], [0.0], [0.001]]))
    store.release()
    camera = read_calibration(folder).cameras["kinect2"]
    assert camera.intrinsics.fx == 1060.0 and camera.depth.intrinsics.fx == 365.0
    np.testing.assert_allclose(camera.depth.T_color_depth[:3, 3], [-0.052, 0.0, 0.001])


def azure(folder: Path) -> Path:
    """The file that pyk4a writes, with round numbers."""
    eye = np.eye(3).ravel().tolist()
    turn = so3.exp(np.array([0.1, 0.0, 0.0])).ravel().tolist()
    model = "CALIBRATION_LensDistortionModelBrownConrady"

    def camera(location, parameters, rotation, translation, size):
        intrinsics = {"ModelParameterCount": 14, "ModelParameters": parameters, "ModelType": model}
        rt = {"Rotation": rotation, "Translation": translation}
        return {
            "Location": f"CALIBRATION_CameraLocation{location}",
            "Intrinsics": intrinsics,
            "Rt": rt,
            "SensorWidth": size[0],
            "SensorHeight": size[1],
        }

    k = [1.0, 0.5, 0.1, 0.9, 0.4, 0.05, 0.0, 0.0, 0.0002, 0.0001]
    cameras = [
        camera("D0", [0.5, 0.5, 0.49, 0.49, *k], eye, [0.0, 0.0, 0.0], (1024, 1024)),
        camera("PV0", [0.5, 0.5, 0.48, 0.64, *k], turn, [-0.032, -0.002, 0.004], (4096, 3072)),
    ]
    path = folder / "k4a.json"
    path.write_text(json.dumps({"CalibrationInformation": {"Cameras": cameras}}))
    return path


def test_azure(tmp_path):
    camera = read_calibration(azure(tmp_path), (1920, 1080)).cameras["k4a"]
    own = camera.intrinsics
    np.testing.assert_allclose(
        [own.fx, own.fy, own.cx, own.cy], [0.48 * 1920, 0.64 * 1440, 959.5, 0.5 * 1440 - 180 - 0.5], rtol=1e-12
    )
    assert own.distortion == (1.0, 0.5, 0.0001, 0.0002, 0.1, 0.9, 0.4, 0.05)
    depth = camera.depth
    assert (depth.intrinsics.width, depth.intrinsics.cx, depth.intrinsics.cy) == (640, 319.5, 331.5)
    np.testing.assert_allclose(depth.T_color_depth[:3, 3], [-0.032, -0.002, 0.004])
    np.testing.assert_allclose(depth.T_color_depth[:3, :3], so3.exp(np.array([0.1, 0.0, 0.0])), atol=1e-12)
    with pytest.raises(ConfigError, match="800x600 px seen, one of 1280x720"):
        read_calibration(tmp_path / "k4a.json", (800, 600))
