"""`import`: OpenNI files played by the stock runtime, ROS 1 and 2 bags, MCAP files and TUM folders made here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from virtual_rig import read_raw, system_runtime

from rgbd_calib.io.foreign.plan import pair_nearest, plan_frames
from rgbd_calib.io.recording import open_recording

RNG = np.random.default_rng(0)
N, HEIGHT, WIDTH = 5, 48, 64
COLOR = RNG.integers(0, 256, (N, HEIGHT, WIDTH, 3), np.uint8)
DEPTH = RNG.integers(0, 9000, (N, HEIGHT, WIDTH), np.uint16)
K = [50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1]


def check(folder: Path, cameras: tuple[str, ...] = ("C1",), n: int = N) -> None:
    """Every picture came through bit by bit."""
    recording = open_recording(folder)
    assert tuple(recording.cameras) == cameras and len(recording.frames) == n
    for camera in cameras:
        for i, frame in enumerate(recording.frames[:N]):
            np.testing.assert_array_equal(read_raw(recording.color_files[camera][frame]), COLOR[i])
            np.testing.assert_array_equal(read_raw(recording.depth_files[camera][frame]), DEPTH[i])


def write_bag(path: Path, kind: str, compressed: bool = False, depth_lag_us: int = 5000) -> Path:
    """Two cameras, /left and /right, a few ms apart, with intrinsics; colour rgb8, depth 16UC1 or compressed."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    types = store.types
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr

    def header(time_us: int):
        stamp = types["builtin_interfaces/msg/Time"](sec=time_us // 1_000_000, nanosec=time_us % 1_000_000 * 1000)
        more = {"seq": 0} if kind == "ros1" else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **more)

    def image(time_us: int, pixels: np.ndarray, encoding: str):
        if compressed:
            bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
            data = cv2.imencode(".png", bgr)[1].ravel()
            if pixels.ndim == 2:
                data = np.concatenate([np.zeros(12, np.uint8), data])
            name = "rgb8; png compressed bgr8" if pixels.ndim == 3 else "16UC1; compressedDepth png"
            return types["sensor_msgs/msg/CompressedImage"](header=header(time_us), format=name, data=data)
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        step = pixels.shape[1] * pixels.itemsize * (3 if pixels.ndim == 3 else 1)
        return types["sensor_msgs/msg/Image"](header(time_us), *pixels.shape[:2], encoding, 0, step, data)

    def info(time_us: int):
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        upper = kind == "ros1"
        matrices = dict(
            zip(
                "DKRP" if upper else "dkrp",
                map(np.array, ([0.1, -0.2, 0.0, 0.0, 0.0], K, np.eye(3).ravel(), np.zeros(12))),
                strict=True,
            )
        )
        return types["sensor_msgs/msg/CameraInfo"](
            header=header(time_us),
            height=HEIGHT,
            width=WIDTH,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
        )

    with writer:
        topics = {}
        for camera in ("left", "right"):
            message = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
            suffixes = ("/compressed", "/compressedDepth") if compressed else ("", "")
            for name, suffix in zip(("color/image_raw", "aligned_depth_to_color/image_raw"), suffixes, strict=True):
                topics[camera, name] = writer.add_connection(f"/{camera}/{name}{suffix}", message, typestore=store)
            topics[camera, "info"] = writer.add_connection(
                f"/{camera}/color/camera_info", "sensor_msgs/msg/CameraInfo", typestore=store
            )

        def put(camera: str, name: str, time_us: int, message) -> None:
            writer.write(topics[camera, name], time_us * 1000, serialize(message, message.__msgtype__))

        for i in range(N):
            for offset_us, camera in enumerate(("left", "right")):
                time_us = 1_600_000_000_000_000 + i * 33_333 + offset_us * 4000
                put(camera, "color/image_raw", time_us, image(time_us, COLOR[i], "rgb8"))
                put(camera, "info", time_us, info(time_us))
                late_us = time_us + depth_lag_us
                put(camera, "aligned_depth_to_color/image_raw", late_us, image(late_us, DEPTH[i], "16UC1"))
    return path


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
@pytest.mark.parametrize("compressed", [False, True], ids=["raw", "compressed"])
def test_bags(run, tmp_path, kind, compressed):
    path = write_bag(tmp_path / ("rig.bag" if kind == "ros1" else "rig"), kind, compressed)
    if kind == "mcap":
        path = next(path.glob("*.mcap"))
    outcome = run("import", path, "-o", tmp_path / "out", "--board", "9x6", "--square", "0.06")
    assert outcome.status == 0, outcome.stderr
    check(tmp_path / "out", ("left", "right"))
    recording = open_recording(tmp_path / "out")
    assert recording.timestamps_us("right")["000001"] == (37_333, 42_333)
    assert recording.board is not None and "Warning" not in outcome.stderr
    intrinsics = recording.cameras["left"].intrinsics
    assert intrinsics is not None and intrinsics.fy == 51.0 and intrinsics.distortion[1] == -0.2


def test_topics_are_chosen_and_checked(run, tmp_path):
    path = write_bag(tmp_path / "rig.bag", "ros1")
    one = "--topics", "cam=/left/color/image_raw,/left/aligned_depth_to_color/image_raw"
    assert run("import", path, "-o", tmp_path / "out", *one).status == 0
    check(tmp_path / "out", ("cam",))
    outcome = run("import", path, "-o", tmp_path / "other", "--topics", "cam=/left/nothing")
    assert (
        outcome.status == 2 and "/left/nothing is no image topic" in outcome.stderr and "/left/color" in outcome.stderr
    )
    assert not (tmp_path / "other").exists()


