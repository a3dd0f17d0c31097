"""`devices` and `capture` against the stock OpenNI2 runtime with virtual cameras, each run in a process of its own.

Cameras are served from a drawn recording. Nothing here depends on how fast the machine is, except through time-outs
that are many times longer than needed.
"""

from __future__ import annotations

import csv
import json
import time
from pathlib import Path

import numpy as np
import pytest
from virtual_rig import QUICK, check_whole, finish, last_session, read_raw, stamps

from rgbd_calib.io.files import dump_yaml, load_yaml, write_text
from rgbd_calib.io.recording import open_recording

BOARD = ("--board", "9x6", "--square", "0.06")


def events(folder: Path) -> str:
    return "\n".join(f"{e['camera']}: {e['event']}" for e in last_session(folder)["events"])


def test_devices_lists_what_is_attached(rig):
    rig.settings(devices=4, noserial=2)
    ended = rig.run("devices", "--json")
    listed = json.loads(ended.stdout)
    assert ended.status == 0
    assert [d["camera"] for d in listed] == ["C1", "C2", "C3", "C4"]
    assert [d["identity"]["serial"] for d in listed] == ["VX0000001000", "VX0000001001", "VX0000001003", None]
    assert "color 640x480@30 RGB888" in listed[0]["modes"] and listed[0]["firmware"] == "5.8.22"
    assert "reports no serial number" in ended.stderr


def test_devices_says_what_is_wrong(rig):
    rig.settings(fail_open=1)
    ended = rig.run("devices")
    assert ended.status == 1 and "serial VX0000001000" in ended.stdout
    assert "virtual://1: the device does not open (Could not open" in ended.stderr
    rig.settings(devices=0)
    ended = rig.run("devices")
    assert ended.status == 2 and "no camera is attached" in ended.stderr
    rig.environment["OPENNI2_REDIST64"] = str(rig.folder)
    ended = rig.run("devices")
    assert ended.status == 2 and "no OpenNI2 runtime" in ended.stderr and "apt-get install libopenni2-0" in ended.stderr


def test_pictures_arrive_bit_by_bit_and_calibrate_to_the_same_poses(rig, played, run):
    """Four cameras with PS1080's defaults (QVGA, mirrored, unregistered); each pose is taken once."""
    rig.settings(devices=4, scene=0, phase_us="0,9000,17000,25000", drift_ppm="0,40,-60,100", ae_shows=1)
    out = rig.folder / "out"
    process = rig.start("capture", out, *BOARD, "--on-still", "--count", 4, "--settle", 0.5)
    for n in range(1, 4):
        rig.wait_for_frame_sets(out, n)
        rig.command(f"scene {n}")
    ended = finish(process)
    assert ended.status == 0, ended.stderr
    source, recording = open_recording(played), check_whole(out)
    assert recording.board == source.board
    assert {c: i.serial for c, i in recording.cameras.items()} == {f"C{i + 1}": f"VX000000100{i}" for i in range(4)}
    poses = set()
    for frame in recording.frames:
        matches = {
            f
            for f in source.frames
            for c in recording.cameras
            if (read_raw(source.color_files[c][f]) == read_raw(recording.color_files[c][frame])).all()
            and (read_raw(source.depth_files[c][f]) == read_raw(recording.depth_files[c][frame])).all()
        }
        assert len(matches) == 1, f"{frame}: cameras show {matches}"
        poses |= matches
    assert len(poses) == len(recording.frames) == 4
    session = last_session(out)
    assert session["status"] == "complete" and session["counts"]["frame_sets"] == 4
    camera = session["cameras"]["C4"]
    assert camera["registered"] and not camera["mirrored"] and camera["color_mode"] == "640x480@30 RGB888"
    assert camera["serial"] == "VX0000001003" and camera["auto_exposure"] is False
    # phases 0, 9, 17, 25 ms leave a largest gap of 9 ms: the other 24.4 ms can always be had; the clocks are mapped to
    # a few ms on a loaded machine, and more than a period is refused
    with (out / "frame_sets.csv").open() as stream:
        assert all(0 < int(row["spread_us"]) <= 33_334 for row in csv.DictReader(stream))
    _check_same_poses(rig.folder, played, out, run)


