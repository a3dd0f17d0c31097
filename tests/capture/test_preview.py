"""The preview page during a capture, in a real Chromium without a window."""

from __future__ import annotations

import json
import re
import signal
import urllib.request
from pathlib import Path

import pytest
from small_recording import draw_recording
from virtual_rig import VirtualRig, build_redist, check_whole, feed, finish

from rgbd_calib.capture.preview import parse_address
from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import open_recording


@pytest.fixture
def rig(tmp_path):
    redist = build_redist(tmp_path / "redist")
    recording = open_recording(draw_recording(tmp_path / "drawn", cameras=3, frames=5))
    rig = VirtualRig(redist, tmp_path)
    rig.settings(devices=3, data=feed(recording, tmp_path / "raw"), hold=90)
    yield rig
    rig.close()


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
    rig.wait_for_frame_sets(out, 2)
    wait.until(lambda b: int(b.find_element("id", "count").text.split()[0]) >= 2)
    assert "C1-C2" in browser.find_element("id", "common").text
    rig.command("unplug 2")
    wait.until(lambda b: "dead" in b.find_element("id", "camera-C3").get_attribute("class"))
    wait.until(lambda b: "C3: unplugged" in b.find_element("id", "events").text)
    process.send_signal(signal.SIGINT)
    ended = finish(process)
    assert ended.status == 0
    wait.until(lambda b: "the recording has ended" in b.find_element("id", "advice").text)
    complaints = [
        m["message"] for m in browser.get_log("browser") if m["level"] == "SEVERE" and "state.json" not in m["message"]
    ]
    assert not [m for m in complaints if ".jpg" not in m]
    check_whole(out)


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
