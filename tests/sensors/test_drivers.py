"""What is of one driver only, how they are chosen, and captures by them."""

from __future__ import annotations

import shutil
import time
from contextlib import closing

import pytest
from small_recording import draw_recording
from soft_azure import SoftAzure
from soft_orbbec import SoftOrbbec

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.sensors import k4a
from rgbd_calib.sensors.discover import find_cameras
from rgbd_calib.sensors.driver import Drivers, load_drivers
from rgbd_calib.sensors.realsense import RealSense


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("replayed") / "drawn", cameras=2, frames=4)


@pytest.fixture
def rs():
    return pytest.importorskip("pyrealsense2")


def read(device, seconds: float = 1.0):
    end_s, frames = time.monotonic() + seconds, []
    while time.monotonic() < end_s:
        frame = device.wait_frame(0.1)
        if frame is not None:
            frames.append(frame)
    return frames


def test_a_realsense_at_another_rate_and_one_that_is_gone(rs):
    from soft_realsense import SoftRealSense

    slow = SoftRealSense("111", fps=15)
    attached = [slow.handle]
    driver = RealSense(rs, lambda: attached)
    with pytest.raises(CalibrationError, match=r"a depth stream at 30 fps needed, .*640x480@15.* USB 3"):
        driver.open("realsense:111").configure()
    attached.clear()
    assert driver.uris() == []
    with pytest.raises(CalibrationError, match="no longer attached"):
        driver.open("realsense:111")


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


def test_capture_of_colour_alone_and_its_calibration(run, drawn, tmp_path):
    """By --color-only, and of a recording without depth played as cameras; the rig is judged by its pixels."""
    out = tmp_path / "out"
    quick = ("--count", "4", "--interval", "0.1", "--settle", "0.1", "--board", "9x6", "--square", "0.06")
    ended = run("capture", out, "--driver", f"replay:{drawn}", "--color-only", *quick)
    assert ended.status == 0 and "depth" not in ended.stderr, ended.stderr
    played = run("capture", tmp_path / "again", "--driver", f"replay:{out}", *quick)
    assert played.status == 0 and "C1: has no depth sensor; its colour alone is recorded" in played.stderr
    for folder in (out, tmp_path / "again"):
        recording = open_recording(folder)
        assert not any(info.depth_stated or info.depth for info in recording.cameras.values())
        assert not any(recording.depth_files.values()) and not list(folder.glob("*/depth"))
        assert "depth:" not in (folder / "dataset.yaml").read_text()
        assert all(color > 0 for color, _ in recording.timestamps_us("C1").values())
    whole = tmp_path / "whole"  # which frames were caught depends on the machine; of few, a lens is not determined
    shutil.copytree(drawn, whole, ignore=shutil.ignore_patterns("depth"))
    shutil.copy(out / "dataset.yaml", whole / "dataset.yaml")
    calibrated = run("calibrate", whole, "-o", tmp_path / "rig.yaml", "--jobs", "1")
    assert "depth is not used" in calibrated.stderr, calibrated.stderr
    refused = run("capture", tmp_path / "other", "--color-only", "--depth-bias")
    assert refused.status == 2 and "--color-only leaves depth out" in refused.stderr


def test_devices_lists_those_of_the_drivers_asked_for(run, drawn, tmp_path):
    listed = run("devices", "--driver", f"replay:{drawn}")
    assert listed.status == 0 and "serial drawn-C2" in listed.stdout
    unknown = run("devices", "--driver", "kinect")
    assert unknown.status == 2 and "one of openni2, realsense, azure, orbbec, replay:RECORDING needed" in unknown.stderr
    absent = run("devices", "--driver", f"replay:{tmp_path / 'none'}")
    assert absent.status == 2 and "no such folder" in absent.stderr


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("realsense", r"pip install 'rgbd-calib\[realsense\]'"),
        ("azure", r"pip install 'rgbd-calib\[azure\]'"),
        ("orbbec", "pip install --no-deps pyorbbecsdk2"),
    ],
)
def test_a_missing_sdk_is_named_with_the_command_that_installs_it(monkeypatch, name, command):
    for module in ("pyrealsense2", "pyorbbecsdk"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    monkeypatch.setattr(k4a, "bundled_library", lambda: None)
    monkeypatch.setattr(k4a, "SYSTEM_LIBRARY", "libk4a-that-is-not-there.so")
    with pytest.raises(ConfigError, match=command):
        load_drivers([name], None)


@pytest.mark.parametrize("make", [SoftAzure, SoftOrbbec])
def test_a_device_node_without_permission_gets_the_udev_rule(monkeypatch, make):
    monkeypatch.setattr("rgbd_calib.sensors.discover.forbidden_node", lambda uri: "/dev/bus/usb/091/001")
    camera = make("111")
    drivers = Drivers([make.driver([camera])])
    monkeypatch.setattr(drivers, "open", lambda uri: (_ for _ in ()).throw(CalibrationError("refused")))
    (found,) = find_cameras(drivers).devices
    assert found.problem is not None
    assert "no permission for /dev/bus/usb/091/001" in found.problem and "udev" in found.problem


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
