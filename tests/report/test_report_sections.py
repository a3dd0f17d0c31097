"""What the report's sections say: each number on input whose right value is known by hand."""

from __future__ import annotations

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from qualities import expected, grid_of

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline.view_pictures import view_pictures
from rgbd_calib.quality import PairViews, Quality
from rgbd_calib.report import coverage_map, dependence, error_map, frames, numbers
from rgbd_calib.report import view_pictures as pictures
from rgbd_calib.report.numbers import Sensor
from rgbd_calib.report.page import CloudComparison, Contents, render
from rgbd_calib.report.scene import MovedCloud, scene
from rgbd_calib.types import Board, Rig, RigCamera
from rgbd_calib.views.coverage import ViewCoverage
from rgbd_calib.views.range_coverage import range_coverage

LENS = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)


BOARD = Board(9, 6, 0.06)


NAN = np.nan


def residuals(rows: list[tuple]) -> Residuals:
    """Of (camera, frame, (u, v), (ru, rv), depth_m, residual_depth_m, used_pixel, used_depth)."""
    camera, frame, at, d, depth, d_depth, pixel, used_depth = zip(*rows, strict=True)
    return Residuals(
        np.array(camera),
        np.array(frame),
        np.array([str(i) for i in range(len(rows))]),
        np.array(at, float),
        np.array(d, float),
        np.array(depth, float),
        np.array(d_depth, float),
        np.array(pixel, bool),
        np.array(used_depth, bool),
    )


def quality_of(error: np.ndarray, order: np.ndarray | slice = slice(None)) -> Quality:
    """Error on a grid x 0, 1; y 0, 1, 2; z 1, 2, 3, 4, where it is finite."""
    at = [[i, j, k] for i, j, k in np.argwhere(np.isfinite(error))]
    points = np.array([[float(i), float(j), float(k + 1)] for i, j, k in at])
    errors = np.array([error[tuple(a)] for a in at])
    return Quality(expected_alignment=expected(1.0, grid=grid_of(points[order], errors[order])))


def test_the_error_map_has_each_error_at_its_place():
    error = np.arange(24.0).reshape(2, 3, 4) / 4
    error[1, 2, 3] = NAN
    order = np.random.default_rng(0).permutation(23)
    grid = error_map.grid_of(quality_of(error, order))
    np.testing.assert_array_equal(grid.error_mm, error)
    np.testing.assert_array_equal(grid.z_m, [1, 2, 3, 4])
    # of 23 values 0, 0.25, ..., 5.5: 3 are at most 0.5, 5 at most 1, 9 at most 2, 21 at most 5
    assert error_map.shares(grid) == [(0.5, 3 / 23), (1.0, 5 / 23), (2.0, 9 / 23), (5.0, 21 / 23), (10.0, 1.0)]
    last = error_map.by_distance(grid)[-1]  # 0.75, 1.75, 2.75, 3.75, 4.75
    assert last == {"z_m": 4.0, "mean_mm": 2.75, "best_mm": 0.75, "worst_mm": 4.75, "below_1": 0.2}
    slices = error_map.across(grid)
    assert [z for z, _ in slices] == [2.0, 3.0]  # spread, and none of them twice
    assert slices[0][1]["data"][0]["z"] == error[:, :, 1].T.tolist()


def test_a_few_enormous_errors_do_not_make_the_rest_look_good():
    errors = np.concatenate([np.full(80, 10.0), np.full(20, 1e6)])
    assert error_map.top_mm(errors) == 40.0
    assert error_map.top_mm(np.linspace(0, 1, 101)) == pytest.approx(0.98)


def test_no_map_is_made_of_points_that_are_no_grid():
    points = np.random.default_rng(0).random((100, 3))
    odd = Quality(expected_alignment=expected(1.0, grid=grid_of(points, np.ones(100))))
    assert error_map.grid_of(odd) is None and error_map.grid_of(Quality()) is None


def test_a_trend_is_the_mean_of_views_and_their_scatter():
    """Views 0 to 5 at x = 0, views 6 to 11 at x = 1: two bins, of the views' means whatever their number of corners."""
    view = np.repeat(np.arange(12), [1, 2, 3, 4, 5, 6, 1, 2, 3, 4, 5, 6])
    means = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0])
    found = dependence.trend((view >= 6).astype(float), means[view], view)
    np.testing.assert_allclose(found.at, [0, 1])
    np.testing.assert_allclose(found.mean, [2.5, 10.0])
    np.testing.assert_allclose(found.error, [np.std(range(6), ddof=1) / np.sqrt(6), 0.0], atol=1e-12)


