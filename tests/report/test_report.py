"""The report: what it says, that it needs nothing but itself, and how it looks in a real Chromium."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from qualities import expected, grid_of, measured, quality
from small_recording import FOCAL_PX, HEIGHT, WIDTH, draw_recording

from rgbd_calib.cli.main import cli
from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.residuals import Residuals, read_residuals, residuals_path, write_residuals
from rgbd_calib.io.rig import read_boards, read_rig, write_intrinsics
from rgbd_calib.quality import Counted, PairViews, Quality
from rgbd_calib.report import numbers
from rgbd_calib.trust.verdict import VerdictLimits, judge, limits_in
from rgbd_calib.types import Board

CAMERAS = ("C1", "C2", "C3")
FRAMES = 6
LIMIT_BYTES = 8_000_000
LIMITS = VerdictLimits()
GOOD_MM, FAIR_MM, NOISE_FACTOR = LIMITS.good_mm(2.0), LIMITS.fair_mm(2.0), LIMITS.noise_factor


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recording, rig.yaml, rig.residuals.csv and report/index.html."""
    folder = tmp_path_factory.mktemp("report")
    draw_recording(folder / "recording", cameras=len(CAMERAS), frames=FRAMES)
    lens = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    write_intrinsics(folder / "intrinsics.yaml", dict.fromkeys(CAMERAS, lens), {}, {}, {})
    options = ["--intrinsics", folder / "intrinsics.yaml", "-o", folder / "rig.yaml", "--report", folder / "report"]
    cli.main(["calibrate", *map(str, [folder / "recording", *options])], standalone_mode=False)
    return folder


@pytest.fixture(scope="module")
def page(calibrated: Path) -> str:
    return (calibrated / "report" / "index.html").read_text(encoding="utf-8")


def figures_of(page: str) -> dict:
    found = re.search(r'<script id="figures" type="application/json">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def test_the_report_opens_in_a_browser_at_both_widths(calibrated, browser):
    from selenium.webdriver.support.ui import WebDriverWait

    def show(width: int, height: int, mobile: bool) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        browser.get((calibrated / "report" / "index.html").as_uri())
        WebDriverWait(browser, 120).until(lambda b: b.execute_script("return document.body.dataset.drawn") == "yes")

    show(1280, 1000, False)
    assert browser.find_element("css selector", "#verdict .headline").is_displayed()
    assert browser.execute_script("return document.querySelectorAll('.plot').length") >= 20
    assert (
        browser.execute_script(
            "return [...document.querySelectorAll('.plot')].filter(p => !p.querySelector('svg')).length"
        )
        == 0
    )
    scene = browser.find_element("id", "fig_scene")
    assert browser.execute_script("return !!document.querySelector('#fig_scene canvas').getContext('webgl')")
    browser.execute_script("arguments[0].scrollIntoView({behavior: 'instant'})", scene)
    # blank: 1 colour, an error message: some tens of greys
    WebDriverWait(browser, 120).until(lambda b: colours(picture_of(b, scene)) > 100)
    loaded = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in loaded if not name.startswith("data:")] == []
    show(390, 844, True)
    wide = browser.execute_script("return document.documentElement.scrollWidth")
    assert wide <= 390
    small = browser.execute_script(
        "return [...document.querySelectorAll('p, li, td, th, figcaption, dd')]"
        ".filter(e => e.offsetParent && parseFloat(getComputedStyle(e).fontSize) < 13).length"
    )
    assert small == 0
    assert browser.find_element("css selector", "#verdict .headline").is_displayed()
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def picture_of(browser, element) -> np.ndarray:
    """What the window shows of an element, (height, width, 3). Through the DevTools protocol: chromedriver's own
    screenshot gives up after ten seconds, too few for 3D drawn in software on a busy machine."""
    box = browser.execute_script(
        "const b = arguments[0].getBoundingClientRect(); return [b.x, b.y, b.right, b.bottom]", element
    )
    png = base64.b64decode(browser.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})["data"])
    left, top, right, bottom = (max(round(v), 0) for v in box)
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[top:bottom, left:right]


def colours(picture: np.ndarray) -> int:
    return len(np.unique(picture.reshape(-1, 3), axis=0))


def test_the_page_is_one_small_file_with_every_section(page):
    assert len(page.encode()) < LIMIT_BYTES
    head = page[: page.index("<script>")]
    assert not re.search(r"""(src|href)=["'](https?:)?//""", head)
    for section in (
        "verdict",
        "images",
        "rig",
        "volume",
        "coverage",
        "cameras",
        "board",
        "residuals",
        "frames",
        "origin",
    ):
        assert f'<section id="{section}"' in head
    assert re.search(r'class="headline">(Good|Fair|Poor)', head)
    assert head.count('src="data:image/jpeg') == 6  # before and after, from three sides
    assert 'class="missing"' not in head
    assert "rgbd-calib 0" in head and "opencv" in head and "calibrate" in head


