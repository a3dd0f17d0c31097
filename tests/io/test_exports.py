"""Exports read back by the loader of the program they are for: the same points land on the same pixels."""

import json
import sys
import types
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, project, rays
from rgbd_calib.geometry.lens_fit import image_grid
from rgbd_calib.io import exports
from rgbd_calib.io.calibrations import read_calibration
from rgbd_calib.io.exports.common import Options
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.quality import CameraStatistics, Quality
from rgbd_calib.types import DepthBias, Rig, RigCamera

AGREE_PX = 1e-6
LENS = Intrinsics(640, 480, 571.23456789, 569.87654321, 318.4567, 243.2109, (0.06, -0.11, 0.0008, -0.0013, 0.045))


def a_rig(k3=True, distorted=True, identity=False, n=4):
    rng = np.random.default_rng(5)
    cameras = {}
    for i in range(n):
        distortion = np.array(LENS.distortion) * (1 + 0.1 * i) * [1, 1, 1, 1, k3] * distorted
        lens = LENS.with_vector(np.array([*(LENS.vector[:4] + i), *distortion]))
        T = se3.make(so3.exp(rng.normal(0, 0.7, 3)), rng.normal(0, 1, 3))
        T = np.eye(4) if identity and i == 1 else T
        bias = DepthBias((0.01, -0.02), 0.5, 4.0, 0.002) if i == 0 else None
        cameras[f"C{i}"] = RigCamera(lens, T, np.diag([1e-6] * 6), bias, CameraStatistics(sigma_2d_px=0.2))
    return Rig("C1" if n > 1 else "C0", cameras, Quality(other={"rms_px": 0.3}), {"seed": 1})


def points_of(rig, name):
    """World points (n, 3) that camera `name` sees all over its image, and their pixels (n, 2)."""
    camera = rig.cameras[name]
    u, v = np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    p_color = rays(camera.intrinsics.vector, pixels) * np.linspace(0.5, 4, len(pixels))[:, None]
    return se3.transform(camera.T_world_color, p_color), project(camera.intrinsics.vector, p_color)


def by_cv2(p_world, T_color_world, K, distortion):
    rotation, t = cv2.Rodrigues(np.array(T_color_world)[:3, :3])[0], np.array(T_color_world)[:3, 3]
    return cv2.projectPoints(p_world, rotation, t, np.array(K), np.array(distortion))[0][:, 0]


def exported(rig, to, path, **options):
    exports.write(path, exports.export(rig, to, Options(suffix=path.suffix, **options)), overwrite=False)
    return path


@pytest.mark.parametrize("k3", [True, False])
def test_colmap_read_by_pycolmap(tmp_path, k3):
    pycolmap = pytest.importorskip("pycolmap")
    rig = a_rig(k3)
    folder = exported(rig, "colmap", tmp_path / "sparse", image_name="{camera}/color/0.png")
    model = pycolmap.Reconstruction(str(folder))
    assert model.num_reg_images() == 4
    for image in model.images.values():
        name = image.name.split("/")[0]
        p_world, pixels = points_of(rig, name)
        p_color = (
            (image.cam_from_world() * p_world) if callable(image.cam_from_world) else image.cam_from_world * p_world
        )
        # COLMAP's top left pixel has its centre at (0.5, 0.5)
        assert np.abs(image.camera.img_from_cam(p_color) - 0.5 - pixels).max() < AGREE_PX
        assert image.camera.model.name == ("FULL_OPENCV" if k3 else "OPENCV")


