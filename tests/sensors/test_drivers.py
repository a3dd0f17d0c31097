"""Drivers of cameras: each is run through the same contract; RealSense's by librealsense's software devices."""

from __future__ import annotations

import threading
import time
from contextlib import closing

import numpy as np
import pytest
import virtual_rig
from small_recording import draw_recording

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.sensors.discover import find_cameras
from rgbd_calib.sensors.driver import Drivers, load_drivers
from rgbd_calib.sensors.frames import PERIOD_S
from rgbd_calib.sensors.openni2 import load_runtime
from rgbd_calib.sensors.reader import DeviceReader
from rgbd_calib.sensors.realsense import RealSense
from rgbd_calib.sensors.replay import Replay
from rgbd_calib.sensors.rig import SensorRig

WIDTH, HEIGHT = 640, 480
T_DEPTH_M = (0.015, 0.001, -0.002)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("replayed") / "drawn", cameras=2, frames=4)


class SoftDevice:
    """A RealSense camera without hardware: what it is sent comes out of the driver."""

    def __init__(self, rs, serial: str, depth_size=(WIDTH, HEIGHT), fps=30, unit_m=0.00025) -> None:
        self.rs, self.handle = rs, rs.software_device()
        self.handle.register_info(rs.camera_info.serial_number, serial)
        self.handle.register_info(rs.camera_info.name, "Software")
        self.color, self.depth = self.handle.add_sensor("RGB Camera"), self.handle.add_sensor("Stereo Module")
        self.profiles = {
            "color": self.color.add_video_stream(self.stream(rs.stream.color, rs.format.rgb8, 3, (WIDTH, HEIGHT), fps)),
            "depth": self.depth.add_video_stream(self.stream(rs.stream.depth, rs.format.z16, 2, depth_size, fps)),
        }
        self.size = {"color": (WIDTH, HEIGHT), "depth": depth_size}
        pose = rs.extrinsics()
        pose.rotation = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]  # columns: a quarter turn
        pose.translation = list(T_DEPTH_M)
        self.profiles["depth"].register_extrinsics_to(self.profiles["color"], pose)
        self.depth.add_read_only_option(rs.option.depth_units, unit_m)
        self.sent = 0

    def stream(self, kind, form, bytes_per_pixel, size, fps):
        lens = self.rs.intrinsics()
        lens.width, lens.height = size
        lens.fx, lens.fy, lens.ppx, lens.ppy = 600.0, 601.0, size[0] / 2, size[1] / 2
        lens.model, lens.coeffs = self.rs.distortion.brown_conrady, [0.1, -0.05, 0.001, 0.0, 0.0]
        video = self.rs.video_stream()
        video.type, video.index, video.uid, video.fps = kind, 0, int(kind), fps
        video.width, video.height, video.bpp, video.fmt, video.intrinsics = *size, bytes_per_pixel, form, lens
        return video

    def pixels(self, kind: str, n: int) -> np.ndarray:
        width, height = self.size[kind]
        rng = np.random.default_rng([n, kind == "depth"])
        if kind == "color":
            return rng.integers(0, 256, (height, width, 3), np.uint8)
        return rng.integers(400, 9000, (height, width), np.uint16)

    def send(self, skip: tuple[str, ...] = ()) -> None:
        for kind, sensor in (("depth", self.depth), ("color", self.color)):
            if kind not in skip:
                frame = self.rs.software_video_frame()
                frame.pixels = self.pixels(kind, self.sent)
                frame.bpp = 3 if kind == "color" else 2
                frame.stride = self.size[kind][0] * frame.bpp
                frame.timestamp = 1000 + self.sent * 1000 / 30
                frame.domain, frame.frame_number = self.rs.timestamp_domain.hardware_clock, self.sent
                frame.profile = self.profiles[kind].as_video_stream_profile()
                sensor.on_video_frame(frame)
        self.sent += 1


