"""The pure parts of capturing: pairing, clocks, frame sets, stillness, identities, USB places, the median of depth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rgbd_calib.capture.stillness import StillBoard, StillParams
from rgbd_calib.errors import ConfigError
from rgbd_calib.sensors.clock import DeviceClock
from rgbd_calib.sensors.depth_average import mean_depth
from rgbd_calib.sensors.frame_sets import tightest_frame_set
from rgbd_calib.sensors.frames import PERIOD_S, RgbdFrame, SensorFrame
from rgbd_calib.sensors.identity import Identity, assign_cameras, parse_devices
from rgbd_calib.sensors.pairing import ColorDepthPairer
from rgbd_calib.sensors.usb import UsbPlace, crowded_controllers, forbidden_node, usb_place

PERIOD_US = 33_333
BLANK = np.zeros((1, 1), np.uint16)


def frame(kind, device_us, index=0):
    return SensorFrame(kind, BLANK, device_us, index, device_us * 1e-6)


@given(
    lag_us=st.integers(-15_000, 15_000),
    lost=st.sets(st.tuples(st.sampled_from(["color", "depth"]), st.integers(1, 28))),
    order=st.randoms(use_true_random=False),
)
def test_only_one_exposure_makes_a_pair(lag_us, lost, order):
    """Up to half a period of lag, frames lost at random: no wrong pair, every possible pair, losses counted."""
    frames = [
        frame(kind, 100_000 + n * PERIOD_US + (lag_us if kind == "color" else 0), n)
        for n in range(30)
        for kind in ("color", "depth")
        if (kind, n) not in lost
    ]
    frames.sort(key=lambda f: (f.device_us, order.random()))
    pairer = ColorDepthPairer()
    pairs = [pair for f in frames if (pair := pairer.add(f))]
    assert all(color.index == depth.index for color, depth in pairs)
    assert len(pairs) == sum(("color", n) not in lost and ("depth", n) not in lost for n in range(30))
    assert pairer.lost == {kind: sum(k == kind for k, _ in lost) for kind in ("color", "depth")}


def test_the_pairer_forgets_what_waits_too_long():
    pairer = ColorDepthPairer()
    for n in range(100):
        assert pairer.add(frame("depth", n * PERIOD_US)) is None
    assert pairer.unpaired["depth"] == 92


@pytest.mark.parametrize("drift_ppm", [-100, 0, 100])
def test_the_clock_follows_a_drifting_device(drift_ppm):
    """Delays of 1 ms and more, now and then 50 ms: the lower envelope knows the time to the drift over its window."""
    rng = np.random.default_rng(1)
    clock = DeviceClock()
    for n in range(1800):
        true_s = 5.0 + n * PERIOD_S
        device_us = round(n * PERIOD_S * (1 + drift_ppm * 1e-6) * 1e6)
        clock.observe(device_us, true_s + 0.001 + rng.exponential(0.003))
        if n > 100:
            # window of 10 s at 100 ppm is 1 ms; of 15 frames in half a second some come within 1 ms of the minimum
            assert -0.0015 < clock.host_s(device_us) - true_s < 0.0035


def rgbd(camera, time_s):
    return RgbdFrame(camera, frame("color", 0), frame("depth", 0), time_s, time_s)


@given(phases=st.lists(st.floats(0, PERIOD_S, exclude_max=True), min_size=1, max_size=6), after_s=st.floats(1, 2))
def test_the_tightest_set_spans_less_than_a_period(phases, after_s):
    n = len(phases)
    frames = {f"C{i}": [rgbd(f"C{i}", p + k * PERIOD_S) for k in range(100)] for i, p in enumerate(phases)}
    found = tightest_frame_set(frames, after_s)
    assert found is not None and found.frames.keys() == frames.keys()
    times_s = [f.color_s for f in found.frames.values()]
    assert min(times_s) >= after_s and found.spread_s == pytest.approx(max(times_s) - min(times_s))
    assert found.spread_s <= PERIOD_S * (1 - 1 / n) + 1e-9  # the largest gap is at least a period / n


def test_a_frame_set_waits_until_all_cameras_are_there():
    frames = {"C1": [rgbd("C1", k * PERIOD_S) for k in range(10)], "C2": [rgbd("C2", 0.0)]}
    assert tightest_frame_set(frames, 0.05) is None
    assert tightest_frame_set({}, 0.0) is None


def test_mean_depth_ignores_holes_and_what_is_far_from_most():
    images = [
        np.array([[0, 2000, 0, 1010]], np.uint16),
        np.array([[0, 2003, 0, 1006]], np.uint16),
        np.array([[4, 3500, 0, 0]], np.uint16),
    ]
    np.testing.assert_array_equal(mean_depth(images), [[0, 2002, 0, 1008]])
    assert mean_depth(images[:1]) is images[0]


@given(st.lists(st.integers(1, 10_000), min_size=2, max_size=9))
def test_mean_depth_lies_among_what_was_measured(values):
    out = mean_depth([np.array([[v]], np.uint16) for v in values])
    assert min(values) <= out[0, 0] <= max(values)


def test_mean_depth_lies_between_the_steps_of_a_sensor():
    """Steps of 12 mm and noise of 5: a single reading errs by 6 mm, the mean of 30 by 1.1."""
    rng = np.random.default_rng(0)
    true_mm = np.linspace(2000, 2024, 500)
    readings = [np.rint((true_mm + rng.normal(0, 5, 500)) / 12)[None] * 12 for _ in range(30)]
    error = mean_depth([r.astype(np.uint16) for r in readings])[0] - true_mm
    assert np.sqrt(np.mean(error**2)) < 1.3 and abs(error.mean()) < 0.3


def corners(shift_px=0.0):
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), -1).reshape(-1, 2) * 20
    return np.arange(54), grid + shift_px


class TestStillBoard:
    params = StillParams(still_s=0.5, min_looks=3)

    def test_fires_once_for_a_pose_and_again_after_moving(self):
        still = StillBoard(self.params)
        assert [still.look(t, {"C1": corners()}) for t in (0.0, 0.3, 0.6)] == [False, False, True]
        still.taken()
        assert not still.look(0.9, {"C1": corners()}) and still.waits_for_new_pose
        assert not still.look(1.2, {"C1": corners(30)})
        assert [still.look(t, {"C1": corners(30)}) for t in (1.5, 1.8)] == [False, True]

    def test_a_moving_or_hidden_board_starts_anew(self):
        still = StillBoard(self.params)
        still.look(0.0, {"C1": corners()})
        still.look(0.3, {"C1": corners(3)})
        assert not still.look(0.6, {"C1": corners(3)})
        assert not still.look(0.9, {}) and not still.is_still

    def test_a_half_turn_of_the_order_is_no_motion(self):
        still = StillBoard(self.params)
        ids, px = corners()
        assert [still.look(t, {"C1": (ids, px[:: 1 if t else -1])}) for t in (0.0, 0.3, 0.6)][-1]

    def test_a_camera_that_sees_it_now_makes_a_new_pose(self):
        still = StillBoard(self.params)
        for t in (0.0, 0.3, 0.6):
            still.look(t, {"C1": corners()})
        still.taken()
        looks = [still.look(t, {"C1": corners(), "C2": corners()}) for t in (0.9, 1.2, 1.5)]
        assert not any(looks)  # C2 must see it through the whole time
        for t in (1.8, 2.1):
            still.look(t, {"C1": corners(5), "C2": corners()})
        assert still.look(2.4, {"C1": corners(5), "C2": corners()})


A, B, NO_SERIAL = Identity("u/1", "S1", "1-1"), Identity("u/2", "S2", "1-2"), Identity("u/3", None, "2-4")


def test_cameras_are_named_by_serial_then_port():
    assert assign_cameras([NO_SERIAL, B, A], {}) == {"C1": A, "C2": B, "C3": NO_SERIAL}


def test_a_recording_that_goes_on_keeps_its_names():
    assert assign_cameras([NO_SERIAL, B, A], {}, {"C1": "S2", "C7": "2-4"}) == {"C1": B, "C2": A, "C7": NO_SERIAL}


def test_wanted_cameras_by_serial_port_or_uri():
    assert assign_cameras([A, B, NO_SERIAL], {"left": "2-4", "right": "u/1"}) == {"left": NO_SERIAL, "right": A}
    with pytest.raises(ConfigError, match="left: no device S9 is attached; attached: S1 at 1-1"):
        assign_cameras([A], {"left": "S9"})


@pytest.mark.parametrize("texts", [["C1"], ["=S"], ["C1="], ["a/b=S"], ["C1=S", "C1=T"], ["C1=S", "C2=S"]])
def test_device_options_that_are_wrong(texts):
    with pytest.raises(ConfigError, match="--device"):
        parse_devices(texts)


def test_a_device_node_without_permission(tmp_path, monkeypatch):
    node = tmp_path / "001" / "006"
    node.parent.mkdir()
    node.write_text("")
    assert forbidden_node("1d27/0601@1/6", tmp_path) is None and forbidden_node("virtual://0", tmp_path) is None
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert forbidden_node("1d27/0601@1/6", tmp_path) == node


def test_usb_places_come_from_sysfs(tmp_path):
    devices, pci = tmp_path / "devices", tmp_path / "pci" / "0000:00:14.0"
    (pci / "usb1").mkdir(parents=True)
    devices.mkdir()
    (devices / "usb1").symlink_to(pci / "usb1")
    for name, bus, number in (("1-1.2", 1, 6), ("1-3", 1, 7)):
        (devices / name).mkdir()
        (devices / name / "busnum").write_text(f"{bus}\n")
        (devices / name / "devnum").write_text(f"{number}\n")
    place = usb_place("1d27/0601@1/6", devices)
    assert place == UsbPlace("1-1.2", "0000:00:14.0")
    assert usb_place("1d27/0601@2/6", devices) is None and usb_place("virtual://0", devices) is None
    both = {"S1": place, "S2": usb_place("1d27/0601@1/7", devices), "S3": None}
    assert crowded_controllers(both) == {"0000:00:14.0": ["S1", "S2"]}
