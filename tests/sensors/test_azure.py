"""The driver of Azure Kinect cameras: what is its own, and the SDK's library where pyk4a-bundle is installed."""

from __future__ import annotations

import ctypes
import inspect
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from soft_azure import SoftAzure, SoftK4a
from soft_cameras import Player

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.foreign.azure import AzureMkv
from rgbd_calib.io.recording import open_recording
from rgbd_calib.sensors import driver, k4a
from rgbd_calib.sensors.azure_kinect import AzureKinects
from rgbd_calib.sensors.usb import UsbDevice, usb_devices


@pytest.fixture
def library():
    if k4a.bundled_library() is None:
        pytest.skip("pyk4a-bundle is not installed")
    return k4a.load_library()


def test_capture_of_an_azure_kinect(run, tmp_path, monkeypatch):
    """Infrared images and the geometry of depth are in the recording, the exposure that was locked is in its log."""
    camera = SoftAzure("000123")
    monkeypatch.setattr(driver, "_azure", lambda: SoftAzure.driver([camera]))
    out = tmp_path / "out"
    with closing(Player([camera])):
        args = ("--driver", "azure", "--count", "2", "--interval", "0.1", "--settle", "0.1")
        ended = run("capture", out, "--board", "9x6", "--square", "0.06", *args)
    assert ended.status == 0, ended.stderr
    recording = open_recording(out)
    assert len(recording.ir_files["C1"]) == len(recording.frames) == 2
    frame = recording.frames[0]
    depth, infrared = recording.depth_own_m("C1", frame), recording.ir("C1", frame)
    assert depth.shape == infrared.shape == (576, 640) and recording.cameras["C1"].time_of_flight
    (logged,) = yaml.safe_load((out / "capture.yaml").read_text())["sessions"][0]["cameras"].values()
    assert (logged["auto_exposure"], logged["exposure"], logged["white_balance"]) == (False, 8330, 4500)
    assert camera.controls == {k4a.EXPOSURE: None, k4a.WHITE_BALANCE: None}  # as it was, after the capture


def test_a_camera_without_a_cable_or_a_switch_says_so():
    camera = SoftAzure("111")
    device = SoftAzure.driver([camera]).open("azure:111@90/1")
    device.configure()
    assert not device.set_sync(0) and not device.set_sync(1)
    assert not device.lock_exposure()  # no image has told what it is
    with pytest.raises(CalibrationError, match="cannot be switched"):
        device.set_emitter(False)
    device.close()


def test_lasers_take_turns():
    cameras = [SoftAzure(serial, cable=True) for serial in ("111", "222", "333")]
    driver = SoftAzure.driver(cameras)
    for place, uri in enumerate(driver.uris()):
        device = driver.open(uri)
        device.configure()
        assert device.set_sync(place)
        device.start()
    assert [c.setup.subordinate_delay_off_master_usec for c in cameras] == [0, 160, 320]
    with pytest.raises(CalibrationError, match=r"does not open .*unavalable.*idProduct"):
        driver.open(driver.uris()[0])  # it is open
    driver.close()


def test_cameras_are_listed_by_the_kernel(tmp_path):
    for name, vendor, product, serial in (
        ("2-1.2", "045e", "097d", "000123"),
        ("2-1.1", "045e", "097c", "000123"),
        ("1-3", "2bc5", "066b", None),
        ("2-1.2:1.0", None, None, None),
    ):
        folder = tmp_path / name
        folder.mkdir()
        written = {"idVendor": vendor, "idProduct": product, "busnum": name[0], "devnum": "7", "serial": serial}
        for file, text in written.items():
            if text is not None:
                (folder / file).write_text(f"{text}\n")
    assert usb_devices("045e", "097d", tmp_path) == [UsbDevice("000123", "2/7")]
    assert usb_devices("2bc5", sysfs=tmp_path) == [UsbDevice("", "1/7")]
    assert usb_devices("2bc5", sysfs=tmp_path / "none") == []


def test_the_double_of_the_azure_library_has_its_methods():
    for name, method in inspect.getmembers(SoftK4a, inspect.isfunction):
        if not name.startswith("_"):
            own = inspect.signature(getattr(k4a.K4a, name))
            assert list(inspect.signature(method).parameters) == list(own.parameters), name


def test_the_library_refuses_in_words(library, capfd):
    assert library.count() == 0
    with pytest.raises(k4a.K4aError, match=r"libusb device\(s\) are all una"):
        library.open(0)
    assert capfd.readouterr().out == ""


class Played(SoftK4a):
    """A recording of k4arecorder, played by the SDK's library as one camera."""

    def __init__(self, library: k4a.K4a, path: Path) -> None:
        super().__init__([SoftAzure("000123")])
        self._library = library
        self._record = ctypes.CDLL(str(next(k4a.bundled_library().parent.glob("libk4arecord-*"))))
        self._playback = ctypes.c_void_p()
        assert self._record.k4a_playback_open(str(path).encode(), ctypes.byref(self._playback)) == 0
        assert self._record.k4a_playback_set_color_conversion(self._playback, k4a.BGRA32) == 0

    def calibration(self, device: SoftAzure) -> str:
        size, text = ctypes.c_size_t(1 << 16), ctypes.create_string_buffer(1 << 16)
        assert self._record.k4a_playback_get_raw_calibration(self._playback, text, ctypes.byref(size)) == 0
        return text.value.decode()

    def capture(self, device: SoftAzure, timeout_ms: int) -> k4a.Capture | None:
        capture = ctypes.c_void_p()
        ended = self._record.k4a_playback_get_next_capture(self._playback, ctypes.byref(capture))
        return None if ended else self._library.copied(capture)


def test_a_recording_that_the_library_plays_is_what_import_reads(library, real_data):
    path = real_data("containers") / "azure_kinect.mkv"
    device = AzureKinects(Played(library, path), lambda: [UsbDevice("000123", "2/7")]).open("azure:000123@2/7")
    device.configure()
    device.start()
    color, depth, end = (device.wait_frame(0.1) for _ in range(3))
    assert color is not None and depth is not None and end is None
    source = AzureMkv(path, "C1")
    read = {image.kind: image.pixels for image in source.pictures(lambda *_: True)}
    np.testing.assert_array_equal(depth.pixels, read["depth"])
    np.testing.assert_array_equal(depth.infrared, read["ir"])
    assert color.pixels.shape == (720, 1280, 3)
    assert source.stamps()["C1"] == {"color": [color.device_us], "depth": [depth.device_us], "ir": [depth.device_us]}
    info, own = device.describe(), source.cameras["C1"]
    np.testing.assert_array_equal(info.intrinsics.vector, own.intrinsics.vector)
    np.testing.assert_array_equal(info.depth.intrinsics.vector, own.depth_intrinsics.vector)
    np.testing.assert_array_equal(info.depth.T_color_depth, own.T_color_depth)
