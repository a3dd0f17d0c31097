"""`import` of bags and of makers' containers: lenses, extrinsics, units and stamps, and depth in its own geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import orbbec_bag
import pytest
from foreign_files import bag2
from orbbec_bag import write_orbbec_bag

from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.import_sources import OpenOptions, open_source

RNG = np.random.default_rng(0)
N, HEIGHT, WIDTH = 4, 48, 64
COLOR = RNG.integers(0, 256, (N, HEIGHT, WIDTH, 3), np.uint8)
DEPTH = RNG.integers(1, 9000, (N, HEIGHT // 2, WIDTH // 2), np.uint16)
RATIONAL = [0.3, -2.4, 1e-3, -2e-3, 1.4, 0.2, -2.3, 1.3]
EQUIDISTANT = [0.01, -0.02, 0.003, 0.001]


def test_two_cameras_with_rational_lenses(run, tmp_path):
    with bag2(tmp_path / "rig") as bag:
        for camera, model, d in (
            ("cam1", "rational_polynomial", RATIONAL),
            ("cam2", "equidistant", EQUIDISTANT),
        ):
            bag.info(f"/{camera}/rgb/camera_info", (WIDTH, HEIGHT), model, d)
            for i in range(N):
                time_us = 2_000_000 + 33_333 * i + (4000 if camera == "cam2" else 0)
                bag.image(f"/{camera}/rgb/image_raw", time_us, COLOR[i], "bgr8", f"{camera}_color")
    outcome = run("import", tmp_path / "rig", "-o", tmp_path / "out")
    assert outcome.status == 0, outcome.stderr
    recording = open_recording(tmp_path / "out")
    assert len(recording.frames) == N
    first, second = (recording.cameras[c].intrinsics for c in ("cam1", "cam2"))
    assert first is not None and first.model == "opencv" and first.distortion == tuple(RATIONAL)
    assert second is not None and second.model == "kannala_brandt" and second.distortion == tuple(EQUIDISTANT)
    np.testing.assert_array_equal(recording.color("cam2", "000003"), COLOR[3])


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_of_its_own_geometry(run, tmp_path, encoding):
    """T_color_depth along the tree of static transforms; depth's own lens; metres where depth is 32FC1."""
    T_base_color = se3.make(so3.exp(np.array([0.1, -0.2, 0.3])), np.array([0.02, 0.0, 0.01]))
    T_base_depth = se3.make(so3.exp(np.array([0.1, -0.21, 0.3])), np.array([-0.03, 0.0, 0.01]))
    with bag2(tmp_path / "rig") as bag:
        bag.tf_static("base", "color", T_base_color)
        bag.tf_static("base", "depth", T_base_depth)
        bag.info("/cam/color/camera_info", (WIDTH, HEIGHT), "plumb_bob", [0.1, 0, 0, 0, 0])
        bag.info("/cam/depth/camera_info", (32, 24), "plumb_bob", [], [25.0, 0, 15.5, 0, 25.0, 11.5, 0, 0, 1])
        for i in range(N):
            time_us = 2_000_000 + 33_333 * i
            bag.image("/cam/color/image_raw", time_us, COLOR[i], "bgr8", "color")
            depth = DEPTH[i] if encoding == "16UC1" else (DEPTH[i] / 1000).astype(np.float32)
            bag.image("/cam/depth/image_raw", time_us + 3000, depth, encoding, "depth")
            bag.image("/cam/confidence/image_raw", time_us, depth, encoding, "depth")
    outcome = run(
        "import", tmp_path / "rig", "-o", tmp_path / "out", "--topics", "A=/cam/color/image_raw,/cam/depth/image_raw"
    )
    assert outcome.status == 0, outcome.stderr
    assert "image topics that are not used: /cam/confidence/image_raw" in outcome.stderr
    recording = open_recording(tmp_path / "out")
    own = recording.cameras["A"].depth
    assert own is not None and own.intrinsics is not None and own.intrinsics.fx == 25.0
    assert own.T_color_depth is not None
    np.testing.assert_allclose(own.T_color_depth, se3.inverse(T_base_color) @ T_base_depth, atol=1e-12)
    np.testing.assert_allclose(recording.depth_own_m("A", "000002"), DEPTH[2] / 1000, rtol=1e-6)


ORBBEC = {
    "custom_msg/msg/OBImuStreamProfile": "uint8 x",
    "custom_msg/msg/StreamProfileInfo": (
        "float32[] cameraIntrinsic\nfloat32[] cameraDistortion\nuint8 distortionModel\nuint16 width\nuint16 height\n"
        "float32[] rotationMatrix\nfloat32[] translationMatrix\n"
    ),
    "custom_msg/msg/DeviceInfo": "string sn\n",
    "custom_msg/msg/Frame": (
        "std_msgs/Header header\nuint64 timestamp_usec\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data\n"
    ),
}