def test_figures_are_what_plotly_knows(page):
    import plotly.graph_objects as go

    drawn = figures_of(page)
    assert {"fig_scene", "fig_pairs", "fig_views_px", "fig_views_depth", "fig_rounds_weight", "fig_bias_0"} <= set(
        drawn
    )
    for name, figure in drawn.items():
        go.Figure(figure)  # raises for a property or value that does not exist
        assert f'id="{name}"' in page, f"{name} is drawn nowhere"
    grid = drawn["fig_scene"]["data"][0]
    assert len(grid["x"]) == len(grid["text"]) > 20


def test_residuals_beside_the_rig_are_those_of_its_boards(calibrated):
    """Boards and cameras of the file, projected, give the residuals of the file."""
    from rgbd_calib.geometry import camera, se3

    rig, boards = read_rig(calibrated / "rig.yaml"), read_boards(calibrated / "rig.yaml")
    left = read_residuals(residuals_path(calibrated / "rig.yaml"))
    board = rig.quality.board
    assert left.used_pixel.sum() > 0.9 * len(left.camera) > 0
    for name, own in rig.cameras.items():
        for frame, T in boards.items():
            rows = left.select((left.camera == name) & (left.frame == frame))
            if len(rows.camera):
                p = se3.transform(se3.inverse(own.T_world_color) @ T, board.corners_m()[rows.feature.astype(int)])
                expected = rows.pixels_px - camera.project(own.intrinsics.vector, p)
                # written to a ten-thousandth, corners to a micrometre
                np.testing.assert_allclose(rows.residual_px, expected, atol=2e-3)
    assert numbers.rms(left.residual_px) < 0.3


def test_report_says_what_is_missing_and_how_to_get_it(calibrated, tmp_path, run):
    shutil.copy(calibrated / "rig.yaml", tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text().replace(str(calibrated / "recording"), "/gone")
    (tmp_path / "rig.yaml").write_text(text)
    out = run("report", tmp_path / "rig.yaml", "-o", tmp_path / "r")
    assert out.status == 0, out.stderr
    page = (tmp_path / "r" / "index.html").read_text(encoding="utf-8")
    assert "rig.residuals.csv is not beside rig.yaml" in page
    assert "<code>rgbd-calib calibrate</code> writes it" in page
    assert "--recording DIR" in page
    assert "fig_scene" in figures_of(page)
    assert run("report", tmp_path / "rig.yaml", "-o", tmp_path / "r").status == 2
    shutil.copy(residuals_path(calibrated / "rig.yaml"), tmp_path)
    again = (
        "report",
        tmp_path / "rig.yaml",
        "--recording",
        calibrated / "recording",
        "-o",
        tmp_path / "r",
        "--overwrite",
    )
    assert run(*again).status == 0
    page = (tmp_path / "r" / "index.html").read_text(encoding="utf-8")
    assert 'class="missing"' not in page[: page.index("<script>")]


def test_calibrate_does_not_write_over_residuals_or_a_report(calibrated, tmp_path, run):
    (tmp_path / "rig.residuals.csv").write_text("mine")
    out = run("calibrate", calibrated / "recording", "-o", tmp_path / "rig.yaml")
    assert out.status == 2 and "rig.residuals.csv" in out.stderr
    assert (tmp_path / "rig.residuals.csv").read_text() == "mine"
    out = run("calibrate", calibrated / "recording", "-o", tmp_path / "b.yaml", "--report", calibrated / "report")
    assert out.status == 2 and "index.html" in out.stderr


def test_report_of_a_rig_that_says_nothing_of_itself(tiny, tmp_path, run):
    """Made by another program: the rig is drawn, and every empty section says so."""
    out = run("report", tiny.rig_path, "--recording", tiny.recording, "-o", tmp_path)
    assert out.status == 0, out.stderr
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert 'class="headline">Unknown.' in page
    assert set(figures_of(page)) >= {"fig_scene", "fig_bias_0"}


@pytest.mark.parametrize(
    ("expected", "measured", "level"),
    [
        (GOOD_MM, GOOD_MM * NOISE_FACTOR, "good"),
        (GOOD_MM + 0.1, 1.0, "fair"),
        (1.0, GOOD_MM * NOISE_FACTOR + 0.1, "fair"),
        (FAIR_MM + 0.1, 1.0, "poor"),
        (1.0, FAIR_MM * NOISE_FACTOR + 0.1, "poor"),
    ],
)
def test_the_worse_of_expected_and_measured_decides(expected, measured, level):
    verdict = judge(quality(expected, measured), ())
    assert verdict.level == level
    assert verdict.headline.startswith(level.capitalize())
    assert f"{expected:.1f} mm" in verdict.headline
    assert any("C1 - C2" in step for step in verdict.next_steps) == (level != "good")


@pytest.mark.parametrize(("distance_m", "level"), [(0.5, "fair"), (1.0, "good"), (4.0, "good")])
def test_limits_are_shares_of_the_working_distance_and_are_said(distance_m, level):
    verdict = judge(replace(quality(1.5, None), working_distance_m=distance_m), ())
    assert verdict.level == level
    assert any(f"working distance of {distance_m:.1f} m: good up to" in reason for reason in verdict.reasons)
    strict = limits_in({"config": {"verdict": {"good_share": 1e-5, "fair_share": 2e-5, "other": "x"}}})
    assert judge(quality(1.5, None), (), None, strict).level == "poor"


def test_colour_alone_is_judged_by_pixels_at_the_board():
    near = measured(median_px=0.2, median_board_mm=0.4)
    verdict = judge(Quality(alignment_on_recording=near, working_distance_m=2.0), ())
    assert verdict.level == "good" and "0.40 mm apart at the board" in verdict.headline
    assert any("0.20 px off" in reason for reason in verdict.reasons)
    far = measured(median_px=9.0, median_board_mm=40.0)
    assert judge(Quality(alignment_on_recording=far), ()).level == "poor"


def test_a_camera_on_a_thread_is_fair_at_best():
    pairs = (PairViews(("C1", "C2"), 9, 9), PairViews(("C2", "C3"), 2, 2))
    verdict = judge(replace(quality(None, 1.0), pairs=pairs), ("C3: 2 views, 8 needed: show it more poses",))
    assert verdict.level == "fair"
    assert any("C3 is tied to the rig by 2" in reason for reason in verdict.reasons)
    assert any("C3: 2 views" in step for step in verdict.next_steps)


@pytest.mark.parametrize(("side_m", "level"), [(0.3, "fair"), (1.0, "good")])
def test_boards_at_one_place_say_nothing_of_others(side_m, level):
    corners = side_m * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) + [0, 0, 2]
    own = replace(quality(1.5, None), board=Board(9, 6, 0.06))  # 0.57 m across
    own = replace(own, expected_alignment=expected(1.5, grid=grid_of(corners, np.ones(8))))
    verdict = judge(own, ())
    assert verdict.level == level
    said = [reason for reason in verdict.reasons if "at one place" in reason]
    assert bool(said) == (level == "fair")
    assert not said or f"{side_m} x {side_m} x {side_m} m" in said[0]


