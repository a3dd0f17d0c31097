"""Doctor on drawn recordings: silent on a good one, and each fault found in the view that has it, with its remedy."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_recording import BOARD, FOCAL_PX, HEIGHT, WIDTH, draw_recording

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import CameraInfo, open_recording, save_color, save_depth, write_dataset, write_table
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import detect
from rgbd_calib.pipeline.doctor import examine
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.views.detect import DetectParams, detect_view
from rgbd_calib.views.doctor import DoctorParams, check_consistency, hull_mask

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
AT = ("C2", "000003")
"""The view that is spoiled."""


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A recording with known lenses, and the views of its images."""
    folder = draw_recording(tmp_path_factory.mktemp("doctor") / "good", cameras=3, frames=9, seed=2)
    write_dataset(folder, {c: CameraInfo(WIDTH, HEIGHT, intrinsics=LENS) for c in ("C1", "C2", "C3")}, BOARD)
    recording = open_recording(folder)
    return recording, detect(recording, DetectParams(), Workers(2)).views


def checkup(recording, views):
    """Examine a spoiled copy; its images other than AT are those of the good one."""
    kept = [v for v in views if (v.camera, v.frame) != AT and v.frame in recording.color_files[v.camera]]
    try:
        depth = recording.depth_m(*AT) if recording.has_depth(*AT) else None
        again = detect_view(*AT, recording.color(*AT), depth, recording.board, DetectParams())
    except ConfigError:  # damaged on purpose
        again = None
    corners = recording.path.parent / "corners.csv"
    write_corners(corners, [*kept, *([again] if again is not None else [])])
    return examine(recording, Config(), corners=corners, workers=Workers(2))


def carried(image, dx):
    """The image's content moved to the right."""
    return cv2.warpAffine(
        image, np.array([[1.0, 0, dx], [0, 1, 0]]), image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE
    )


def raw(recording, depth_m):
    return np.round(np.nan_to_num(depth_m) / recording.cameras[AT[0]].depth_scale).astype(np.uint16)


def blur(r, hull):
    kernel = np.zeros((15, 15), np.float32)
    kernel[7] = 1 / 15
    save_color(r.path, *AT, cv2.filter2D(r.color(*AT), -1, kernel))


def bright(r, hull):
    save_color(r.path, *AT, np.clip(r.color(*AT).astype(int) * 3 + 100, 0, 255).astype(np.uint8))


def dark(r, hull):
    save_color(r.path, *AT, (r.color(*AT) * 0.08).astype(np.uint8))


def hand(r, hull):
    depth_m = r.depth_m(*AT)
    u = np.nonzero(hull)[1]
    near = hull & (np.arange(hull.shape[1]) < np.percentile(u, 20))
    save_depth(r.path, *AT, raw(r, np.where(near, depth_m - 0.1, depth_m)))


def no_depth(r, hull):
    save_depth(r.path, *AT, raw(r, np.where(hull, np.nan, r.depth_m(*AT))))


def late(r, hull):
    depth_m = r.depth_m(*AT)
    save_depth(r.path, *AT, raw(r, np.where(depth_m < 3.5, depth_m + 0.05, depth_m)))


def moved(r, hull):
    save_color(r.path, *AT, carried(r.color(*AT), 12))
    save_depth(r.path, *AT, carried(raw(r, r.depth_m(*AT)), 12))


def small(r, hull):
    save_color(r.path, *AT, r.color(*AT)[::2, ::2])


def broken(r, hull):
    path = r.depth_files[AT[0]][AT[1]]
    path.write_bytes(path.read_bytes()[:500])


@pytest.mark.parametrize(
    ("spoil", "kind", "remedy"),
    [
        (blur, "blurred", "Hold it still"),
        (bright, "overexposed", "exposure down"),
        (dark, "underexposed", "Light the board"),
        (hand, "covered", "hands"),
        (no_depth, "no depth", "range"),
        (late, "depth late", "Hold it still"),
        (moved, "moved", "Hold it still"),
        (small, "damaged", "Correct the size"),
        (broken, "damaged", "copy the recording again"),
    ],
)
def test_finds_one_spoiled_view(good, tmp_path, spoil, kind, remedy):
    source, views = good
    shutil.copytree(source.path, tmp_path / "r")
    recording = open_recording(tmp_path / "r")
    (view,) = [v for v in views if (v.camera, v.frame) == AT]
    spoil(recording, hull_mask((480, 640), view.corners_px))
    result = checkup(recording, views)
    serious = [f for f in result.findings if f.matters]
    assert not result.healthy
    assert kind in {f.kind for f in serious}
    assert any(remedy in f.sentence and AT[0] in f.cameras and AT[1] in f.frames for f in serious if f.kind == kind)
    assert {f for x in serious for f in x.frames} == {AT[1]}, "no other frame is accused"


def test_is_silent_on_a_good_recording(good):
    recording, views = good
    corners = recording.path.parent / "corners.csv"
    write_corners(corners, views)
    assert examine(recording, Config(), corners=corners, workers=Workers(2)).findings == ()