def test_colour_only(run, tmp_path):
    path = write_bag(tmp_path / "rig.bag", "ros1")
    assert run("import", path, "-o", tmp_path / "out", "--color-only").status == 0
    assert not (tmp_path / "out" / "left" / "depth").exists()


@pytest.mark.parametrize("name", ["broken.bag", "broken.mcap"])
def test_a_broken_bag(run, tmp_path, name):
    (tmp_path / name).write_bytes(b"not a bag" * 100)
    outcome = run("import", tmp_path / name, "-o", tmp_path / "out")
    assert outcome.status == 2 and "cannot be read as a ROS bag" in outcome.stderr and not (tmp_path / "out").exists()


def tum_folder(folder: Path, drop_depth: tuple[int, ...] = ()) -> Path:
    for kind, pictures in (("rgb", COLOR), ("depth", DEPTH)):
        (folder / kind).mkdir(parents=True)
        lines = ["# timestamp filename"]
        for i in range(N):
            if kind == "depth" and i in drop_depth:
                continue
            file = f"{kind}/{i}.png"
            cv2.imwrite(str(folder / file), pictures[i][..., ::-1] if kind == "rgb" else pictures[i])
            lines.append(f"{1305031102.175304 + i / 30 + (0.011 if kind == 'depth' else 0):.6f} {file}")
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return folder


TUM_UNIT = "--depth-scale", "0.0002"


def test_tum(run, tmp_path):
    asked = run("import", tum_folder(tmp_path / "tum"), "-o", tmp_path / "out")
    assert asked.status == 2 and "nothing in it says the unit of its depth" in asked.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["tum"]
    outcome = run("import", tmp_path / "tum", "-o", tmp_path / "out", *TUM_UNIT)
    assert outcome.status == 0, outcome.stderr
    check(tmp_path / "out")
    assert open_recording(tmp_path / "out").cameras["C1"].depth_scale == 1 / 5000
    assert run("import", tmp_path / "tum", "-o", tmp_path / "out").status == 2
    assert run("import", tmp_path / "tum", "-o", tmp_path / "out", "--overwrite", *TUM_UNIT).status == 0


def test_frames_without_depth_stay_without(run, tmp_path):
    assert run("import", tum_folder(tmp_path / "tum", (2,)), "-o", tmp_path / "out", *TUM_UNIT).status == 0
    recording = open_recording(tmp_path / "out")
    assert len(recording.frames) == N and not recording.has_depth("C1", "000002")
    np.testing.assert_array_equal(read_raw(recording.depth_files["C1"]["000003"]), DEPTH[3])


def test_two_files_are_two_times_unless_they_started_together(run, tmp_path):
    for name in ("a", "b"):
        tum_folder(tmp_path / name)
    assert (
        run("import", f"left={tmp_path / 'a'}", f"right={tmp_path / 'b'}", "-o", tmp_path / "apart", *TUM_UNIT).status
        == 0
    )
    apart = open_recording(tmp_path / "apart")
    assert len(apart.frames) == 2 * N and not set(apart.color_files["left"]) & set(apart.color_files["right"])
    assert (
        run("import", tmp_path / "a", tmp_path / "b", "--synchronous", "-o", tmp_path / "together", *TUM_UNIT).status
        == 0
    )
    check(tmp_path / "together", ("C1", "C2"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "rgb.txt").write_text("one two\n"), "rgb.txt: line 1: 'one two' seen"),
        (lambda f: (f / "rgb" / "3.png").unlink(), "3.png: no such image"),
        (
            lambda f: cv2.imwrite(str(f / "depth" / "1.png"), COLOR[0]),
            "16 bits and one channel, or floating point, needed for depth",
        ),
    ],
)
def test_a_damaged_tum_folder(run, tmp_path, damage, message):
    damage(tum_folder(tmp_path / "tum"))
    outcome = run("import", tmp_path / "tum", "-o", tmp_path / "out", *TUM_UNIT)
    assert outcome.status == 2 and message in outcome.stderr and not (tmp_path / "out").exists()


def test_what_cannot_be_imported(run, tmp_path):
    (tmp_path / "x.txt").write_text("")
    assert "not a recording that can be imported" in run("import", tmp_path / "x.txt", "-o", tmp_path / "out").stderr
    assert "no such file" in run("import", tmp_path / "y.oni", "-o", tmp_path / "out").stderr


def test_openni_file(real_data, tmp_path):
    """A real one, in a process of its own: every frame of both streams, at their times."""
    from virtual_rig import VirtualRig

    rig = VirtualRig(system_runtime(), tmp_path)
    ended = rig.run("import", real_data("kinect_scene.oni"), "-o", tmp_path / "out")
    assert ended.status == 0, ended.stderr
    assert "C1: 12 colour and 12 depth frames" in ended.stderr and "taken as registered" in ended.stderr
    recording = open_recording(tmp_path / "out")
    assert len(recording.frames) == 12 and all(recording.has_depth("C1", f) for f in recording.frames)
    assert recording.timestamps_us("C1")["000011"] == (366_719, 378_742)
    assert np.isfinite(recording.depth_m("C1", "000000")).mean() > 0.3


def test_no_colour_partner_no_frame():
    plan = plan_frames({"C1": {"color": [0, 33_333, 66_666], "depth": [34_000, 900_000]}})
    assert plan.frames == [
        {("C1", "color"): 0},
        {("C1", "color"): 1, ("C1", "depth"): 0},
        {("C1", "color"): 2},
    ]
    assert plan.lone_depth == {"C1": 1} and plan.lone_color == {"C1": 2}


def test_the_nearest_of_each_other_are_a_pair():
    assert pair_nearest([0, 100], [60, 90], 50) == {1: 1}
    assert pair_nearest([], [1], 50) == {}