@pytest.mark.parametrize(("views", "bins"), [(5, 0), (6, 2), (10, 3), (24, 8), (100, 8)])
def test_a_trend_has_as_many_bins_as_hold_three_views(views, bins):
    x = np.repeat(np.arange(float(views)), 4)
    found = dependence.trend(x, 2 * x, x)
    assert len(found.at) == bins
    np.testing.assert_allclose(found.mean, 2 * found.at)
    assert len(dependence.trend(np.full(9, 3.0), x[:9], x[:9]).at) == 0


def test_what_residuals_are_set_against_is_where_they_were_measured():
    rows = residuals([("C1", f, (319.5 + 30, 239.5 - 40), (0.3, -0.4), 2.0, 0.001, True, True) for f in ("b", "a")])
    sensor = Sensor("C1", "C1", LENS, np.eye(4))
    placed = {("C1", "a"): ViewCoverage("C1", "a", np.zeros((3, 4), int), 1.5, np.pi / 6)}
    found = dependence.against(rows, sensor, placed)
    np.testing.assert_allclose(found["radius"], [50, 50])
    np.testing.assert_allclose(found["range"], [NAN, 1.5])
    np.testing.assert_allclose(found["tilt"], [NAN, 30])
    np.testing.assert_allclose(found["time"], [1, 0])


def test_radial_pixel_and_depth_trends_of_constant_residuals():
    """Every residual is 0.5 px away from the principal point, so 0.5 / sqrt(2) RMS of a coordinate; depth 2 mm too long."""
    rng = np.random.default_rng(0)
    rows = []
    for f in range(12):
        for _ in range(20):
            at = rng.uniform(0, [640, 480])
            out = (at - [319.5, 239.5]) / np.linalg.norm(at - [319.5, 239.5])
            rows.append(("C1", str(f), at, 0.5 * out, 2.0, 0.002, True, True))
    rows.append(("C1", "0", (1, 1), (99, 99), 2.0, 9.0, False, False))
    found = dependence.dependences(residuals(rows), [Sensor("C1", "C1", LENS, np.eye(4))], [])
    assert set(found["radial"]) == {"radius"} and set(found["px"]) == {"radius", "time"}
    np.testing.assert_allclose(found["radial"]["radius"]["C1"].mean, 0.5)
    np.testing.assert_allclose(found["depth"]["time"]["C1"].mean, 0.002)
    drawn = dependence.figure("px", "radius", found["px"]["radius"], ["C1"])
    np.testing.assert_allclose(drawn["data"][0]["y"], 0.5 / np.sqrt(2), atol=1e-4)


def test_the_worst_best_and_left_out_views_are_chosen():
    rows = residuals(
        [
            ("C1", frame, (10, 10), (px, 0), NAN, NAN, used, False)
            for frame, px, used in (
                ("a", 1.0, True),
                ("b", 3.0, True),
                ("c", 2.0, True),
                ("d", 5.0, False),
                ("e", 9.0, False),
                ("C1 alone: f", 20.0, True),
            )
        ]
    )
    found = [(c.view.frame, c.why) for c in pictures.choose(rows, "C1")]
    assert found == [("b", "worst"), ("a", "best"), ("e", "left out")]
    assert pictures.choose(rows, "C2") == []


def board_depth(T_color_board: np.ndarray, extra_m: float) -> np.ndarray:
    """Points (h, w, 3) of a board's plane seen by `LENS`, along the optical axis too far by `extra_m`."""
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    rays = np.concatenate([(pixels - [319.5, 239.5]) / 500, np.ones((480, 640, 1))], axis=-1)
    n, origin = T_color_board[:3, 2], T_color_board[:3, 3]
    z = (n @ origin) / (rays @ n)
    return rays * (z + extra_m)[..., None]


