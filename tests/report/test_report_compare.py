"""`report RIG --compare OTHER`: numbers on constructed rigs, what is refused, and the page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from qualities import expected, grid_of

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.rig import write_rig
from rgbd_calib.quality import CameraStatistics, Counted, Quality
from rgbd_calib.report.compare import Comparison, compare
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import DepthBias, Rig, RigCamera

LENS = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
GOOD, BAD = Verdict("good", "Good.", (), ()), Verdict("untrusted", "Do not trust this.", (), ())
SD_RAD, SD_M = 1e-3, 2e-3
COVARIANCE = np.diag([SD_RAD**2] * 3 + [SD_M**2] * 3)
T_C2 = se3.make(so3.exp(np.array([0.1, -0.4, 0.05])), np.array([0.6, 0.1, -0.2]))


def rig(T_C2_pose: np.ndarray = T_C2, mean_mm: float = 1.0, **options) -> Rig:
    """C1 and C2, a volume before both."""
    points = [[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (1.5, 2.0)]
    stated = expected(mean_mm, grid=grid_of(points, [1.0] * len(points)))
    bias = DepthBias((0.0, 0.0), 0.5, 4.0, 0.001)
    cameras = {
        "C1": RigCamera(LENS, np.eye(4), np.zeros((6, 6)), bias, CameraStatistics((0.3,) * 9)),
        "C2": RigCamera(LENS, T_C2_pose, COVARIANCE, bias, CameraStatistics((0.4,) * 9)),
    }
    return replace(Rig("C1", cameras, Quality(expected_alignment=stated), {}), **options)


def with_images(own: Rig, *digests: str) -> Rig:
    return replace(own, provenance={"images_sha256": {"C1": {str(i): d for i, d in enumerate(digests)}}})


def of(a: Rig, b: Rig, verdicts=(GOOD, GOOD)) -> Comparison:
    return compare((a, b), ("a.yaml", "b.yaml"), verdicts)


def test_a_motion_has_its_length_direction_and_deviation_of_both_rigs():
    step = np.array([0.03, 0.0, -0.04])
    moved = T_C2.copy()
    moved[:3, 3] += step
    (own,) = of(rig(), rig(moved)).motions
    assert own.camera == "C2" and own.mm == pytest.approx(50.0) and own.deg == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(own.step_m, step, atol=1e-12)
    # of the centre t under the left perturbation: t' = t + omega x t + v, twice, as both rigs err
    J = np.concatenate([-so3.hat(T_C2[:3, 3]), np.eye(3)], axis=1)
    u = step / np.linalg.norm(step)
    assert own.sd_mm == pytest.approx(1e3 * np.sqrt(2 * u @ J @ COVARIANCE @ J.T @ u))
    assert own.moved


def test_a_turn_in_place_moves_no_centre():
    T = T_C2.copy()
    T[:3, :3] = so3.exp(np.array([0.0, 0.02, 0.0])) @ T[:3, :3]
    (own,) = of(rig(), rig(T)).motions
    assert own.mm == pytest.approx(0.0, abs=1e-9) and own.deg == pytest.approx(np.degrees(0.02))
    assert own.sd_deg == pytest.approx(np.degrees(np.sqrt(2) * SD_RAD)) and own.moved


def test_noise_of_the_stated_covariance_is_no_motion():
    """Chances are uniform where nothing moved: 200 draws, a mean within 5 standard errors of a half, one at most below 1e-3."""
    rng = np.random.default_rng(0)

    def drawn() -> Rig:
        xi = rng.multivariate_normal(np.zeros(6), COVARIANCE)
        return rig(se3.make(so3.exp(xi[:3]), xi[3:]) @ T_C2)

    chances = np.array([of(drawn(), drawn()).motions[0].chance for _ in range(200)])
    assert abs(chances.mean() - 0.5) < 5 / np.sqrt(12 * 200)
    assert np.sum(chances < 1e-3) <= 1


def test_another_world_moves_nothing():
    """Poses and covariances of the second in a world of its own: the motion, and its deviation, are as before."""
    T_new = se3.make(so3.exp(np.array([0.3, 1.0, -0.5])), np.array([3.0, -2.0, 1.0]))
    Ad = se3.adjoint(T_new)
    step = T_C2.copy()
    step[0, 3] += 0.01
    plain = rig(step)
    cameras = {
        name: replace(own, T_world_color=T_new @ own.T_world_color, covariance=Ad @ own.covariance @ Ad.T)
        for name, own in plain.cameras.items()
    }
    first, second = of(rig(), plain).motions[0], of(rig(), replace(plain, cameras=cameras)).motions[0]
    assert second.mm == pytest.approx(first.mm) and second.sd_mm == pytest.approx(first.sd_mm)
    assert second.chance == pytest.approx(first.chance, rel=1e-4)


def test_rigs_of_the_same_images_are_not_tested():
    found = of(with_images(rig(), "x", "y"), with_images(rig(np.eye(4)), "y", "z"))
    assert found.shared_images == 1 and "correlated" in found.untested
    assert found.motions[0].moved is None and found.motions[0].sd_mm is None
    assert all(own.lens_sd_px is None for own in found.changed)
    assert of(with_images(rig(), "x"), with_images(rig(), "z")).untested == ""
    same = {"recording_sha256": "r"}
    assert of(rig(provenance=same), rig(provenance=same)).untested


def test_other_references_are_not_tested_but_lenses_are():
    found = of(rig(), rig(reference="C2"))
    assert "--reference" in found.untested and found.frame == "C1"
    assert found.motions[0].moved is None and found.motions[0].mm == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(found.changed[0].lens_sd_px, np.sqrt(2) * 0.3)


def test_lens_depth_and_their_effect():
    a = rig()
    lens = replace(LENS, cx=LENS.cx + 2.0)
    bias = DepthBias((0.01, 0.0), 0.5, 4.0, 0.001)
    b = replace(a, cameras=a.cameras | {"C2": replace(a.cameras["C2"], intrinsics=lens, depth_bias=bias)})
    first, second = of(a, b).changed
    assert first.rms_px == 0 and first.effect_mm == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(second.lens_px, [0, 0, 2, 0])
    assert second.rms_px == pytest.approx(2.0)
    assert [z for z, _, _ in second.depth_mm] == [0.75, 1.0, 1.5, 2.0, 3.0, 4.0]
    assert all(mean == rms == pytest.approx(10.0) for _, mean, rms in second.depth_mm)
    # 10 mm along the axis, and 2 px of 500 at some 1.9 m sideways: about 13 mm
    assert 10.0 < second.effect_mm < 15.0


@pytest.mark.parametrize(
    ("means", "verdicts", "said"),
    [
        ((1.0, 0.5), (GOOD, GOOD), "b.yaml expects less error: 0.50 mm"),
        ((1.0, 1.04), (GOOD, GOOD), "about the same error"),
        ((2000.4, 1.0), (GOOD, GOOD), "a.yaml 2000 mm"),
        ((0.5, 1.0), (BAD, GOOD), "b.yaml is better: a self-check failed in a.yaml"),
        ((0.5, 1.0), (BAD, BAD), "Trust neither"),
    ],
)
def test_which_is_better(means, verdicts, said):
    assert said in of(rig(mean_mm=means[0]), rig(mean_mm=means[1]), verdicts).sentence


def test_expected_errors_of_different_contents_are_not_compared():
    other = rig()
    assert "not known" in of(other, replace(other, quality=Quality())).sentence
    poses = Quality(expected_alignment=expected(1.0, Counted.POSES))
    assert "counts poses" in of(other, replace(other, quality=poses)).sentence


def test_cameras_of_one_alone_are_named_and_none_in_common_is_refused():
    a = rig()
    b = Rig("C1", {"C1": a.cameras["C1"], "C3": a.cameras["C2"]})
    found = of(a, b)
    assert found.only == (("C2",), ("C3",)) and found.motions == ()
    with pytest.raises(ConfigError, match=r"b.yaml: at least one camera of a.yaml \(C1, C2\) was expected, C9 found"):
        of(a, Rig("C9", {"C9": a.cameras["C1"]}))


EVIL = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare")
    a, moved = rig(), T_C2.copy()
    moved[0, 3] += 0.05
    write_rig(folder / "old.yaml", replace(a, provenance={"recording": EVIL}))
    write_rig(folder / "new.yaml", rig(moved, 0.5))
    return folder


def test_the_page_and_the_numbers_of_two_files(two, tmp_path, run):
    out = run("report", two / "old.yaml", "--compare", two / "new.yaml", "-o", tmp_path, "--json")
    assert out.status == 0, out.stderr
    numbers = json.loads(out.stdout)
    assert numbers["motions"]["C2"]["mm"] == pytest.approx(50.0) and numbers["motions"]["C2"]["moved"] is True
    assert numbers["rigs"][1]["expected"]["mean_mm"] == 0.5 and numbers["untested"] is None
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    head = page[: page.index("<script>")]
    assert "new.yaml expects less error" in head and "<strong>moved</strong>" in head and "50.00" in head
    assert EVIL not in page and "&lt;script&gt;" in head
    assert len(page.encode()) < 15_000_000 and "http" not in head
    names = [t.get("name") for t in scene_of(page)]
    assert {"C2, first", "C2, second", "motion, magnified"} <= set(names)
    plain = run("report", two / "old.yaml", "--compare", two / "new.yaml", "-o", tmp_path / "b")
    assert plain.stdout.splitlines()[1].startswith("C2: 50.00 ± ") and plain.stdout.splitlines()[1].endswith("moved")


def scene_of(page: str) -> list[dict]:
    start = page.index(">", page.index('<script id="figures"')) + 1
    return json.loads(page[start : page.index("</script>", start)])["fig_scene"]["data"]


def test_the_magnified_motion_starts_where_the_camera_was(two, tmp_path, run):
    run("report", two / "old.yaml", "--compare", two / "new.yaml", "-o", tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    (line,) = [t for t in scene_of(page) if t.get("name") == "motion, magnified"]
    at = [i for i, x in enumerate(line["x"]) if x == pytest.approx(0.6)]
    scale = (line["x"][at[0] + 1] - 0.6) / 0.05
    assert scale > 1 and f"{scale:g} times as long" in page


def test_the_same_page_in_a_browser_fits_a_phone(two, tmp_path, run, browser):
    from selenium.webdriver.support.ui import WebDriverWait

    run("report", two / "old.yaml", "--compare", two / "new.yaml", "-o", tmp_path)
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    browser.get((tmp_path / "index.html").as_uri())
    WebDriverWait(browser, 120).until(lambda b: b.execute_script("return document.body.dataset.drawn") == "yes")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    # a finger scrolls the page until it is asked to turn the view
    drag = "return document.getElementById('fig_scene').layout.scene.dragmode"
    button = browser.find_element("css selector", "button.touch")
    assert button.is_displayed() and browser.execute_script(drag) is False
    browser.execute_script("arguments[0].click()", button)
    WebDriverWait(browser, 60).until(lambda b: b.execute_script(drag) == "orbit")
    assert button.get_attribute("aria-pressed") == "true"
    # turned by the keyboard alone
    eye = "const e = document.getElementById('fig_scene').layout.scene.camera.eye; return [e.x, e.y, e.z]"
    before = browser.execute_script(eye)
    scene = browser.find_element("id", "fig_scene")
    browser.execute_script(
        "arguments[0].dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft', bubbles: true}))", scene
    )
    WebDriverWait(browser, 60).until(lambda b: b.execute_script(eye) != before)
    after = browser.execute_script(eye)
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.parametrize(
    ("other", "options", "status", "said"),
    [
        ("none.yaml", [], 2, "none.yaml"),
        ("text.yaml", [], 2, "text.yaml"),
        ("old.yaml", [], 2, "another rig was expected, RIG itself found"),
        ("odd.yaml", [], 2, "quality: cannot be shown"),
        ("new.yaml", ["--recording", "r"], 2, "do not go with it"),
    ],
)
def test_wrong_input_is_named(two, tmp_path, run, other, options, status, said):
    (two / "text.yaml").write_text("just text\n")
    odd = (two / "new.yaml").read_text().replace("mean_mm: 0.5", "mean_mm: [1]")
    (two / "odd.yaml").write_text(odd)
    out = run("report", two / "old.yaml", "--compare", two / other, "-o", tmp_path / "out", *options)
    assert out.status == status and said in out.stderr, out.stderr
    assert "Traceback" not in out.stderr and not (tmp_path / "out").exists()
