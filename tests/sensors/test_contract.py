"""What every driver of cameras does: the same tests for all, on librealsense's software devices, OpenNI2's virtual driver and
doubles of the other SDKs. What a make cannot do is said by its class of cameras, and tested as such."""

from __future__ import annotations

import importlib
import time
from contextlib import closing

import numpy as np
import pytest
from small_recording import draw_recording
from soft_cameras import LENS, T_COLOR_DEPTH, Player

from rgbd_calib.errors import CalibrationError
from rgbd_calib.sensors import reader, rig
from rgbd_calib.sensors.discover import find_cameras
from rgbd_calib.sensors.driver import Drivers
from rgbd_calib.sensors.frames import PERIOD_S
from rgbd_calib.sensors.replay import Replay
from rgbd_calib.sensors.rig import SensorRig

MAKES = {"openni2": "SoftOpenNi2", "realsense": "SoftRealSense", "azure": "SoftAzure", "orbbec": "SoftOrbbec"}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("replayed") / "drawn", cameras=2, frames=4)


def class_of(make, request):
    """The class of a make's cameras; skips where software is missing that the make needs."""
    if make == "realsense":
        pytest.importorskip("pyrealsense2")
    if make == "openni2":
        importlib.import_module("soft_openni2").use(request.getfixturevalue("redist"))
    return getattr(importlib.import_module(f"soft_{make}"), MAKES[make])


@pytest.fixture(params=MAKES)
def make(request):
    return class_of(request.param, request)


@pytest.fixture(params=["replay", *MAKES])
def driver(request, drawn):
    """A driver with two cameras that deliver."""
    if request.param == "replay":
        with closing(Replay(drawn)) as made:
            yield made
        return
    make = class_of(request.param, request)
    cameras = [make("111"), make("222")]
    with closing(make.driver(cameras)) as made, closing(Player(cameras)):
        yield made


@pytest.fixture
def quick(monkeypatch):
    """Silence and replugging are noticed at once."""
    monkeypatch.setattr(reader, "STALLED_AFTER_S", 0.5)
    monkeypatch.setattr(rig, "_LOOK_S", 0.1)
    monkeypatch.setattr(rig, "_WATCH_S", 0.05)


def opened(make, camera, attached=None):
    """The device of one camera, set up and started."""
    driver = make.driver([camera] if attached is None else attached)
    device = driver.open(next(uri for uri in driver.uris() if camera.is_at(uri)))
    device.configure()
    device.start()
    return device


def rig_of(cameras, said, **options):
    driver = Drivers([type(cameras[0]).driver(cameras)])
    found = find_cameras(driver).assign({})
    return SensorRig(driver, found, lambda *words: said.append(words), settle_s=0.1, **options)