@pytest.mark.parametrize("extra_m", [0.004, -0.004])
@pytest.mark.parametrize("back", [False, True])
def test_depth_on_the_board_errs_along_the_optical_axis(extra_m, back):
    """Red (positive) reads too far, on either face, however the board is tilted."""
    R = so3.exp(np.array([0.2, 0.5, 0.1])) @ (np.diag([-1.0, 1.0, -1.0]) if back else np.eye(3))
    middle = np.array([0.24, 0.15, 0.0])
    board = replace(BOARD, two_sided=True, thickness_m=0.006)
    T = se3.make(R, np.array([0.0, 0.0, 1.5]) - R @ middle)
    face = T @ se3.make(np.eye(3), np.array([0, 0, board.thickness_m])) if back else T
    found = pictures.depth_cells(board_depth(face, extra_m), T, board, LENS, (0, 0, 640, 480))
    seen = found.error_mm[np.isfinite(found.error_mm)]
    assert len(seen) > 20
    np.testing.assert_allclose(seen, 1e3 * extra_m, atol=1e-6)
    assert found.u_px[0] == pytest.approx(9.5) and len(found.u_px) == pictures.CELLS


def test_depth_that_is_not_of_the_board_is_left_out():
    T = se3.make(np.eye(3), np.array([-0.24, -0.15, 1.5]))
    assert pictures.depth_cells(board_depth(T, -0.5), T, BOARD, LENS, (0, 0, 640, 480)) is None


def test_a_picture_has_its_pixels_corners_and_arrows_where_the_image_has_them():
    image = np.zeros((100, 200, 3), np.uint8)
    image[40, 60] = 255
    left = residuals([("C1", "a", (60.0 + k, 40.0), (0.5, 0.0), NAN, NAN, True, False) for k in range(5)])
    chosen = pictures.choose(left, "C1")[0]
    own = pictures.ViewPicture(chosen, left, image[20:80, 30:170], (30, 20), None)
    drawn, scale, depth = pictures.figures(own, 1.0)
    photo, corners, arrows = drawn["data"]
    assert (photo["x0"], photo["y0"], photo["dx"], depth) == (30, 20, 1, None)
    stored = Image.open(io.BytesIO(base64.b64decode(photo["source"].partition(",")[2])))
    v, u = np.unravel_index(np.argmax(np.asarray(stored).sum(axis=2)), (60, 140))
    assert (u + 30, v + 20) == (60, 40)
    assert corners["x"][0] == 60.0 and arrows["x"][1] - arrows["x"][0] == pytest.approx(0.5 * scale)
    # half of each coordinate's square: sqrt((0.25 + 0) / 2)
    assert "0.354 px RMS" in pictures.caption(own, scale)


def test_the_part_of_the_image_around_the_corners_stays_inside():
    assert pictures.part_of(np.array([[100.0, 100.0], [300.0, 200.0]]), LENS) == (42, 42, 358, 258)
    assert pictures.part_of(np.array([[0.0, 0.0], [639.0, 479.0]]), LENS) == (0, 0, 640, 480)


def test_pictures_are_read_from_the_recording(tiny):
    """Frame 000000 of C1 is of one colour, and its picture too, with red first."""
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig

    at = [(20.0, 20.0), (40.0, 20.0), (40.0, 30.0), (20.0, 30.0)]
    left = residuals([("C1", "000000", p, (0.1, 0.1), NAN, NAN, True, False) for p in at])
    (own,) = view_pictures(open_recording(tiny.recording), read_rig(tiny.rig_path), {}, left)
    assert own.image.reshape(-1, 3).mean(axis=0) == pytest.approx([200, 20, 10], abs=3) and own.depth is None


def test_coverage_counts_views_by_region_and_range():
    def placed(camera: str, distance_m: float, row: int, column: int) -> ViewCoverage:
        regions = np.zeros((3, 4), int)
        regions[row, column] = 1
        return ViewCoverage(camera, "f", regions, distance_m, 0.0)

    views = [placed("C1", 1.0, 0, 0), placed("C1", 1.1, 0, 0), placed("C1", 2.5, 2, 3), placed("C2", 4.0, 1, 1)]
    views.append(placed("C1", NAN, 1, 2))
    found = range_coverage(views, ["C1", "C2"])
    np.testing.assert_allclose(found["C1"].edges_m, [1, 2, 3, 4], atol=1e-5)
    assert found["C1"].counts[0, 0, 0] == 2 and found["C1"].counts[1, 2, 3] == 1 and found["C1"].counts.sum() == 3
    assert found["C2"].counts[2, 1, 1] == 1 and found["C2"].counts.sum() == 1
    assert found["C1"].empty[2] == "far, 3.0-4.0 m: no view"
    assert found["C1"].empty[0].startswith("near, 1.0-2.0 m: 11 of 12 regions empty")
    assert coverage_map.figure(found["C1"])["data"][1]["z"] == found["C1"].counts[1].tolist()
    alike = range_coverage([placed("C1", 1.0, 0, 0), placed("C1", 1.2, 1, 1)], ["C1"])["C1"]
    assert alike.labels == ["1.0-1.2 m"] and alike.counts.sum() == 2
    unknown = range_coverage([placed("C1", NAN, 0, 0)] * 2, ["C1"])["C1"]
    assert unknown.counts[0, 0, 0] == 2 and unknown.empty[0].startswith("any distance: 11 of 12 regions empty")
    assert len(coverage_map.figure(unknown)["data"]) == 1