def test_colmap_rig_is_read_as_one_rig(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rig = a_rig()
    model = pycolmap.Reconstruction(str(exported(rig, "colmap", tmp_path / "sparse")))
    assert len(model.rigs) == 1 and len(model.frames) == 1
    sensors = next(iter(model.rigs.values())).non_ref_sensors
    names = list(rig.cameras)
    assert {names[sensor.id - 1] for sensor in sensors} == {"C0", "C2", "C3"}
    for sensor, pose in sensors.items():
        T_color_ref = se3.inverse(rig.cameras[names[sensor.id - 1]].T_world_color) @ rig.cameras["C1"].T_world_color
        assert np.allclose(pose.matrix(), T_color_ref[:3], atol=1e-12)


def test_open3d_read_by_open3d(tmp_path):
    import open3d as o3d

    rig = a_rig(distorted=False)
    path = exported(rig, "open3d", tmp_path / "trajectory.json")
    trajectory = o3d.io.read_pinhole_camera_trajectory(str(path))
    assert len(trajectory.parameters) == 4
    for name, parameters in zip(rig.cameras, trajectory.parameters, strict=True):
        p_world, pixels = points_of(rig, name)
        assert (parameters.intrinsic.width, parameters.intrinsic.height) == (640, 480)
        p_color = se3.transform(parameters.extrinsic, p_world) @ parameters.intrinsic.intrinsic_matrix.T
        assert np.abs(p_color[:, :2] / p_color[:, 2:] - pixels).max() < AGREE_PX


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_read_by_cv2(tmp_path, suffix):
    rig = a_rig()
    store = cv2.FileStorage(str(exported(rig, "opencv", tmp_path / f"rig{suffix}")), cv2.FILE_STORAGE_READ)
    assert store.getNode("reference").string() == "C1"
    cameras = store.getNode("cameras")
    assert cameras.size() == 4
    for i in range(cameras.size()):
        node = cameras.at(i)
        p_world, pixels = points_of(rig, node.getNode("name").string())
        T_color_world = np.linalg.inv(node.getNode("T_world_color").mat())
        K, distortion = node.getNode("camera_matrix").mat(), node.getNode("distortion_coefficients").mat()
        assert np.abs(by_cv2(p_world, T_color_world, K, distortion) - pixels).max() < AGREE_PX
        assert int(node.getNode("image_width").real()) == 640
    bias = cameras.at(0).getNode("depth_bias_coefficients").mat().ravel()
    assert np.array_equal(bias, rig.cameras["C0"].depth_bias.coefficients)


@pytest.mark.parametrize("identity", [True, False])
def test_kalibr_read_by_pyyaml(tmp_path, identity):
    rig = a_rig(k3=False, identity=identity)
    text = exported(rig, "kalibr", tmp_path / "camchain.yaml").read_text()
    chain = yaml.safe_load(text)
    order = ["C1", "C0", "C2", "C3"]  # the reference first
    assert "cam0 is C1, cam1 is C0" in text.splitlines()[0]
    T_camera_first = np.eye(4)
    for n, name in enumerate(order):
        entry = chain[f"cam{n}"]
        T_camera_first = np.array(entry.get("T_cn_cnm1", np.eye(4))) @ T_camera_first
        p_world, pixels = points_of(rig, name)
        p_first = se3.transform(se3.inverse(rig.cameras["C1"].T_world_color), p_world)
        fu, fv, pu, pv = entry["intrinsics"]
        K = [[fu, 0, pu], [0, fv, pv], [0, 0, 1]]
        assert np.abs(by_cv2(p_first, T_camera_first, K, entry["distortion_coeffs"]) - pixels).max() < AGREE_PX
    notes = exports.export(rig, "kalibr", Options()).notes
    assert any("no world" in note for note in notes) != identity


def test_nerfstudio_read_by_json(tmp_path):
    rig = a_rig()
    data = json.loads(exported(rig, "nerfstudio", tmp_path / "transforms.json").read_text())
    assert data["camera_model"] == "OPENCV"
    for name, frame in zip(rig.cameras, data["frames"], strict=True):
        assert frame["file_path"] == f"{name}.png"
        p_world, pixels = points_of(rig, name)
        p_gl = se3.transform(np.linalg.inv(frame["transform_matrix"]), p_world)
        assert np.all(p_gl[:, 2] < 0)  # OpenGL cameras look along -z
        K = [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        distortion = [frame[key] for key in ("k1", "k2", "p1", "p2", "k3")]
        # nerfstudio's top left pixel has its centre at (0.5, 0.5)
        assert np.abs(by_cv2(p_gl * [1, -1, -1], np.eye(4), K, distortion) - 0.5 - pixels).max() < AGREE_PX


def launched(path, monkeypatch):
    """Arguments of every node that the ROS 2 launch file starts, with stand-ins for ROS' two modules."""
    launch, launch_ros, actions = (types.ModuleType(n) for n in ("launch", "launch_ros", "launch_ros.actions"))
    launch.LaunchDescription = list
    actions.Node = dict
    for module in (launch, launch_ros, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    scope = {}
    exec(compile(path.read_text(), str(path), "exec"), scope)
    return [node["arguments"] for node in scope["generate_launch_description"]()]


def test_ros_camera_info_read_by_pyyaml_and_both_launch_files_agree(tmp_path, monkeypatch):
    rig = a_rig()
    folder = exported(rig, "ros", tmp_path / "ros")
    two = {
        words[-1]: dict(zip(words[0::2], words[1::2], strict=True))
        for words in launched(folder / "rig.launch.py", monkeypatch)
    }
    one = {}
    for node in ElementTree.parse(folder / "rig.launch").getroot():
        words = node.attrib["args"].split()
        one[words[-1]] = dict(
            zip(("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw", "--frame-id"), words, strict=False)
        )
    for name in rig.cameras:
        info = yaml.safe_load((folder / f"{name}.yaml").read_text())
        assert (info["camera_name"], info["distortion_model"]) == (name, "plumb_bob")
        frame = f"{name}_color_optical_frame"
        assert {k: v for k, v in two[frame].items() if k != "--child-frame-id"} == one[frame]
        x, y, z, *q = (float(one[frame][f"--{key}"]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        T_world_color = se3.make(so3.Rotation.from_quat(q).as_matrix(), np.array([x, y, z]))
        p_world, pixels = points_of(rig, name)
        K = np.reshape(info["camera_matrix"]["data"], (3, 3))
        back = by_cv2(p_world, se3.inverse(T_world_color), K, info["distortion_coefficients"]["data"])
        assert np.abs(back - pixels).max() < AGREE_PX
        assert np.array_equal(np.reshape(info["projection_matrix"]["data"], (3, 4))[:, :3], K)


def test_json_is_the_rig_bit_for_bit(tmp_path):
    rig = a_rig()
    path = exported(rig, "json", tmp_path / "rig.json")
    assert json.loads(path.read_text())["reference"] == "C1"
    back = read_rig(path)  # YAML readers read JSON
    for name, camera in rig.cameras.items():
        assert np.array_equal(back.cameras[name].T_world_color, camera.T_world_color)
        assert back.cameras[name].intrinsics == camera.intrinsics
    assert back.cameras["C0"].depth_bias == rig.cameras["C0"].depth_bias


@pytest.mark.parametrize("to", exports.FORMATS)
@pytest.mark.parametrize("n", [1, 33])
def test_every_format_takes_one_camera_and_many(tmp_path, to, n):
    suffix = (*exports.FORMATS[to].suffixes, "")[0]
    path = exported(a_rig(n=n), to, tmp_path / f"out{suffix}", undistorted=True)
    assert path.exists()


@pytest.mark.parametrize(("to", "nearest"), [("kalibr", "radtan|equidistant"), ("open3d", "a pinhole")])
def test_a_lens_that_is_like_none_of_the_format_stops_the_export(to, nearest):
    rig = strong_rig()
    needle = (
        f"C0: lens opencv with k1, k2, p1, p2, k3 seen, .* its nearest, ({nearest}), is off by .* px.*--undistorted"
    )
    with pytest.raises(ConfigError, match=needle):
        exports.export(rig, to, Options())
    assert exports.export(rig, to, Options(undistorted=True)).files[""]


def strong_rig():
    """Lenses far from those of Kalibr."""
    rig = a_rig()
    lens = replace(LENS, distortion=(0.2, -0.5, 0.003, -0.002, 0.4))
    return replace(rig, cameras={name: replace(c, intrinsics=lens) for name, c in rig.cameras.items()})


@pytest.mark.parametrize("to", ["kalibr", "open3d"])
def test_a_refitted_lens_is_off_by_what_is_said(to, tmp_path):
    rig = a_rig() if to == "kalibr" else strong_rig()
    largest = 0.3 if to == "kalibr" else 100
    made = exports.export(rig, to, Options(max_px=largest))
    noted = [float(note.split("off by ")[1].split(" px")[0]) for note in made.notes if "refitted" in note]
    assert len(noted) == 4
    path = exported(rig, to, tmp_path / ("out.yaml" if to == "kalibr" else "out.json"), max_px=largest)
    found = [camera.intrinsics for camera in read_calibration(path).cameras.values()]
    order = ["C1", "C0", "C2", "C3"] if to == "kalibr" else list(rig.cameras)
    for name, lens in zip(order, found, strict=True):
        own = rig.cameras[name].intrinsics
        pixels = image_grid(own.width, own.height)
        off = np.linalg.norm(lens.project(own.rays(pixels)) - pixels, axis=1).max()
        assert off == pytest.approx(noted[list(rig.cameras).index(name)], rel=0.06)  # two digits are said


@pytest.mark.parametrize("to", ["ros", "kalibr", "colmap", "nerfstudio", "open3d"])
def test_a_lost_depth_bias_is_said(to):
    notes = exports.export(a_rig(), to, Options(undistorted=True)).notes
    assert any("depth bias of C0" in note for note in notes)


def test_ros_refuses_names_that_ros_refuses():
    rig = a_rig(n=1)
    with pytest.raises(ConfigError, match="left-top"):
        exports.export(replace(rig, reference="left-top", cameras={"left-top": rig.cameras["C0"]}), "ros", Options())


@pytest.mark.parametrize("pattern", ["image.png", "{frame}.png", "{camera", "{camera.x}"])
def test_an_image_name_must_tell_the_cameras_apart(pattern):
    with pytest.raises(ConfigError, match="--image-name"):
        exports.export(a_rig(), "colmap", Options(image_name=pattern))


def test_command_writes_replaces_when_asked_and_says_what_is_left_out(run, tmp_path):
    write_rig(tmp_path / "rig.yaml", a_rig())
    args = ("export", tmp_path / "rig.yaml", "--to", "colmap", tmp_path / "sparse")
    outcome = run(*args)
    assert outcome.status == 0 and "depth bias of C0" in outcome.stderr
    again = run(*args)
    assert again.status == 2 and "--overwrite" in again.stderr
    assert run(*args, "--overwrite").status == 0
    assert (tmp_path / "sparse" / "cameras.txt").exists()


@pytest.mark.parametrize(
    ("to", "name"), [("kalibr", "chain.json"), ("ros", "out.yaml"), ("open3d", "out.json"), ("nerfstudio", "folder")]
)
def test_command_errors_leave_nothing(run, tmp_path, to, name):
    write_rig(tmp_path / "rig.yaml", a_rig())
    outcome = run("export", tmp_path / "rig.yaml", "--to", to, tmp_path / name)
    assert outcome.status == 2 and outcome.stderr.startswith("Error: ")
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]
