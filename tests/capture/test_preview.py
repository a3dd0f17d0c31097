"""The preview page during a capture, in a real Chromium without a window."""

from __future__ import annotations

import json
import re
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from small_recording import draw_recording
from virtual_rig import VirtualRig, build_redist, check_whole, feed, interrupted

from rgbd_calib.capture.board_watch import DetectedFrameSet, board_views
from rgbd_calib.capture.guide import Guide
from rgbd_calib.capture.preview import parse_address, state_json
from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.sensors.frames import FrameSet, RgbdFrame, SensorFrame
from rgbd_calib.types import Board
from rgbd_calib.views.coverage import nominal_intrinsics, place_view
from rgbd_calib.views.range_coverage import range_coverage


@pytest.fixture
def rig(tmp_path):
    redist = build_redist(tmp_path / "redist")
    recording = open_recording(draw_recording(tmp_path / "drawn", cameras=3, frames=5))
    rig = VirtualRig(redist, tmp_path)
    rig.settings(devices=3, data=feed(recording, tmp_path / "raw"), hold=90)
    yield rig
    rig.close()


LISTEN = """
window.heardTones = [];
window.AudioContext = class {
  constructor() { this.currentTime = 0; this.destination = null; }
  createOscillator() {
    const made = {frequency: {value: 0}, connect: next => next, start: () => heardTones.push(made.frequency.value), stop() {}};
    return made;
  }
  createGain() { return {gain: {setValueAtTime() {}, exponentialRampToValueAtTime() {}}, connect: next => next}; }
  close() {}
};
"""
"""Tones are noted instead of played: this machine has no loudspeaker."""


def ranges_now(url: str) -> list:
    """Counts by camera, as the page is told them."""
    state = json.load(urllib.request.urlopen(url + "state.json"))
    return [now["ranges"]["counts"] for now in state["cameras"].values()]


def url_of(process) -> str:
    """The address that the program names on stderr."""
    for line in process.stderr:
        found = re.search(r"preview: (http://\S+)", line)
        if found:
            return found[1]
    raise AssertionError("no address")


def test_the_page_shows_pictures_corners_coverage_and_what_is_missing(rig, browser, tmp_path):
    from selenium.webdriver.support.ui import WebDriverWait

    out = tmp_path / "out"
    options = ("--board", "9x6", "--square", "0.06", "--on-still", "--settle", "0.3", "--preview", "0")
    process = rig.start("capture", out, *options)
    url = url_of(process)
    assert url.startswith("http://127.0.0.1:")
    state = json.load(urllib.request.urlopen(url + "state.json"))
    assert list(state["cameras"]) == ["C1", "C2", "C3"]
    browser.get(url)
    wait = WebDriverWait(browser, 90)
    script = "return [...document.querySelectorAll('figure')].map(f => [f.querySelectorAll('circle').length, f.querySelectorAll('rect.filled').length, f.querySelector('img').naturalWidth])"
    wait.until(
        lambda b: (
            (f := b.execute_script(script)) and len(f) == 3 and all(c == 54 and n > 0 and w == 640 for c, n, w in f)
        )
    )
    wait.until(lambda b: "needed" in b.find_element("id", "missing").text)
    maps = "return [...document.querySelectorAll('.maps')].map(m => [...m.querySelectorAll('svg')].map(s => [...s.querySelectorAll('text')].map(t => +t.textContent)))"
    wait.until(lambda b: b.execute_script(maps) == [np.reshape(c, (len(c), -1)).tolist() for c in ranges_now(url)])
    large = (
        "return ['advice', 'next', 'count'].map(i => parseFloat(getComputedStyle(document.getElementById(i)).fontSize))"
    )
    assert (
        min(browser.execute_script(large)) >= 0.04 * 1200
    )  # of a window of 1280 px: 9 mm capitals on a 14-inch screen
    assert re.match("C[123]( and C[123])?: [a-z]", browser.find_element("id", "next").text)
    browser.execute_script(LISTEN)
    browser.find_element("id", "sound").click()
    wait.until(lambda b: b.execute_script("return heardTones")[:2] == [880, 880])  # the click's own, and a frame set's
    rig.wait_for_frame_sets(out, 2)
    wait.until(lambda b: int(b.find_element("id", "count").text.split()[0]) >= 2)
    assert "C1-C2" in browser.find_element("id", "common").text
    rig.command("unplug 2")
    wait.until(lambda b: "dead" in b.find_element("id", "camera-C3").get_attribute("class"))
    wait.until(lambda b: "C3: unplugged" in b.find_element("id", "events").text)
    ended = interrupted(process)
    assert ended.status == 0
    wait.until(lambda b: "the recording has ended" in b.find_element("id", "advice").text)
    complaints = [
        m["message"] for m in browser.get_log("browser") if m["level"] == "SEVERE" and "state.json" not in m["message"]
    ]
    assert not [m for m in complaints if ".jpg" not in m]
    check_whole(out)


