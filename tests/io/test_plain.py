"""JSON that every program reads, and that no page can be broken with."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_recording import FOCAL_PX, HEIGHT, WIDTH, draw_recording

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.plain import plain, to_json, to_json_in_html
from rgbd_calib.io.rig import write_rig
from rgbd_calib.quality import Quality

HOSTILE = "<!--<script>"


def strict(text: str):
    """As other programs read JSON: no NaN, no Infinity."""
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_numbers_that_are_not_finite_become_null():
    value = {
        "a": math.nan,
        "b": [np.float32("inf"), np.array([1.5, -np.inf])],
        "c": np.int64(3),
        "d": Path("x"),
        "e": True,
    }
    assert strict(to_json(value)) == {"a": None, "b": [None, [1.5, None]], "c": 3, "d": "x", "e": True}
    assert math.isnan(plain(value)["a"])  # YAML has a NaN


def test_text_for_a_script_element():
    text = to_json_in_html({HOSTILE: "</script> & \u2028"})
    assert not re.search(r"[<>&\u2028]", text) and json.loads(text) == {HOSTILE: "</script> & \u2028"}


def test_a_rig_with_nan_is_exported(run, tiny, tmp_path):
    bad = replace(tiny.rig, quality=Quality(other={"rms_px": math.nan}))
    write_rig(tmp_path / "rig.yaml", bad)
    assert run("export", tmp_path / "rig.yaml", "--to", "json", tmp_path / "rig.json").status == 0
    assert strict((tmp_path / "rig.json").read_text())["quality"] == {"rms_px": None}


def test_a_report_of_hostile_names_is_drawn(run, tmp_path, browser):
    from selenium.webdriver.support.ui import WebDriverWait

    from rgbd_calib.io.rig import write_intrinsics

    folder = tmp_path / HOSTILE
    draw_recording(folder, cameras=2, frames=5)
    (folder / "C1").rename(folder / f"{HOSTILE}1")
    text = (folder / "dataset.yaml").read_text().replace("C1:", f'"{HOSTILE}1":')
    (folder / "dataset.yaml").write_text(text)
    lens = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    write_intrinsics(tmp_path / "i.yaml", dict.fromkeys((f"{HOSTILE}1", "C2"), lens), {}, {}, {})
    args = ("--intrinsics", tmp_path / "i.yaml", "-o", tmp_path / "rig.yaml", "--report", tmp_path / "report")
    told = run("calibrate", folder, *args)
    assert told.status == 0, told.stderr
    browser.get((tmp_path / "report" / "index.html").as_uri())
    WebDriverWait(browser, 120).until(lambda b: b.execute_script("return document.body.dataset.drawn") == "yes")
    assert browser.find_element("css selector", "#verdict .headline").is_displayed()
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
