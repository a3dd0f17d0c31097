"""The driver of Orbbec cameras: what is its own, and the double that it is tested with."""

from __future__ import annotations

import inspect

import cv2
import numpy as np
import pytest
import soft_orbbec
from soft_orbbec import DepthFrame, OBFormat, SoftOrbbec

from rgbd_calib.errors import CalibrationError
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