class Player:
    """Sends frames of software devices at 30 a second until it is closed."""

    def __init__(self, devices: list[SoftDevice]) -> None:
        self._stop = threading.Event()
        self._devices = devices
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        start_s, n = time.monotonic(), 0
        while not self._stop.wait(max(0.0, start_s + n * PERIOD_S - time.monotonic())):
            n += 1
            for device in list(self._devices):
                device.send()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def rs():
    return pytest.importorskip("pyrealsense2")


@pytest.fixture(params=["replay", "realsense"])
def driver(request, drawn):
    """A driver with two cameras that deliver."""
    if request.param == "replay":
        with closing(Replay(drawn)) as made:
            yield made
        return
    rs = pytest.importorskip("pyrealsense2")
    devices = [SoftDevice(rs, "111"), SoftDevice(rs, "222")]
    with closing(RealSense(rs, lambda: [d.handle for d in devices])) as made, closing(Player(devices)):
        yield made


def read(device, seconds: float = 1.0):
    end_s, frames = time.monotonic() + seconds, []
    while time.monotonic() < end_s:
        frame = device.wait_frame(0.1)
        if frame is not None:
            frames.append(frame)
    return frames


def test_two_devices_are_found_set_up_and_deliver(driver):
    found = find_cameras(Drivers([driver]))
    assert len(found.devices) == 2 and not any(d.problem for d in found.devices)
    assert all("color 640x480@30" in " ".join(d.modes) for d in found.devices)
    assert all(driver.owns(d.identity.uri) for d in found.devices)
    for uri in driver.uris():
        device = driver.open(uri)
        settings, info = device.configure(), device.describe()
        assert (info.width, info.height) == (WIDTH, HEIGHT) and settings.registered == (info.depth is None)
        device.start()
        frames = read(device)
        for kind, shape, dtype in (("color", (HEIGHT, WIDTH, 3), np.uint8), ("depth", (HEIGHT, WIDTH), np.uint16)):
            own = [f for f in frames if f.kind == kind]
            assert len(own) > 15  # of 30; the machine may be busy
            assert own[0].pixels.shape == shape and own[0].pixels.dtype == dtype
            assert np.all(np.diff([f.device_us for f in own]) > 0)
        device.close()
        device.close()


def test_a_rig_of_both(driver):
    said = []
    cameras = find_cameras(Drivers([driver])).assign({})
    with SensorRig(
        Drivers([driver]), cameras, lambda *words: said.append(words), settle_s=0.2, allow_unregistered=True
    ) as rig:
        after_s = 0.0
        for _ in range(5):
            frame_set = rig.next_frame_set(after_s, 2.0)
            assert frame_set is not None and set(frame_set.frames) == set(cameras) and not frame_set.absent
            after_s = frame_set.time_s + PERIOD_S / 2
        assert all(counts.pairs > 5 for counts in rig.counts().values())
        assert set(rig.describe()) == set(cameras)


def test_frames_of_a_software_device_come_as_they_were_sent(rs):
    soft = SoftDevice(rs, "111", depth_size=(848, 480))
    device = RealSense(rs, lambda: [soft.handle]).open("realsense:111")
    device.configure()
    device.start()
    got = []
    for n in range(20):
        soft.send(skip=("depth",) if n == 7 else ())  # a frame that the sensor dropped
        got += [f for _ in range(2) if (f := device.wait_frame(0.5)) is not None]
    device.close()
    assert [f.index for f in got if f.kind == "color"] == list(range(20))
    assert [f.index for f in got if f.kind == "depth"] == [n for n in range(20) if n != 7]
    for frame in got:
        np.testing.assert_array_equal(frame.pixels, soft.pixels(frame.kind, frame.index))
        assert abs(frame.device_us - (1e6 + frame.index * 1e6 / 30)) <= 1