def _check_same_poses(folder: Path, recording: Path, captured: Path, run) -> None:
    """`calibrate` on both gives the same; the order of the frames may differ, and with it the last digits."""
    camera = {
        "intrinsics": {
            "model": "opencv",
            "width": 640,
            "height": 480,
            "fx": 575.0,
            "fy": 575.0,
            "cx": 319.5,
            "cy": 239.5,
        }
    }
    lens = {"format": "rgbd-calib/rig", "version": 1, "cameras": {f"C{i}": camera for i in range(1, 5)}}
    write_text(folder / "lens.yaml", dump_yaml(lens))
    poses = []
    for source in (recording, captured):
        result = folder / f"{source.name}.yaml"
        outcome = run("calibrate", source, "--intrinsics", folder / "lens.yaml", "-o", result, "--jobs", 1)
        assert outcome.status == 0, outcome.stderr
        poses.append({c: np.array(v["T_world_color"]) for c, v in load_yaml(result)["cameras"].items()})
    # the same observations in another order: the bundle stops at a relative change of 1e-9 or so of poses of 1 m
    for camera_id, T in poses[0].items():
        np.testing.assert_allclose(poses[1][camera_id], T, atol=1e-6)


def test_colour_and_depth_of_one_exposure_stay_together(rig):
    """Colour 8 ms late, 3 ms jitter, drifting clocks, dropped frames: every pair is of one exposure."""
    rig.settings(stamp=1, color_lag_us=8000, jitter_us=3000, drift_ppm="100,-100", phase_us="0,11000")
    out = rig.folder / "out"
    process = rig.start("capture", out, "--count", 25, "--settle", 0.5, "--interval", 0)
    rig.wait_for_frame_sets(out, 5)
    for line in ("drop 0 color 3", "drop 1 depth 2", "drop 0 both 4"):
        rig.command(line)
        time.sleep(0.1)
    assert finish(process).status == 0
    check_whole(out)
    for camera in ("C1", "C2"):
        color, depth = stamps(out, camera, "color"), stamps(out, camera, "depth")
        assert color == depth and len(set(color.values())) == len(color)
    lost = last_session(out)["counts"]["cameras"]
    assert lost["C1"]["lost"]["color"] >= 7 and lost["C1"]["lost"]["depth"] >= 4 and lost["C2"]["lost"]["depth"] >= 2