def test_the_table_of_frames_says_what_became_of_every_view():
    left = residuals(
        [
            ("C1", "1", (1, 1), (0.3, 0.4), 2.0, 0.003, True, True),
            ("C1", "2", (1, 1), (0.1, 0.1), 2.0, 0.003, True, False),
            ("C1", "3", (1, 1), (0.1, 0.1), NAN, NAN, False, False),
            ("C2", "1", (1, 1), (0.1, 0.1), NAN, NAN, True, False),
        ]
    )
    gross, lost = {"C1": {"3": "RMS is 9 times the median"}}, {"C2": {"2": "no pose"}}
    quality = Quality(dropped=gross, views_not_associated=lost)
    images = {"images_sha256": {"C1": {"0": "x", "1": "x", "2": "x", "3": "x"}}}
    found = frames.table(left, quality, images, ["C1", "C2", "C3"])
    assert found.cameras == ("C1", "C2") and found.more == 0
    rows = dict(found.rows)
    assert list(rows) == ["0", "1", "2", "3"]
    assert rows["0"][0].state == "no board found" and rows["0"][1] is None
    assert rows["1"][0] == frames.Cell("used", pytest.approx(np.sqrt(0.125)), pytest.approx(3.0))
    assert rows["1"][1].state == "used"  # without depth, all of it was used
    assert (rows["2"][0].state, rows["2"][0].why) == ("partly used", "depth not used")
    assert (rows["2"][1].state, rows["2"][1].why) == ("left out", "no pose")
    assert (rows["3"][0].state, rows["3"][0].why) == ("left out", "RMS is 9 times the median")


def test_of_too_many_frames_those_with_a_fault_are_listed(monkeypatch):
    monkeypatch.setattr(frames, "MAX_ROWS", 3)
    rows = [("C1", f"{i}", (1, 1), (0.1, 0.1), NAN, NAN, i != 4, False) for i in range(6)]
    found = frames.table(residuals(rows), Quality(), {}, ["C1"])
    assert [frame for frame, _ in found.rows] == ["4"] and found.more == 5


def rig_camera(**options) -> RigCamera:
    return RigCamera(LENS, np.eye(4), np.zeros((6, 6)), **options)


def two_cameras(x_m: float) -> Rig:
    moved = se3.make(np.eye(3), np.array([x_m, 0.0, 0.0]))
    return Rig("C1", {"C1": rig_camera(), "C2": RigCamera(LENS, moved, np.zeros((6, 6)))})


def test_the_slider_leads_from_the_rig_before_to_the_rig_after():
    cloud = MovedCloud("C2", np.array([[1.0, 0.0, 2.0]]), np.array([[0.9, 0.0, 2.0]]))
    drawn = scene(two_cameras(0.5), {}, None, np.empty((0, 3)), np.empty(0), two_cameras(0.6), [cloud])
    by_name = {t["name"]: t for t in drawn["data"] if "name" in t}
    assert by_name["C2"]["x"][0] == 0.5 and by_name["C2"]["meta"]["before"]["x"][0] == 0.6
    assert by_name["C1"]["x"] == by_name["C1"]["meta"]["before"]["x"]
    assert by_name["C2, depth"]["x"] == [0.9] and by_name["C2, depth"]["meta"]["before"]["x"] == [1.0]
    still = scene(two_cameras(0.5), {}, None, np.empty((0, 3)), np.empty(0))
    assert all("meta" not in t for t in still["data"])