def wait_for(condition, seconds: float = 15.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def whole_set(rig):
    """A frame set of all cameras; a busy machine may hold one of them back."""
    end_s = time.monotonic() + 15.0
    while True:
        found = rig.next_frame_set(time.monotonic(), 2.0)
        if found is not None and not found.absent:
            return found
        assert time.monotonic() < end_s


def test_two_cameras_are_found_set_up_and_deliver(driver):
    found = find_cameras(Drivers([driver]))
    assert len(found.devices) == 2 and not any(d.problem for d in found.devices)
    assert all("@30" in " ".join(d.modes) and driver.owns(d.identity.uri) for d in found.devices)
    assert driver.label.startswith("replay") or {d.identity.serial for d in found.devices} == {"111", "222"}
    for uri in driver.uris():
        device = driver.open(uri)
        settings = device.configure()
        device.start()
        end_s, frames = time.monotonic() + 15.0, []
        while min(sum(f.kind == kind for f in frames) for kind in ("color", "depth")) < 5:
            frame = device.wait_frame(0.1)
            frames += [frame] if frame is not None else []
            assert time.monotonic() < end_s
        info = device.describe()
        assert (info.width, info.height) == device.sizes["color"] and info.depth_size == device.sizes["depth"]
        assert settings.registered == (info.depth is None)
        for kind, dtype in (("color", np.uint8), ("depth", np.uint16)):
            own = [f for f in frames if f.kind == kind]
            assert own[0].pixels.shape[1::-1] == device.sizes[kind] and own[0].pixels.dtype == dtype
            assert np.all(np.diff([f.device_us for f in own]) > 0)
        device.close()
        device.close()


def test_a_rig_of_both(driver):
    said = []
    cameras = find_cameras(Drivers([driver])).assign({})
    with SensorRig(
        Drivers([driver]), cameras, lambda *words: said.append(words), settle_s=0.1, allow_unregistered=True
    ) as both:
        for _ in range(3):
            assert set(whole_set(both).frames) == set(cameras)
        assert all(counts.pairs > 3 for counts in both.counts().values())
        assert set(both.describe()) == set(cameras)


def test_colour_alone_where_that_is_asked_for(driver):
    """Of cameras that have depth: nothing of it is delivered, stated or waited for."""
    drivers, said = Drivers([driver]), []
    cameras = find_cameras(drivers).assign({})
    with SensorRig(drivers, cameras, lambda *words: said.append(words), settle_s=0.1, color_only=True) as both:
        for _ in range(3):
            frame_set = whole_set(both)
            assert all(frame.depth is None and frame.depth_s is None for frame in frame_set.frames.values())
            assert all(frame.color.pixels.dtype == np.uint8 for frame in frame_set.frames.values())
        assert all(set(counts.frames) == {"color"} for counts in both.counts().values())
        assert not any(info.depth_stated or info.depth for info in both.describe().values())
        assert all(device.depth_mode is None for device, _ in both.settings().values())
    assert not said


def test_a_camera_without_a_depth_sensor(make):
    """It is recorded beside one that has depth, and that is said."""
    if not make.may_lack_depth:
        with pytest.raises(TypeError, match="depth"):
            make("111", depth=False)
        return
    cameras, said = [make("111"), make("222", depth=False)], []
    with closing(Player(cameras)), rig_of(cameras, said) as both:
        frame_set = whole_set(both)
        assert frame_set.frames["C1"].depth is not None and frame_set.frames["C2"].depth is None
        alone = both.describe()["C2"]
        assert (alone.width, alone.height) == make.sizes["color"] and not alone.depth_stated
        assert (alone.intrinsics is not None) == make.states_geometry
    assert said == [("C2", "has no depth sensor; its colour alone is recorded")]


def test_frames_come_as_they_were_sent(make):
    camera = make("111")
    device = opened(make, camera)
    got = []
    for n in range(12):
        camera.send(skip=("depth",) if n == 7 else ())  # a frame that the sensor dropped
        got += [f for _ in range(2) if (f := device.wait_frame(0.2)) is not None]
    device.close()
    stamps_us = {kind: [f.device_us for f in got if f.kind == kind] for kind in ("color", "depth")}
    sent_us = [1_000_000 + (n + 1) * round(PERIOD_S * 1e6) for n in range(12)]
    assert stamps_us["color"] == sent_us and stamps_us["depth"] == sent_us[:7] + sent_us[8:]
    for frame in got:
        sent = camera.pixels(frame.kind, sent_us.index(frame.device_us))
        np.testing.assert_array_equal(frame.pixels, sent)
        if frame.infrared is not None:
            np.testing.assert_array_equal(frame.infrared, sent // 8)


def test_what_a_camera_states_of_itself(make):
    camera = make("111")
    device = opened(make, camera)
    camera.send()
    wait_for(lambda: (frame := device.wait_frame(0.2)) is not None and frame.kind == "depth")
    info, own = device.describe(), device.describe().depth
    device.close()
    assert (info.serial, info.depth_scale) == ("111", make.unit_m) and info.depth_stated
    if not make.states_geometry:
        assert info.intrinsics is None and own is None
        return
    assert own is not None and (own.width, own.height) == make.sizes["depth"]
    for lens in (info.intrinsics, own.intrinsics):
        assert lens is not None and np.allclose(lens.vector[:4], LENS[:4], rtol=1e-6)
        np.testing.assert_allclose(lens.distortion[:4], LENS[4:], atol=1e-8)
    np.testing.assert_allclose(own.T_color_depth, T_COLOR_DEPTH, atol=1e-6)


def test_exposure_settles_and_is_then_locked_and_said(make):
    """A camera keeps what an earlier session locked: it starts automatic."""
    camera = make("111")
    assert camera.automatic == (False, False)
    device = opened(make, camera)
    assert camera.automatic == (True, True) and device.camera_settings()["auto_exposure"]
    camera.send()
    wait_for(lambda: (frame := device.wait_frame(0.2)) is not None and frame.kind == "color")
    assert device.lock_exposure() and camera.automatic == (False, False)
    said = device.camera_settings()
    assert not said["auto_exposure"] and not said["auto_white_balance"] and said["exposure"] > 0
    device.close()


def test_it_starts_again_after_it_was_closed(make):
    camera = make("111")
    attached = [camera]
    driver = make.driver(attached)
    for _ in range(2):
        device = driver.open(driver.uris()[0])
        device.configure()
        device.start()
        camera.send()
        kinds = {f.kind for _ in range(2) if (f := device.wait_frame(0.5)) is not None}
        assert kinds == {"color", "depth"}
        device.close()
    uri = driver.uris()[0]
    attached.clear()
    assert driver.uris() == []
    with pytest.raises(CalibrationError, match=f"{uri}: .*(no longer attached|not found)"):
        driver.open(uri)


def test_one_camera_gives_the_pulse_and_the_others_follow(make):
    cameras, said = [make("111", cable=True), make("222", cable=True), make("333")], []
    with closing(Player(cameras)), rig_of(cameras, said, sync_leader="C2") as three:
        assert [c.sync_place for c in cameras[:2]] == ([1, 0] if make.synchronises else [None, None])
        assert three.cameras == ("C1", "C2", "C3")
    freely = ["C3"] if make.synchronises else ["C1", "C3", "C2"]  # the leader is set up last
    assert [camera for camera, text in said if "runs freely" in text] == freely


def test_a_camera_that_is_unplugged_and_comes_back(make, quick):
    cameras, said = [make("111"), make("222")], []
    attached, sending = list(cameras), list(cameras)
    driver = Drivers([make.driver(attached)])
    found = find_cameras(driver).assign({})
    with (
        closing(Player(sending)),
        SensorRig(driver, found, lambda *words: said.append(words), settle_s=0.1) as both,
    ):
        sending.remove(cameras[1])
        attached.remove(cameras[1])
        wait_for(lambda: any("unplugged" in text for camera, text in said if camera == "C2"))
        wait_for(lambda: both.live_cameras == ("C1",))
        wait_for(lambda: (alone := both.next_frame_set(time.monotonic())) is not None and alone.absent == ("C2",))
        again = make("222")
        sending.append(again)
        attached.append(again)
        wait_for(lambda: both.live_cameras == ("C1", "C2"))
        whole_set(both)
    assert ("C2", "plugged in again") in said


def test_a_frame_of_another_size_ends_the_camera_and_is_said(make, quick):
    cameras, said = [make("111"), make("222")], []
    sending = list(cameras)
    with closing(Player(sending)), rig_of(cameras, said) as both:
        sending.remove(cameras[1])
        cameras[1].send(crop=96)
        wait_for(lambda: any("was set up" in text for _, text in said))
        wait_for(lambda: both.live_cameras == ("C1",))
    width, height = make.sizes["color"]
    depth_width, depth_height = make.sizes["depth"]
    came = (f"color of {width}x{height} px was set up, {width}x{height - 96} px came",)
    came += (f"depth of {depth_width}x{depth_height} px was set up, {depth_width}x{depth_height - 96} px came",)
    assert any(one in text for one in came for _, text in said), said


@pytest.mark.parametrize("jump_s", [-0.9e3, 3.6e3])
def test_a_clock_that_jumps(make, jump_s):
    """Set anew, as by a device that restarts: frame sets go on, the jump is no loss of frames, and it is said."""
    cameras, said = [make("111"), make("222")], []
    for camera in cameras:
        camera.device_us = 10**9
    sending = list(cameras)
    with closing(Player(sending)), rig_of(cameras, said) as both:
        sending.remove(cameras[1])
        cameras[1].send(jump_us=round(jump_s * 1e6))
        sending.append(cameras[1])
        wait_for(lambda: ("C2", "its clock jumped; frames are matched by time anew") in said)
        frame_set = whole_set(both)
        assert all(abs(frame.color_s - time.monotonic()) < 2.0 for frame in frame_set.frames.values())
        assert max(both.counts()["C2"].lost.values()) < 10