def test_a_named_camera_that_is_missing(rig):
    rig.settings(devices=4, unplugged=3)
    names = [f"--device=cam{i}=VX000000100{i}" for i in range(4)]
    ended = rig.run("capture", rig.folder / "out", *names, "--count", 1)
    assert ended.status == 2
    assert "cam3: no device VX0000001003 is attached" in ended.stderr and "Plug it in" in ended.stderr
    assert not (rig.folder / "out").exists()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"fail_open": 1}, "virtual://1: the device does not open"),
        ({"noreg": 1}, "depth is not registered to colour (it does not offer registration)"),
        ({"mirror_stuck": 0}, "pictures stay mirrored"),
        ({"silent": 1}, "no color and no depth frame in 5 s"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_camera_that_cannot_do_it(rig, fault, message):
    rig.settings(**fault)
    ended = rig.run("capture", rig.folder / "out", "--count", 1, *QUICK)
    assert ended.status == 1 and message in ended.stderr


def test_without_serial_numbers_the_port_is_the_name(rig):
    rig.settings(noserial="0,1")
    out = rig.folder / "out"
    ended = rig.run(
        "capture", out, "--device", "left=virtual://1", "--device", "right=virtual://0", "--count", 1, *QUICK
    )
    assert ended.status == 0 and "keep it in that port" in ended.stderr
    assert list(check_whole(out).cameras) == ["left", "right"]
    assert last_session(out)["cameras"]["left"]["uri"] == "virtual://1"


def test_unregistered_depth_only_when_asked_for(rig):
    rig.settings(noreg=0)
    out = rig.folder / "out"
    assert rig.run("capture", out, "--count", 1, "--allow-unregistered", *QUICK).status == 0
    assert "depth_registered: false" in (out / "dataset.yaml").read_text()


def test_a_camera_without_depth_beside_one_that_has_it(rig, played):
    rig.settings(nodepth=1)
    out = rig.folder / "out"
    ended = rig.run("capture", out, "--count", 2, *QUICK)
    assert ended.status == 0, ended.stderr
    assert "C2: has no depth sensor; its colour alone is recorded" in ended.stderr
    recording, source = check_whole(out), open_recording(played)
    assert recording.cameras["C1"].depth_stated and not recording.cameras["C2"].depth_stated
    assert len(recording.depth_files["C1"]) == 2 and not recording.depth_files["C2"]
    sent = {source.color("C2", frame).tobytes() for frame in source.frames}
    assert all(recording.color("C2", frame).tobytes() in sent for frame in recording.frames)


def test_depth_is_a_mean_and_emitters_take_turns(rig):
    """Every other projector makes 1 hole in 32 pixels, at random: the mean of 5 leaves none, one alone has none."""
    rig.settings(interference=1, scene=0)
    mean, turns = rig.folder / "mean", rig.folder / "turns"
    assert rig.run("capture", mean, "--count", 1, "--depth-frames", 5, *QUICK).status == 0
    ended = rig.run("capture", turns, "--count", 1, "--alternate-emitters", *QUICK)
    assert ended.status == 0, ended.stderr

    def holes(folder: Path) -> float:
        return float((read_raw(folder / "C1/depth/000000.png") == 0).mean())

    # P(at least 3 of 5 empty) = 10 / 32^3 = 3e-4, and 1/32 = 3e-2 of a single picture
    assert 1e-4 < holes(mean) < 1e-3
    assert holes(turns) == 0


def test_emitters_that_cannot_be_switched(rig):
    rig.settings(noemitter="0,1")
    ended = rig.run("capture", rig.folder / "out", "--count", 1, "--alternate-emitters", *QUICK)
    assert ended.status == 1 and "its infrared projector cannot be switched" in ended.stderr


def test_depth_bias_at_known_distances(rig):
    out = rig.folder / "out"
    ended = rig.run("capture", out, "--depth-bias", "--distances", "0.8,1.25", "--count", 2, *QUICK)
    assert ended.status == 0, ended.stderr
    recording = check_whole(out)
    assert sorted(d for d, _ in recording.distances_m("C1").values()) == [0.8, 0.8, 1.25, 1.25]
    assert sorted(d for d, _ in recording.distances_m("C2").values()) == [0.8, 0.8, 1.25, 1.25]
    assert not set(recording.color_files["C1"]) & set(recording.color_files["C2"])
    ended = rig.run("capture", rig.folder / "other", "--depth-bias", *QUICK)
    assert ended.status == 1 or ended.status == 2
    assert "nobody at the keyboard" in ended.stderr


def test_intrinsic_leads_through_the_cameras(rig):
    rig.settings(hold=45)
    out = rig.folder / "out"
    ended = rig.run("capture", out, *BOARD, "--intrinsic", "--count", 2, "--settle", 0.3)
    assert ended.status == 0, ended.stderr
    recording = check_whole(out)
    assert len(recording.color_files["C1"]) == 2 and len(recording.color_files["C2"]) == 2
    assert not set(recording.color_files["C1"]) & set(recording.color_files["C2"])
    assert ended.stderr.index("now C1") < ended.stderr.index("now C2")


def test_wave_records_each_camera_under_its_own_frames(rig):
    out = rig.folder / "out"
    ended = rig.run("capture", out, *BOARD, "--wave", 2, "--settle", 0.3)
    assert ended.status == 0, ended.stderr
    recording = open_recording(out)
    assert not recording.synchronous
    frames = {c: set(own) for c, own in recording.color_files.items()}
    assert min(len(own) for own in frames.values()) >= 5 and not frames["C1"] & frames["C2"]
    for c, own in frames.items():
        times = [t for t, _ in recording.timestamps_us(c).values()]
        assert set(recording.timestamps_us(c)) == own == set(recording.depth_files[c])
        assert all(np.diff(times) > 0)
    ended = rig.run("capture", out, "--append", "--count", 1, "--settle", 0.3)
    assert ended.status == 2 and "two recordings" in ended.stderr


def test_until_enough(rig):
    rig.settings(devices=3, hold=45)
    out = rig.folder / "out"
    ended = rig.run("capture", out, *BOARD, "--on-still", "--until-enough", "--pairs-only", "--settle", 0.3)
    assert ended.status == 0, ended.stderr
    assert len(check_whole(out).frames) == 3  # three common views of each pair, all cameras see every pose
    assert "share no view yet" in ended.stderr and "enough: nothing is missing" in ended.stderr
    ended = rig.run("capture", out, "--append", "--until-enough", "--pairs-only", "--settle", 0.3)
    assert ended.status == 0 and "0 frame sets" in ended.stderr  # it knows the board and the views of the first session
