"""`sync`: clocks by a known rig, recordings on one clock, and what it refuses."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_timing, write_rig
from rgbd_calib.io.tables import read_table, write_table
from rgbd_calib.quality import Quality
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.session import draw_scene
from rgbd_calib.simulation.wave import WaveSession, film_wave, write_wave


def made(folder, seed: int = 1, kind: str = "hand", **wave: float) -> WaveSession:
    rng = np.random.default_rng(seed)
    scene = draw_scene(2, "arc", 0, 0, rng)
    session = film_wave(scene, WaveParams(**{"seconds": 5.0, "rate_hz": 20.0, "offset_s": 30.0, **wave}), rng, kind)
    write_wave(session, folder)
    write_rig(folder / "rig.yaml", session.truth)
    return session


@pytest.fixture(scope="module")
def wave(tmp_path_factory) -> tuple:
    folder = tmp_path_factory.mktemp("wave")
    return folder, made(folder)


@pytest.fixture(scope="module")
def timing(wave) -> tuple:
    """Made once, without the command."""
    from rgbd_calib.io.rig import read_rig, write_timing
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.sync import sync

    folder, _ = wave
    recording, settings = open_recording(folder / "wave"), load_config(None)
    found = detections_from(
        recording, folder / "wave.csv", settings.detect, None, lambda items, total, what: iter(items)
    )
    result = sync(recording, read_rig(folder / "rig.yaml"), found, settings)
    write_timing(folder / "timing.yaml", result.reference, result.clocks, Quality(), {})
    return folder / "timing.yaml", result


def test_clocks_by_a_known_rig(wave, timing):
    _, session = wave
    reference, clocks = read_timing(timing[0])
    assert reference == "C1" and not timing[1].left_out
    for c, truth in session.clocks.items():
        own = clocks[c]
        assert abs(own.offset_s - truth.offset_s) <= 4 * own.offset_sd_s < 0.001
        assert abs(own.depth_delay_s - truth.depth_delay_s) < 4 * own.depth_delay_sd_s < 0.02


def test_the_recording_on_one_clock(run, wave, timing, tmp_path):
    folder, session = wave
    outcome = run("sync", folder / "wave", "--apply", timing[0], "-o", tmp_path / "one", "--json")
    assert outcome.status == 0, outcome
    assert json.loads(outcome.stdout)["apart_worst_ms"] <= 25.001
    recording = open_recording(tmp_path / "one")
    assert recording.synchronous
    n = 0
    for c in ("C1", "C2"):
        table = read_table(tmp_path / "one" / c / "timestamps.csv", ("frame", "color_us", "apart_us", "source"))
        for _, row in table:
            assert 1e-6 * float(row["color_us"]) == pytest.approx(session.t_s[c][row["source"]], abs=1e-3)
            assert abs(float(row["apart_us"])) <= (0 if c == "C1" else 25_001)  # half a period of 20 Hz
            linked, source = recording.color_files[c][row["frame"]], folder / "wave" / c / "color"
            assert linked.samefile(source / f"{row['source']}.png")
            n += 1
    assert n > 1.8 * 5 * 20 * 0.9
    again = run("sync", folder / "wave", "--apply", timing[0], "-o", tmp_path / "one")
    assert again.status == 2 and "exists" in again.stderr


@pytest.mark.parametrize("kind", ["still", "line"])
def test_a_board_that_does_not_turn_tells_no_clock(run, tmp_path, kind):
    made(tmp_path, kind=kind)
    outcome = run(
        "sync",
        tmp_path / "wave",
        "--rig",
        tmp_path / "rig.yaml",
        "--corners",
        tmp_path / "wave.csv",
        "-o",
        tmp_path / "t.yaml",
    )
    assert outcome.status == 1 and "clocks cannot be determined" in outcome.stderr
    assert not (tmp_path / "t.yaml").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("none", "timestamp of each of"),
        ("jump", "the clock jumped"),
        ("back", "the clock was set"),
    ],
)
def test_stamps_that_say_nothing_are_refused(run, wave, tmp_path, change, said):
    folder, _ = wave
    shutil.copytree(folder / "wave", tmp_path / "wave")
    path = tmp_path / "wave" / "C2" / "timestamps.csv"
    rows = [list(row.values()) for _, row in read_table(path, ("frame", "color_us", "depth_us"))]
    for row in rows[len(rows) // 2 :]:
        row[1] = str(float(row[1]) + {"none": 0, "jump": 2e8, "back": -2e6}[change])
    write_table(path, ("frame", "color_us", "depth_us"), rows[: -1 if change == "none" else None])
    outcome = run(
        "sync",
        tmp_path / "wave",
        "--rig",
        folder / "rig.yaml",
        "--corners",
        folder / "wave.csv",
        "-o",
        tmp_path / "t.yaml",
    )
    assert outcome.status == 2 and said in outcome.stderr and "C2" in outcome.stderr


def test_a_counter_that_wraps_around_is_continued(wave, tmp_path):
    from rgbd_calib.pipeline.carried import WRAP_S, stamps_s

    folder, _ = wave
    shutil.copytree(folder / "wave", tmp_path / "wave")
    path = tmp_path / "wave" / "C2" / "timestamps.csv"
    rows = [list(row.values()) for _, row in read_table(path, ("frame", "color_us", "depth_us"))]
    middle = float(rows[len(rows) // 2][1])
    for row in rows:
        row[1:] = [f"{(float(x) - middle) % (1e6 * WRAP_S):.1f}" for x in row[1:]]
    write_table(path, ("frame", "color_us", "depth_us"), rows)
    stamps, remark = stamps_s(open_recording(tmp_path / "wave"), "C2")
    assert "wrap around" in remark
    steps = np.diff([s for s, _ in stamps.values()])
    assert steps.min() > 0.04 and steps.max() < 0.5


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--method", "biobjective"], "method bundle with a rigid board expected"),
        (["--max-views", "5"], "a selection of 5"),
    ],
)
def test_calibrate_refuses_what_needs_frames_of_one_instant(run, wave, tmp_path, options, said):
    outcome = run(
        "calibrate", wave[0] / "wave", "--corners", wave[0] / "wave.csv", "-o", tmp_path / "rig.yaml", *options
    )
    assert outcome.status == 2 and said in outcome.stderr
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.slow
def test_calibrate_finds_rig_and_clocks_of_a_carried_board(run, wave, tmp_path):
    folder, session = wave
    path = tmp_path / "rig.yaml"
    outcome = run("calibrate", folder / "wave", "--corners", folder / "wave.csv", "-o", path)
    assert outcome.status == 0 and "C2: clock: offset" in outcome.stdout, outcome
    _, clocks = read_timing(path)
    for c, truth in session.clocks.items():
        assert abs(clocks[c].offset_s - truth.offset_s) <= 4 * clocks[c].offset_sd_s < 0.002


def test_results_as_json(run, wave, timing, tmp_path, monkeypatch):
    import rgbd_calib.pipeline.sync

    folder, _ = wave
    applied = run("sync", folder / "wave", "--apply", timing[0], "-o", tmp_path / "one", "--json")
    numbers = json.loads(applied.stdout)
    assert numbers["sets"] == len(open_recording(tmp_path / "one").frames)
    assert 0 < numbers["apart_rms_ms"] <= numbers["apart_worst_ms"] <= 25.001
    monkeypatch.setattr(rgbd_calib.pipeline.sync, "sync", lambda *_: timing[1])  # estimated once for all these tests
    corners = ("--corners", folder / "wave.csv")
    found = run("sync", folder / "wave", "--rig", folder / "rig.yaml", *corners, "-o", tmp_path / "t.yaml", "--json")
    numbers = json.loads(found.stdout)
    assert numbers["reference"] == "C1" and numbers["views_used"] == timing[1].views
    assert numbers["clocks"]["C2"]["offset_s"] == timing[1].clocks["C2"].offset_s