def test_without_lenses_it_estimates_them_and_only_advises_where_to_hold_the_board(good):
    recording, views = good
    corners = recording.path.parent / "corners.csv"
    write_corners(corners, views)
    unknown = replace(recording, cameras={c: CameraInfo(WIDTH, HEIGHT) for c in recording.cameras})
    result = examine(unknown, Config(), corners=corners, workers=Workers(2))
    assert result.healthy
    assert {f.kind for f in result.findings} == {"coverage"}, "nine frames do not fill the images"


def test_missing_frames_and_depth_and_late_cameras(good, tmp_path):
    source, views = good
    shutil.copytree(source.path, tmp_path / "r")
    recording = open_recording(tmp_path / "r")
    for frame in ("000001", "000005"):
        recording.color_files["C1"][frame].unlink()
        recording.depth_files["C3"][frame].unlink()
    for i, camera in enumerate(("C1", "C2", "C3")):
        late_us = {"000002": 50_000 if camera == "C3" else 0, "000004": 0}
        rows = [
            (f, 1000 * i + t, 1000 * i + t + (40_000 if (camera, f) == ("C1", "000004") else 0))
            for f, t in late_us.items()
        ]
        write_table(recording.path / camera / "timestamps.csv", ("frame", "color_us", "depth_us"), rows)
    findings = checkup(open_recording(tmp_path / "r"), views).findings
    missing = [f for f in findings if f.kind == "missing"]
    assert {f.cameras for f in missing} == {("C1",), ("C3",)}
    assert all(f.frames == ("000001", "000005") and f.matters for f in missing)
    apart = {f.frames: f for f in findings if f.kind == "unsynchronised"}
    assert set(apart) == {("000002",), ("000004",)}
    assert apart["000002",].cameras == ("C3",) and "colour and depth" in apart["000004",].sentence


def test_cameras_that_share_no_view_and_one_that_saw_nothing(good, tmp_path):
    source, views = good
    shutil.copytree(source.path, tmp_path / "r")
    recording = open_recording(tmp_path / "r")
    half = {"C1": lambda f: f < "000004", "C2": lambda f: f >= "000004", "C3": lambda f: False}
    kept = [v for v in views if half[v.camera](v.frame)]
    write_corners(tmp_path / "few.csv", kept)
    findings = examine(recording, Config(), corners=tmp_path / "few.csv", workers=Workers(2)).findings
    sentences = " / ".join(f.sentence for f in findings if f.matters)
    assert "C1 and C2 share no view yet: hold the board where both see it" in sentences
    assert "C3 has not seen the board yet" in sentences


def test_wall_distances_that_span_too_little(tmp_path):
    for i, distance in enumerate((1.0, 1.1, 1.2)):
        save_color(tmp_path / "walls", "C1", str(i), np.full((48, 64, 3), 120, np.uint8))
        save_depth(tmp_path / "walls", "C1", str(i), np.full((48, 64), int(1000 * distance), np.uint16))
    write_dataset(tmp_path / "walls", {"C1": CameraInfo(64, 48)}, None)
    rows = [(str(i), d) for i, d in enumerate((1.0, 1.1, 1.2))]
    write_table(tmp_path / "walls" / "C1" / "distances.csv", ("frame", "distance_m"), rows)
    (finding,) = examine(open_recording(tmp_path / "walls"), Config(), workers=Workers(1)).findings
    assert finding.matters and "3 wall distances from 1.00 to 1.20 m" in finding.sentence


def test_the_command_tells_and_exits_for_scripts(run, good, tmp_path):
    source, views = good
    write_corners(tmp_path / "corners.csv", views)
    out = run("doctor", source.path, "--corners", tmp_path / "corners.csv")
    assert out.status == 0 and "no problems found" in out.stderr
    few = [v for v in views if v.camera != "C3"]
    write_corners(tmp_path / "few.csv", few)
    out = run("doctor", source.path, "--corners", tmp_path / "few.csv", "--json")
    told = json.loads(out.stdout)
    assert out.status == 1 and not told["healthy"]
    assert any("C3" in f["sentence"] and f["matters"] for f in told["findings"])
    assert run("doctor", tmp_path).status == 2


def test_boards_far_away_may_be_farther_off():
    """A lens and a print that are not quite known move a board in proportion to its distance; a board that moved, more."""
    distance_m = {(c, f"{k:06d}"): 1.0 + 0.25 * k for k in range(16) for c in ("C1", "C2")}
    shift_m = {key: 0.003 * z for key, z in distance_m.items()}
    far = "000015"
    shift_m["C1", far] *= 5.1
    assert check_consistency(shift_m, distance_m, {}, list(shift_m), DoctorParams()) == []
    shift_m["C1", "000002"] += 0.040
    (finding,) = check_consistency(shift_m, distance_m, {}, list(shift_m), DoctorParams())
    assert finding.frames == ("000002",)
    assert "44 mm from where the other sees it (4.5 mm are usual at 1.5 m)" in finding.sentence
