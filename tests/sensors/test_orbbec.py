"""The driver of Orbbec cameras: what is its own, and the double that it is tested with."""

from __future__ import annotations

import inspect

import cv2
import numpy as np
import orbbec_bag
import pytest
import soft_orbbec
from orbbec_bag import write_orbbec_bag
from soft_orbbec import DepthFrame, OBFormat, SoftOrbbec

from rgbd_calib.errors import CalibrationError
from rgbd_calib.sensors.orbbec import OrbbecCamera
from rgbd_calib.sensors.orbbec_frames import color_of, values_of


def test_an_orbbec_camera_locks_what_it_has_and_says_it():
    camera = SoftOrbbec("111", cable=True)
    device = SoftOrbbec.driver([camera]).open("orbbec:111@90/1")
    settings = device.configure()
    assert (settings.color_mode, settings.depth_mode) == ("1280x960@30 RGB", "640x576@30 Y16") and not settings.mirrored
    assert device.lock_exposure() and device.set_sync(1)
    said = device.camera_settings()
    assert said == {"auto_exposure": False, "auto_white_balance": False, "exposure": 156, "white_balance": 4504}
    assert camera.sync.trigger_to_image_delay_us == 160
    with pytest.raises(CalibrationError, match="cannot be switched"):
        device.set_emitter(False)
    device.close()
    assert camera.sync_place is None  # alone it must not wait for a pulse


def test_an_orbbec_camera_whose_unit_of_depth_changes_ends():
    camera = SoftOrbbec("111")
    device = SoftOrbbec.driver([camera]).open("orbbec:111@90/1")
    device.configure()
    device.start()
    camera.send()
    assert {device.wait_frame(0.1).kind for _ in range(2)} == {"color", "depth"}
    camera.unit_m = 0.001
    camera.send()
    with pytest.raises(CalibrationError, match=r"unit of depth changed from 0\.25 to 1 mm"):
        device.wait_frame(0.1)


def test_pixels_of_every_format():
    rng = np.random.default_rng(1)
    rgb = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
    yuyv = np.full((48, 64, 2), 128, np.uint8)  # grey
    yuyv[..., 0] = np.arange(16, 80)
    for form, data, off in ((OBFormat.RGB, rgb, 0), (OBFormat.BGR, rgb[..., ::-1], 0), (OBFormat.MJPG, jpeg, 8)):
        got = color_of(DepthFrame(np.ascontiguousarray(data), form, 0, 0, 1.0), "C1")
        assert got.shape == rgb.shape and np.median(abs(got.astype(int) - rgb)) <= off
    grey = color_of(DepthFrame(yuyv, OBFormat.YUYV, 0, 0, 1.0), "C1")
    # BT.601 of 8 bits: R = G = B = 1.164 (Y - 16)
    np.testing.assert_allclose(grey[0, :, 1], 1.164 * np.arange(64), atol=1)
    assert color_of(DepthFrame(jpeg[:9], OBFormat.MJPG, 0, 0, 1.0), "C1") is None
    eight = rng.integers(0, 256, (48, 64), np.uint8)
    np.testing.assert_array_equal(values_of(DepthFrame(eight, OBFormat.Y8, 0, 0, 1.0), "C1"), eight)
    with pytest.raises(CalibrationError, match="a frame of 64x48 px in Y16 has 6144 bytes, 3072 seen"):
        values_of(DepthFrame(eight, OBFormat.Y16, 0, 0, 1.0), "C1")


def test_the_double_of_the_orbbec_package_has_its_names():
    binding = pytest.importorskip("pyorbbecsdk")
    held = 0
    for name, own in inspect.getmembers(soft_orbbec):
        if getattr(own, "__module__", "") != "soft_orbbec" or name == "SoftOrbbec":
            continue
        real = getattr(binding, name)
        members = (
            own.__members__
            if hasattr(own, "__members__")
            else [n for n in vars(own) if not n.startswith("_")]
            if inspect.isclass(own)
            else []
        )
        for member in members:
            assert hasattr(real, member), f"{name}.{member}"
            held += 1
    assert held > 60


def test_a_recording_that_the_sdk_plays(tmp_path):
    """What the SDK plays of a file as it writes them is what the driver gives; see docs/guides/cameras.md for the command."""
    binding = pytest.importorskip("pyorbbecsdk")
    binding.Context.set_logger_level(binding.OBLogLevel.NONE)
    rng = np.random.default_rng(2)
    sent = {
        "color": [rng.integers(0, 256, (480, 640, 3), np.uint8) for _ in range(8)],
        "depth": [rng.integers(400, 9000, (576, 640), np.uint16) for _ in range(8)],
    }
    sent["ir"] = [image // 8 for image in sent["depth"]]
    played = binding.PlaybackDevice(str(write_orbbec_bag(tmp_path / "femto.bag", sent)))
    device = OrbbecCamera(binding, played, f"orbbec:{orbbec_bag.SERIAL}@2/5")
    settings = device.configure()
    assert (settings.color_mode, settings.depth_mode) == ("640x480@30 RGB", "640x576@30 Y16")
    assert not device.set_sync(0) and not device.lock_exposure() and device.camera_settings() == {}
    device.start()
    frames = []
    while (frame := device.wait_frame(1.0)) is not None:
        frames.append(frame)
    info = device.describe()
    device.close()
    for kind in ("color", "depth"):
        own = [f for f in frames if f.kind == kind]
        first = own[0].index
        assert first <= 1 and [f.index for f in own] == list(range(first, 8))  # streams start one after the other
        for frame in own:
            assert frame.device_us == orbbec_bag.START_US + frame.index * orbbec_bag.PERIOD_US
            np.testing.assert_array_equal(frame.pixels, sent[kind][frame.index])
            if kind == "depth" and frame.index > 1:
                np.testing.assert_array_equal(frame.infrared, sent["ir"][frame.index])
    k1, k2, k3, k4, k5, k6, p1, p2 = orbbec_bag.DISTORTION
    np.testing.assert_allclose(info.intrinsics.vector, [*orbbec_bag.LENS, k1, k2, p1, p2, k3, k4, k5, k6], rtol=1e-6)
    np.testing.assert_allclose(info.depth.T_color_depth[:3, :3], orbbec_bag.R_COLOR_DEPTH)
    np.testing.assert_allclose(info.depth.T_color_depth[:3, 3], np.array(orbbec_bag.T_COLOR_DEPTH_MM) / 1000, rtol=1e-6)
    assert (info.serial, info.depth_scale) == (orbbec_bag.SERIAL, 0.001)