def test_the_slider_moves_what_is_drawn_and_paper_shows_all(tmp_path, browser):
    """By the keyboard: five steps of 5 % back, so a quarter of the way back to the rig before."""
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    page = tmp_path / "index.html"
    page.write_text(render(Contents("rig", two_cameras(0.5), {}, None, start=two_cameras(0.9))), encoding="utf-8")
    browser.get(page.as_uri())
    WebDriverWait(browser, 120).until(lambda b: b.execute_script("return document.body.dataset.drawn") == "yes")
    slide = browser.find_element("id", "slide")
    for _ in range(5):
        slide.send_keys(Keys.ARROW_LEFT)
    drawn = "return document.getElementById('fig_scene').data.find(t => t.name === 'C2' && t.mode === 'lines').x[0]"
    assert browser.execute_script(drawn) == pytest.approx(0.5 + 0.25 * 0.4)
    # on paper all is unfolded, and folded again afterwards
    folded = "return document.querySelectorAll('details:not([open])').length"
    count = browser.execute_script(folded)
    assert count > 0
    browser.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert browser.execute_script(folded) == 0
    browser.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert browser.execute_script(folded) == count


EVIL = "</script><img src=x onerror=alert(1)>"


def evil() -> Contents:
    own = two_cameras(0.5)
    cameras = {EVIL: own.cameras["C1"], "C2": own.cameras["C2"]}
    quality = Quality(method=EVIL, dropped={EVIL: {EVIL: EVIL}}, pairs=(PairViews((EVIL, "C2"), 3, 3),))
    left = residuals([(EVIL, EVIL, (9, 9), (0.1, 0.1), 2.0, 0.001, True, True) for _ in range(9)])
    rig = Rig(EVIL, cameras, quality, {"recording": EVIL, "command": EVIL, "config": {EVIL: EVIL}})
    image = np.zeros((50, 50, 3), np.uint8)
    chosen = pictures.choose(left, EVIL)[0]
    view = pictures.ViewPicture(chosen, left, image, (0, 0), None)
    missing = {"clouds": EVIL}
    return Contents(EVIL, rig, {EVIL: np.eye(4)}, left, missing=missing, views=(view,), start=rig, cloud_note=EVIL)


def test_names_are_text_wherever_they_stand():
    page = render(evil())
    assert EVIL not in page and "<img src=x" not in page
    assert page.count("</script>") == 3  # plotly, the figures and the script of the page


def test_names_run_nothing_in_a_browser(tmp_path, browser):
    from selenium.webdriver.support.ui import WebDriverWait

    (tmp_path / "index.html").write_text(render(evil()), encoding="utf-8")
    browser.get((tmp_path / "index.html").as_uri())
    WebDriverWait(browser, 120).until(lambda b: b.execute_script("return document.body.dataset.drawn") == "yes")
    assert browser.execute_script("return document.querySelectorAll('img[src=x]').length") == 0
    assert browser.execute_script("return document.querySelectorAll('svg image[onerror], [onerror]').length") == 0


def test_pictures_are_left_out_of_a_page_that_would_be_too_long(monkeypatch):
    from rgbd_calib.report import page as page_module

    noise = np.random.default_rng(0).integers(0, 255, (600, 800, 3), dtype=np.uint8)
    contents = replace(evil(), pictures=tuple(CloudComparison(str(i), noise, noise) for i in range(8)), missing={})
    whole = render(contents)
    monkeypatch.setattr(page_module, "MAX_BYTES", len(whole.encode()) - 1_000_000)
    less = render(contents)
    assert len(less.encode()) < page_module.MAX_BYTES and "Pictures are left out" in less


@pytest.mark.parametrize(("share", "said"), [(1.0, "100 %"), (0.998, "over 99 %"), (0.5, "50 %"), (0.001, "under 1 %")])
def test_shares_are_not_rounded_to_all_or_nothing(share, said):
    import jinja2

    loader = jinja2.PackageLoader("rgbd_calib.report", "templates")
    module = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined).get_template("macros.html").module
    assert str(module.percent(share)) == said
    assert str(module.number(23207.87, 2, " mm")) == "23208 mm" and str(module.number(1.234)) == "1.23"


def test_views_of_one_camera_and_all_in_rms():
    assert numbers.rms(np.array([3.0, NAN, 4.0])) == pytest.approx(np.sqrt(12.5)) and np.isnan(
        numbers.rms(np.array([NAN]))
    )