def write_orbbec(path: Path) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in ORBBEC.items():
        store.register(get_types_from_msg(text, name))
    types = store.types
    f32 = lambda *v: np.array(v, np.float32)  # noqa: E731
    R = so3.exp(np.array([0.0, 0.01, 0.0]))
    color = types["custom_msg/msg/StreamProfileInfo"](
        f32(50, 51, 31.5, 23.5),
        f32(0.1, -0.2, 0.3, 0, 0, 0, 0.001, 0.002),
        4,
        WIDTH,
        HEIGHT,
        f32(*[0] * 9),
        f32(0, 0, 0),
    )
    depth = types["custom_msg/msg/StreamProfileInfo"](
        f32(25, 25, 15.5, 11.5), f32(*[0] * 8), 0, 32, 24, f32(*R.ravel()), f32(-32.0, 1.0, 2.0)
    )
    with Writer(path) as writer:
        topics = {}

        def put(topic: str, time_us: int, message) -> None:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], time_us * 1000, store.serialize_ros1(message, kind))

        put("/cam/streamProfileType_2", 1, color)
        put("/cam/streamProfileType_3", 1, depth)
        put("/cam/deviceInfo", 1, types["custom_msg/msg/DeviceInfo"]("CP0123"))
        for i in range(N):
            for sensor, pixels, encoding in ((2, COLOR[i], "bgr8"), (3, DEPTH[i], "mono16"), (5, DEPTH[i], "mono16")):
                time_us = 1_000_000 + 33_333 * i
                stamp = types["builtin_interfaces/msg/Time"](time_us // 1_000_000, 0)
                header = types["std_msgs/msg/Header"](i, stamp, "")
                data = np.frombuffer(pixels.tobytes(), np.uint8)
                frame = types["custom_msg/msg/Frame"](
                    header, time_us, *pixels.shape[:2], encoding, 0, data.size // pixels.shape[0], data
                )
                put(f"/cam/sensor_{sensor}/frameType_{sensor}", time_us, frame)
    return path


def test_orbbec_bag(run, tmp_path):
    outcome = run("import", write_orbbec(tmp_path / "femto.bag"), "-o", tmp_path / "out", "--depth-scale", "0.001")
    assert outcome.status == 0 and "/cam/sensor_5/frameType_5 is not used" in outcome.stderr, outcome.stderr
    recording = open_recording(tmp_path / "out")
    info = recording.cameras["C1"]
    assert info.serial == "CP0123" and info.intrinsics is not None and info.intrinsics.fy == 51.0
    assert info.intrinsics.distortion[:5] == pytest.approx((0.1, -0.2, 0.001, 0.002, 0.3))
    assert info.depth is not None and info.depth.T_color_depth is not None
    np.testing.assert_allclose(info.depth.T_color_depth[:3, 3], [-0.032, 0.001, 0.002], atol=1e-7)
    np.testing.assert_allclose(info.depth.T_color_depth[:3, :3], so3.exp(np.array([0.0, 0.01, 0.0])), atol=1e-6)
    np.testing.assert_allclose(recording.depth_own_m("C1", "000001"), DEPTH[1] / 1000)
    assert recording.timestamps_us("C1")["000003"] == (99_999, 99_999)
    asked = run("import", tmp_path / "femto.bag", "-o", tmp_path / "other")
    assert asked.status == 2 and "nothing in it says the unit of its depth" in asked.stderr


def test_a_bag_of_the_orbbec_sdk(run, tmp_path):
    """Checksums, frames and a type of the IMU that are not those of ROS."""
    rgb = [image[..., ::-1] for image in COLOR]
    path = write_orbbec_bag(
        tmp_path / "femto.bag", {"color": rgb, "depth": list(DEPTH), "ir": list(DEPTH // 8)}, imu=True
    )
    outcome = run("import", path, "-o", tmp_path / "out", "--depth-scale", "0.001")
    assert outcome.status == 0 and "/cam/sensor_4/frameType_4 is not used" in outcome.stderr, outcome.stderr
    recording = open_recording(tmp_path / "out")
    info = recording.cameras["C1"]
    assert info.serial == orbbec_bag.SERIAL and info.intrinsics is not None and info.depth is not None
    np.testing.assert_allclose(info.intrinsics.vector[:4], orbbec_bag.LENS)
    np.testing.assert_allclose(info.depth.T_color_depth[:3, :3], orbbec_bag.R_COLOR_DEPTH)
    np.testing.assert_allclose(info.depth.T_color_depth[:3, 3], np.array(orbbec_bag.T_COLOR_DEPTH_MM) / 1000, rtol=1e-6)
    for i in range(N):
        frame = f"{i:06d}"
        assert recording.timestamps_us("C1")[frame] == (i * orbbec_bag.PERIOD_US,) * 2
        np.testing.assert_array_equal(recording.color("C1", frame), COLOR[i])
        np.testing.assert_allclose(recording.depth_own_m("C1", frame), DEPTH[i] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(recording.ir("C1", frame), DEPTH[i] // 8)


def test_a_ros_bag_whose_checksums_are_wrong_is_refused(run, tmp_path):
    path = write_orbbec_bag(tmp_path / "femto.bag", {"color": [COLOR[0]]})
    data = path.read_bytes().replace(b"/cam/sensor_", b"/rig/sensor_")
    (tmp_path / "other.bag").write_bytes(data)
    outcome = run("import", tmp_path / "other.bag", "-o", tmp_path / "out")
    assert outcome.status == 2 and "hash mismatch" in outcome.stderr


def test_native_bag_of_a_realsense(real_data):
    """Depth as such, not as registered: the recording's streams differ in lens and place."""
    source = open_source(real_data("containers") / "realsense_single.bag", "D435", OpenOptions())
    own = source.cameras["D435"]
    assert own.serial == "728612070259" and own.depth_scale == 0.001 and own.registered is False
    assert own.intrinsics is not None and own.intrinsics.fx == pytest.approx(613.2036743)
    assert own.depth_intrinsics is not None and own.depth_intrinsics.fx == pytest.approx(390.4314575)
    assert own.T_color_depth is not None
    np.testing.assert_allclose(own.T_color_depth[:3, 3], [0.0143, 0.0006, 0.0006], atol=1e-4)
    pictures = list(source.pictures(lambda *key: True))
    assert [p.kind for p in pictures].count("depth") == 2 and len(source.stamps()["D435"]["depth"]) == 2
    depth = next(p.pixels for p in pictures if p.kind == "depth")
    assert depth.shape == (480, 640) and depth.dtype == np.uint16 and np.any(depth)


def test_db3_of_librealsense(run, real_data, tmp_path):
    path = real_data("containers") / "realsense_software_device.db3"
    outcome = run("import", f"rs={path}", "-o", tmp_path / "out")
    assert outcome.status == 0 and "rs: 11 colour and 11 depth frames" in outcome.stderr, outcome.stderr
    recording = open_recording(tmp_path / "out")
    info = recording.cameras["rs"]
    assert info.serial == "000000000001" and info.depth is not None and info.depth.intrinsics is not None
    assert info.intrinsics is not None and info.intrinsics.fx == 600.0 and info.depth.intrinsics.fx == 400.0
    assert info.depth.T_color_depth is not None and info.depth.T_color_depth[0, 3] == pytest.approx(0.015)
    assert recording.timestamps_us("rs")["000001"] == (33_300, 33_300)
    assert all(np.isfinite(recording.depth_own_m("rs", f)).any() for f in recording.frames)


def test_mkv_of_azure_kinect(run, real_data, tmp_path):
    path = real_data("containers") / "azure_kinect.mkv"
    outcome = run("import", path, "-o", tmp_path / "out")
    assert outcome.status == 0 and "1 colour and 1 depth frames, 1 infrared" in outcome.stderr, outcome.stderr
    recording = open_recording(tmp_path / "out")
    info = recording.cameras["C1"]
    assert (
        info.intrinsics is not None
        and len(info.intrinsics.distortion) == 8
        and (info.width, info.height) == (1280, 720)
    )
    own = info.depth
    assert own is not None and own.intrinsics is not None and own.T_color_depth is not None
    # Microsoft's design: the colour camera 32 mm beside depth's, turned down by 6 degrees less or more
    np.testing.assert_allclose(own.T_color_depth[:3, 3], [-0.032, -0.002, 0.004], atol=5e-4)
    frame = recording.frames[0]
    assert recording.ir("C1", frame).shape == recording.depth_own_m("C1", frame).shape == (576, 640)
    assert 0.3 < np.nanmedian(recording.depth_own_m("C1", frame)) < 6
    assert recording.color_files["C1"][frame].suffix == ".jpg"
    assert recording.color("C1", frame).shape == (720, 1280, 3)


def test_an_mkv_that_was_cut(run, real_data, tmp_path):
    data = (real_data("containers") / "azure_kinect.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) // 3])
    outcome = run("import", tmp_path / "cut.mkv", "-o", tmp_path / "out")
    assert outcome.status == 0 and "no picture of depth, ir in it. Was it cut short?" in outcome.stderr
    (tmp_path / "cut.mkv").write_bytes(data[:20_000])
    outcome = run("import", tmp_path / "cut.mkv", "-o", tmp_path / "other")
    assert outcome.status in (1, 2) and not (tmp_path / "other").exists()


def test_an_endless_file_without_an_end_of_line_is_no_bag(run, tmp_path):
    with (tmp_path / "huge.bag").open("wb") as stream:
        stream.truncate(20 << 30)
    refused = run("import", f"A={tmp_path / 'huge.bag'}", "-o", tmp_path / "out")
    assert refused.status == 2 and "'#ROSBAG V2.0\\n' expected" in refused.stderr