def test_what_a_realsense_states_of_itself(rs):
    soft = SoftDevice(rs, "111", depth_size=(848, 480))
    device = RealSense(rs, lambda: [soft.handle]).open("realsense:111")
    device.configure()
    info = device.describe()
    assert (info.serial, info.depth_scale) == ("111", 0.00025)
    assert info.intrinsics is not None and np.allclose(info.intrinsics.vector[:4], [600, 601, 320, 240])
    assert info.intrinsics.distortion[:3] == pytest.approx((0.1, -0.05, 0.001))
    own = info.depth
    assert own is not None and (own.width, own.height) == (848, 480)
    # p_color = T_color_depth @ p_depth: x of depth is y of colour
    np.testing.assert_allclose(own.T_color_depth @ [1, 0, 0, 1], [0.015, 1.001, -0.002, 1], atol=1e-6)
    assert not device.lock_exposure() and device.camera_settings() == {}
    with pytest.raises(CalibrationError, match="cannot be switched"):
        device.set_emitter(False)


def test_one_camera_gives_the_pulse_and_the_others_follow(rs):
    soft, mode = [SoftDevice(rs, "111"), SoftDevice(rs, "222"), SoftDevice(rs, "333")], rs.option.inter_cam_sync_mode
    allowed = rs.option_range()
    allowed.min, allowed.max, allowed.step, allowed.default = 0.0, 2.0, 1.0, 0.0
    for device in soft[:2]:
        device.depth.add_option(mode, allowed, True)
    driver, said = Drivers([RealSense(rs, lambda: [d.handle for d in soft])]), []
    cameras = find_cameras(driver).assign({})
    with (
        closing(Player(soft)),
        SensorRig(driver, cameras, lambda *words: said.append(words), settle_s=0.1, sync_leader="C2"),
    ):
        assert [d.depth.get_option(mode) for d in soft[:2]] == [2.0, 1.0]
    assert [camera for camera, text in said if "runs freely" in text] == ["C3"]


def test_a_realsense_at_another_rate_and_one_that_is_gone(rs):
    slow = SoftDevice(rs, "111", fps=15)
    attached = [slow.handle]
    driver = RealSense(rs, lambda: attached)
    with pytest.raises(CalibrationError, match=r"a depth stream at 30 fps needed, .*640x480@15.* USB 3"):
        driver.open("realsense:111").configure()
    attached.clear()
    assert driver.uris() == []
    with pytest.raises(CalibrationError, match="no longer attached"):
        driver.open("realsense:111")


def test_a_camera_that_is_unplugged_and_comes_back(rs):
    devices = [SoftDevice(rs, "111"), SoftDevice(rs, "222")]
    attached = list(devices)
    driver = Drivers([RealSense(rs, lambda: [d.handle for d in attached])])
    said = []
    sending = list(devices)
    with (
        closing(Player(sending)),
        SensorRig(driver, find_cameras(driver).assign({}), lambda *words: said.append(words), settle_s=0.1) as rig,
    ):
        sending.remove(devices[1])
        attached.remove(devices[1])
        wait_for(lambda: any("unplugged" in text for camera, text in said if camera == "C2"))
        assert rig.live_cameras == ("C1",)
        alone = rig.next_frame_set(time.monotonic(), 2.0)
        assert alone is not None and alone.absent == ("C2",)
        again = SoftDevice(rs, "222")
        sending.append(again)
        attached.append(again)
        wait_for(lambda: rig.live_cameras == ("C1", "C2"))
    assert ("C2", "plugged in again") in said