def test_the_page_is_told_the_numbers_of_a_report():
    """Views as a capture adds them, against the report's section of the same views."""
    rng, board = np.random.default_rng(3), Board(9, 6, 0.06)
    lens = nominal_intrinsics((640, 480))
    guide, views = Guide(["C1", "C2"], board), []
    for n in range(12):
        pose = se3.make(so3.exp(rng.normal(0, 0.4, 3)), [*rng.uniform(-0.4, 0.1, 2), rng.uniform(1.0, 3.0)])
        px = lens.project(se3.transform(pose, board.corners_m()))
        inside = np.flatnonzero(np.all((px >= 0) & (px < (640, 480)), axis=1))
        camera = ("C1", "C2")[n % 2]
        guide.recorded(f"{n}", {camera: (inside, px[inside])}, {camera: (640, 480)})
        views += board_views(f"{n}", {camera: (inside, px[inside])})
    told = state_json(guide.state())
    placed = [place_view(v, board, (640, 480)) for v in views]
    for camera, own in range_coverage(placed, ["C1", "C2"]).items():
        ranges = told["cameras"][camera]["ranges"]
        assert ranges == {"labels": own.labels, "counts": own.counts.tolist(), "empty": own.empty}
        assert len(own.counts) == 3 and own.counts.sum() > 12
    assert told["missing"][0].startswith("C1 and C2 share no view") and told["next"].startswith("C1 and C2: ")
    plain = state_json(Guide(["C1"], None).state())
    assert plain["look"] == 0 and Guide(["C1"], None).picture("C1", 0) is None
    assert plain["cameras"]["C1"]["ranges"] is None and plain["next"] == ""


def test_corners_and_picture_are_of_one_look():
    guide = Guide(["C1"], Board(9, 6, 0.06))
    for n in range(1, 6):
        color = SensorFrame("color", np.full((1, 1, 3), n, np.uint8), 0, n, 0.0)
        pair = RgbdFrame("C1", color, color, 0.0, 0.0)
        guide.looked(
            DetectedFrameSet(FrameSet({"C1": pair}, 0.0), {"C1": (np.arange(1), np.full((1, 2), float(n)))}), ["C1"]
        )
        state = guide.state()
        assert state.look == n and state.cameras["C1"].corners_px[0, 0] == n
        for look in range(max(1, n - 2), n + 1):
            assert guide.picture("C1", look)[0, 0, 0] == look
    assert guide.picture("C1", 1)[0, 0, 0] == 3  # the oldest that is kept


def test_a_port_that_is_taken(rig, tmp_path):
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ended = rig.run("capture", tmp_path / "out", "--count", "1", "--settle", "0.1", "--preview", port)
    assert ended.status == 2 and f"--preview 127.0.0.1:{port}: cannot listen there" in ended.stderr


@pytest.mark.parametrize(
    ("text", "address"), [("8765", ("127.0.0.1", 8765)), ("0.0.0.0:80", ("0.0.0.0", 80)), ("[::1]:9", ("::1", 9))]
)
def test_addresses(text, address):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "x", "1:x", "70000"])
def test_addresses_that_are_wrong(text):
    with pytest.raises(ConfigError, match="--preview"):
        parse_address(text)


def test_the_page_needs_nothing_from_elsewhere():
    page = (Path(__file__).parents[2] / "rgbd_calib/capture/preview.html").read_text()
    assert set(re.findall(r"https?://[^\s\"'`]+", page)) == {"http://www.w3.org/2000/svg"}