def some_residuals() -> Residuals:
    nan = np.nan
    return Residuals(
        np.array(["C1", "C1", "C2"]),
        np.array(["000000", "C1 alone: 000001", "000000"]),
        np.array(["0", "7", "53"]),
        np.array([[10.5, 20.25], [600.0, 400.0], [1.0, 2.0]]),
        np.array([[0.25, -0.5], [0.0, 1.0], [nan, nan]]),
        np.array([1.5, nan, 2.0]),
        np.array([0.002, nan, -0.001]),
        np.array([True, True, False]),
        np.array([True, False, False]),
    )


def test_residuals_survive_the_file(tmp_path):
    wrote = some_residuals()
    write_residuals(tmp_path / "a.residuals.csv", wrote)
    got = read_residuals(tmp_path / "a.residuals.csv")
    for name in wrote.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(got, name), getattr(wrote, name))
    (tmp_path / "a.residuals.csv").write_text((tmp_path / "a.residuals.csv").read_text().replace("both", "perhaps"))
    with pytest.raises(ConfigError, match=r"line 2: used: 'perhaps' seen"):
        read_residuals(tmp_path / "a.residuals.csv")


def test_numbers_of_residuals_by_hand():
    left = some_residuals()
    views = {(v.camera, v.frame): v for v in numbers.by_view(left)}
    assert views["C1", "000000"].rms_px == pytest.approx(np.sqrt((0.25**2 + 0.5**2) / 2))
    assert views["C1", "000000"].rms_depth_m == pytest.approx(0.002)
    assert not views["C2", "000000"].used_pixel and not views["C1", "C1 alone: 000001"].used_depth
    assert [v.frame for v in numbers.by_view(left)][-1] == "C1 alone: 000001"  # after the rig's own frames
    row = numbers.camera_table(left, ["C1", "C2"])
    assert (row[0]["views"], row[0]["corners"], row[0]["depths"]) == (2, 2, 1)
    assert (row[1]["corners_left_out"], row[1]["depths_left_out"]) == (1, 1)


def test_cells_of_the_image_hold_their_mean():
    n = 5
    u = np.tile([[41.0, 41.0]], (n, 1))  # cell (0, 0) of 80 x 80 px
    r = np.column_stack([np.full(n, 0.3), np.linspace(-0.1, 0.1, n)])
    names = np.array(["C1"] * n)
    left = Residuals(names, names, names, u, r, np.full(n, 2.0), np.full(n, 1e-3), np.ones(n, bool), np.ones(n, bool))
    cells = numbers.over_image(left, 640, 480)
    np.testing.assert_allclose(cells.mean_px[0, 0], [0.3, 0.0], atol=1e-12)
    assert cells.mean_depth_m[0, 0] == pytest.approx(1e-3)
    assert np.isnan(cells.rms_px[3, 3]) and cells.count.sum() == n


def test_poses_alone_are_called_a_lower_bound_and_no_covariance_is_fair_at_best():
    verdict = judge(quality(0.1, 4.0, Counted.POSES), ())
    assert verdict.level == "good"
    assert "4.0 mm" in verdict.headline and "0.10 mm" not in verdict.headline
    assert any("the real error is larger" in reason for reason in verdict.reasons)
    assert judge(quality(None, 4.0), ()).level == "fair"
    assert judge(Quality(), ()).level == "unknown"