def wait_for(condition, seconds: float = 15.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def test_capture_from_a_replayed_recording(run, drawn, tmp_path):
    out = tmp_path / "out"
    args = ("--driver", f"replay:{drawn}", "--count", "3", "--interval", "0.1", "--settle", "0.1")
    ended = run("capture", out, "--board", "9x6", "--square", "0.06", *args)
    assert ended.status == 0, ended.stderr
    refused = run("capture", tmp_path / "other", *args, "--sync", "C9")
    assert refused.status == 2 and "--sync C9: one of the cameras C1, C2 needed" in refused.stderr
    recording, source = open_recording(out), open_recording(drawn)
    assert len(recording.frames) == 3 and recording.cameras["C1"].serial == "drawn-C1"
    originals = {source.color("C1", f).tobytes() for f in source.frames}
    assert all(recording.color("C1", f).tobytes() in originals for f in recording.frames)
    assert all(info.depth is None and info.depth_scale == 0.001 for info in recording.cameras.values())


def test_devices_lists_those_of_the_drivers_asked_for(run, drawn, tmp_path):
    listed = run("devices", "--driver", f"replay:{drawn}")
    assert listed.status == 0 and "serial drawn-C2" in listed.stdout
    unknown = run("devices", "--driver", "kinect")
    assert unknown.status == 2 and "one of openni2, realsense, replay:RECORDING needed" in unknown.stderr
    absent = run("devices", "--driver", f"replay:{tmp_path / 'none'}")
    assert absent.status == 2 and "no such folder" in absent.stderr


def test_a_missing_sdk_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(ConfigError, match=r"pip install 'rgbd-calib\[realsense\]'"):
        load_drivers(["realsense"], None)


def test_the_recorded_software_device_plays(rs, real_data):
    """What librealsense plays back is what the driver gives."""
    path = str(real_data("containers") / "realsense_software_device.db3")
    context = rs.context()
    played = context.load_device(path)
    driver = RealSense(rs, lambda: [played])
    with closing(driver):
        device = driver.open(driver.uris()[0])
        device.configure()
        device.start()
        frames = read(device, 0.6)
    assert {f.kind for f in frames} == {"color", "depth"} and device.describe().intrinsics is not None


@pytest.mark.slow
def test_two_realsense_and_one_openni2_at_once_lose_nothing(rs, drawn, tmp_path, monkeypatch):
    """For 20 s at 30 a second; every frame of the software devices is the one that was sent."""
    redist = virtual_rig.build_redist(tmp_path / "redist")
    virtual_rig.feed(open_recording(drawn), tmp_path / "raw")
    (tmp_path / "control").touch()
    for name, value in (("DEVICES", 1), ("DATA", tmp_path / "raw"), ("CONTROL", tmp_path / "control")):
        monkeypatch.setenv(f"VXTION_{name}", str(value))
    devices = [SoftDevice(rs, "111"), SoftDevice(rs, "222")]
    bank = {kind: [devices[0].pixels(kind, n) for n in range(16)] for kind in ("color", "depth")}
    monkeypatch.setattr(SoftDevice, "pixels", lambda self, kind, n: bank[kind][n % 16])
    wrong: list[tuple[str, int]] = []
    take = DeviceReader._take

    def check_and_take(self, frame):
        if self.camera in realsense and not np.array_equal(frame.pixels, bank[frame.kind][frame.index % 16]):
            wrong.append((self.camera, frame.index))
        take(self, frame)

    monkeypatch.setattr(DeviceReader, "_take", check_and_take)
    with closing(Drivers([load_runtime(redist), RealSense(rs, lambda: [d.handle for d in devices])])) as drivers:
        cameras = find_cameras(drivers).assign({})
        realsense = {c for c, identity in cameras.items() if identity.uri.startswith("realsense:")}
        assert len(realsense) == 2 and len(cameras) == 3
        with closing(Player(devices)), SensorRig(drivers, cameras, lambda *words: None, settle_s=1.0) as rig:
            start_s = time.monotonic()
            time.sleep(20.0)
            seconds, counts = time.monotonic() - start_s, rig.counts()
            assert rig.next_frame_set(time.monotonic(), 1.0).absent == ()
    assert not wrong
    for own in counts.values():
        assert not any(own.lost.values()) and min(own.frames.values()) > 29.5 * seconds
