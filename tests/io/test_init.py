"""`init`: folders as people's scripts write them are understood by names, types and what the images show."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recording import BOARD, FOCAL_PX, HEIGHT, WIDTH, draw_recording

from rgbd_calib.cli import init as command
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.io.sniff import Sniffed, sniff
from rgbd_calib.views.board_guess import BoardGuess, guess_board
from rgbd_calib.views.depth_scale import likely_factor, name_factor, unit_of_depth

BOARD_OPTIONS = ("--board", "9x6", "--square", "0.06")


def test_files_are_sniffed_by_their_header(tmp_path):
    rng = np.random.default_rng(0)
    color, raw = rng.integers(0, 255, (6, 8, 3), np.uint8), rng.integers(0, 999, (6, 8)).astype(np.uint16)
    cases = {
        "a.png": (color, "color"),
        "b.jpg": (color, "color"),
        "c.png": (color[..., 0], "grey 8"),
        "d.png": (raw, "grey 16"),
        "e.tiff": (raw, "grey 16"),
        "f.tiff": (raw.astype(np.float32), "float"),
        "g.pgm": (raw, "grey 16"),
    }
    for name, (image, pixels) in cases.items():
        cv2.imwrite(str(tmp_path / name), image)
        assert sniff(tmp_path / name) == Sniffed(pixels, 8, 6)
    np.save(tmp_path / "h.npy", raw.astype(np.float64))
    assert sniff(tmp_path / "h.npy") == Sniffed("float", 8, 6)
    (tmp_path / "i.png").write_bytes(b"none")
    assert sniff(tmp_path / "i.png") is None and sniff(tmp_path / "absent.png") is None


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    return draw_recording(tmp_path_factory.mktemp("drawn") / "r", 2, 10)


def lay_out(drawn: Path, folder: Path, color: str, depth: str | None, write_depth=None) -> Path:
    """The drawn recording under other names, without dataset.yaml; `write_depth(path, raw)` writes another type."""
    recording = open_recording(drawn)
    for camera in recording.cameras:
        for frame, path in recording.color_files[camera].items():
            target = folder / color.format(camera=camera, frame=frame)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
            if depth is None:
                continue
            target = folder / depth.format(camera=camera, frame=frame)
            target.parent.mkdir(parents=True, exist_ok=True)
            raw = cv2.imread(str(recording.depth_files[camera][frame]), cv2.IMREAD_UNCHANGED)
            (write_depth or (lambda p, r: cv2.imwrite(str(p), r)))(target, raw)
    return folder


def in_metres(path: Path, raw: np.ndarray) -> None:
    cv2.imwrite(str(path), (raw / 1000).astype(np.float32))


def test_a_folder_becomes_a_recording_where_it_is(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "rgb_{camera}_{frame}.png", "{camera}/depth_{frame}.tiff", in_metres)
    before = sorted(folder.rglob("*"))
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 0, out.stderr
    assert "C1: 10 colour images 640x480 (rgb_C1_{frame}.png); 10 depth images 640x480, floating point" in out.stderr
    assert "10 frames are in two cameras or more" in out.stderr
    assert "C1: floating-point depth in metres" in out.stderr
    assert sorted(folder.rglob("*")) == sorted([*before, folder / "dataset.yaml"])
    recording, original = open_recording(folder), open_recording(drawn)
    assert recording.board == BOARD and recording.unused == ()
    np.testing.assert_allclose(recording.depth_m("C2", "000003"), original.depth_m("C2", "000003"), rtol=1e-6)
    again = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert again.status == 2 and "exists already" in again.stderr
    assert run("init", folder, *BOARD_OPTIONS, "--yes", "--overwrite").status == 0


@pytest.mark.parametrize("unit_m", [0.001, 0.0002, 0.00025, 0.0001])
def test_the_unit_of_depth_is_concluded_from_the_board(run, drawn, tmp_path, unit_m):
    def write(path, raw):
        scaled = raw * (0.001 / unit_m)
        cv2.imwrite(str(path), np.where(scaled < 65535, scaled, 0).astype(np.uint16))

    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png", write)
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 0, out.stderr
    assert f"C1: {unit_m:g} m for each unit of depth, by the board's size in" in out.stderr
    data = load_yaml(folder / "dataset.yaml")
    assert data["cameras"]["C2"]["depth_scale"] == unit_m and "files" not in data


def test_a_unit_that_nothing_tells_is_asked_for(run, drawn, tmp_path, monkeypatch):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    out = run("init", folder, "--yes")
    assert out.status == 2 and "there is no board to tell it by" in out.stderr and "--depth-scale (0.001" in out.stderr
    assert "Board: 9x6 inner corners in" in out.stderr and not (folder / "dataset.yaml").exists()
    wrong = run("init", folder, "--board", "9x6", "--square", "0.045", "--yes")
    assert wrong.status == 2 and "(0.001 m would need squares of 60" in wrong.stderr and "45 mm stated" in wrong.stderr
    assert run("init", folder, "--yes", "--depth-scale", "0.001").status == 0
    assert open_recording(folder).board is None


def test_on_a_terminal_it_asks_what_images_do_not_tell(run, drawn, tmp_path, monkeypatch):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    asked = []
    answers = iter(["9x6", "0.06", "0.006", "y"])

    def ask(question, default):
        asked.append((question, default))
        return next(answers)

    monkeypatch.setattr(command, "_ask", ask)
    monkeypatch.setattr(command.sys, "stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr(command.sys.stderr, "isatty", lambda: True, raising=False)
    assert run("init", folder).status == 0
    assert [default for _, default in asked] == ["9x6", "", "", "y"]
    board = open_recording(folder).board
    assert board.two_sided and board.thickness_m == 0.006 and board.square_m == 0.06


def test_a_dry_run_writes_nothing(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}_{frame}.png", None)
    out = run("init", folder, *BOARD_OPTIONS, "--yes", "--dry-run")
    assert out.status == 0 and not (folder / "dataset.yaml").exists()
    (folder / "dataset.yaml").write_text(out.stdout)
    assert open_recording(folder).files == FilePatterns("{camera}_{frame}.png")


def test_depth_of_half_the_size(run, drawn, tmp_path):
    def halve(path, raw):
        cv2.imwrite(str(path), raw[::2, ::2])

    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png", halve)
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 0 and "taken as not registered (--registered if it is)" in out.stderr, out.stderr
    own = open_recording(folder).cameras["C1"].depth
    assert (own.width, own.height, own.T_color_depth) == (320, 240, None)
    assert run("init", folder, *BOARD_OPTIONS, "--yes", "--overwrite", "--registered").status == 0
    own = open_recording(folder).cameras["C1"].depth
    np.testing.assert_array_equal(own.T_color_depth, np.eye(4))
    from rgbd_calib.geometry.camera import Intrinsics

    camera = own.camera(Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, 319.5, 239.5))
    assert (camera.intrinsics.fx, camera.intrinsics.cx, camera.intrinsics.cy) == (FOCAL_PX / 2, 159.5, 119.5)


def test_lenses_of_a_calibration_file_in_the_folder(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", None)
    chain = {
        f"cam{i}": {
            "camera_model": "pinhole",
            "intrinsics": [FOCAL_PX + i, FOCAL_PX, 319.5, 239.5],
            "distortion_model": "radtan",
            "distortion_coeffs": [0.0] * 4,
            "resolution": [WIDTH, HEIGHT],
            "rostopic": f"/c{i + 1}/image_raw",
        }
        for i in (0, 1)
    }
    (folder / "camchain.yaml").write_text(dump_yaml(chain))
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 0 and "camchain.yaml: Kalibr camchain, of c1, c2" in out.stderr
    assert open_recording(folder).cameras["C2"].intrinsics.fx == FOCAL_PX + 1


def test_patterns_of_the_user(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "x{camera}y{frame}.png", "d{frame}z{camera}.png")
    patterns = ("--color", "x{camera}y{frame}.png", "--depth", "d{frame}z{camera}.png")
    assert run("init", folder, *BOARD_OPTIONS, "--yes", *patterns).status == 0
    recording = open_recording(folder)
    assert list(recording.cameras) == ["C1", "C2"] and recording.has_depth("C1", "000000")
    nothing = run("init", folder, "--overwrite", "--yes", "--color", "nothing_{camera}_{frame}.png")
    assert nothing.status == 2 and "no file is named as --color nothing_" in nothing.stderr
    assert run("init", folder, "--overwrite", "--yes", "--depth", "d{frame}z{camera}.png").status == 2


def test_what_is_no_folder(run, tmp_path):
    assert "no such folder" in run("init", tmp_path / "absent").stderr
    (tmp_path / "empty").mkdir()
    out = run("init", tmp_path / "empty")
    assert out.status == 2 and "no colour images found" in out.stderr


def test_the_board_is_the_one_that_images_agree_on(drawn):
    recording = open_recording(drawn)
    images = [recording.color("C1", frame) for frame in recording.frames[:6]]
    found = guess_board(images)
    assert isinstance(found, BoardGuess) and (found.cols, found.rows) == (9, 6) and found.looked_at == 6
    assert guess_board([np.full((100, 100, 3), 128, np.uint8)] * 3) is None


@pytest.mark.parametrize(
    ("name", "size"),
    [("realsense3", (10, 6)), ("kinect2_20", (7, 5)), ("kinect1_xw", (10, 7)), ("percipio4_vga", (9, 6))],
)
def test_boards_of_real_recordings(real_data, name, size):
    recording = open_recording(real_data(name))
    pairs = [(c, f) for c, files in recording.color_files.items() for f in files]
    found = guess_board(
        recording.color(*pairs[i]) for i in np.linspace(0, len(pairs) - 1, min(8, len(pairs))).astype(int)
    )
    assert found is not None and (found.cols, found.rows) == size


@pytest.mark.parametrize(
    ("ratio", "factor"),
    [(1.0, None), (1.08, None), (1.25, 1.25), (0.8, 0.8), (4.9, 5), (0.21, 0.2), (10.4, 10), (980, 1000), (1.6, None)],
)
def test_factors_between_units_have_names(ratio, factor):
    found = likely_factor(ratio)
    assert found is None if factor is None else found == pytest.approx(factor)
    assert bool(name_factor(ratio)) == (factor is not None)


def test_a_unit_is_told_only_where_one_fits():
    raw, distance_m = np.array([5000.0, 5100, 4900]), np.ones(3)
    assert unit_of_depth(raw, distance_m) == 0.0002
    assert unit_of_depth(raw, distance_m, within=1.5) is None  # 0.00025 fits as well
    assert unit_of_depth(np.array([np.nan]), np.ones(1)) is None
    assert unit_of_depth(np.array([1600.0]), np.ones(1)) is None


def test_doctor_names_the_factor(run, drawn, tmp_path):
    folder = Path(shutil.copytree(drawn, tmp_path / "f"))
    data = load_yaml(folder / "dataset.yaml")
    data["cameras"]["C1"]["depth_scale"] = 0.0002
    (folder / "dataset.yaml").write_text(dump_yaml(data))
    out = run("doctor", folder).stdout
    assert "! C1: measured depth is 0.2" in out and "depth_scale looks 5 times too small" in out
    assert "C2: measured depth is" not in out


def test_a_file_that_cannot_be_read_is_named(drawn, run, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/{frame}.png", None)
    pipe = sorted(folder.glob("*/*.png"))[0]
    pipe.unlink()
    os.mkfifo(pipe)
    told = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert f"{pipe.relative_to(folder).as_posix()} cannot be read" in told.stderr


@pytest.mark.parametrize(
    ("depth", "needle"),
    [
        ("{camera}/depth_{frame}.exr", "Import: rgbd-calib import"),
        ("{camera}/depth_{frame}.raw", "neither size nor type. Write depth as 16-bit PNG"),
    ],
)
def test_depth_that_is_not_read_where_it_is_leaves_nothing(run, drawn, tmp_path, depth, needle):
    folder = lay_out(
        drawn, tmp_path / "f", "{camera}/color_{frame}.png", depth, lambda path, raw: path.write_bytes(raw.tobytes())
    )
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 2 and needle in out.stderr
    assert not (folder / "dataset.yaml").exists()


def test_names_that_are_times_are_joined_by_an_import(run, drawn, tmp_path):
    """The clock of the second camera, and that of depth, say another time than the first camera's colour does."""
    folder, original = tmp_path / "f", open_recording(drawn)
    for n, camera in enumerate(original.cameras):
        for i, frame in enumerate(original.frames):
            for k, (kind, files) in enumerate((("rgb", original.color_files), ("depth", original.depth_files))):
                path = folder / camera / kind / f"{1_697_000_000_000 + 200 * i + 7 * n + 3 * k}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(files[camera][frame], path)
    out = run("init", folder, *BOARD_OPTIONS, "--yes")
    assert out.status == 2 and "Join them by time: rgbd-calib import" in out.stderr
    joined = run("import", folder, "-o", tmp_path / "out", *BOARD_OPTIONS)
    assert joined.status == 0 and "names of files are times" in joined.stderr, joined.stderr
    recording = open_recording(tmp_path / "out")
    for camera in recording.cameras:
        assert recording.depth_files[camera].keys() == recording.color_files[camera].keys() == set(recording.frames)
    assert len(recording.frames) == len(original.frames)
    assert recording.timestamps_us("C2")[recording.frames[1]] == (207_000, 210_000)


def test_names_with_a_dot_are_read_by_a_pattern_of_any_suffix(run, drawn, tmp_path):
    folder, original = tmp_path / "f", open_recording(drawn)
    for camera in original.cameras:
        for i, frame in enumerate(original.frames):
            path = folder / camera / "color" / f"{0.1234 + i / 7:.4f}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(original.color_files[camera][frame], path)
    out = run("import", folder, "-o", tmp_path / "out", *BOARD_OPTIONS)
    assert out.status == 0, out.stderr
    assert open_recording(tmp_path / "out").frames[0] == "0.1234"


def test_the_step_of_floating_point_depth_is_no_metre(run, drawn, tmp_path):
    """Metres for each unit are 1 there, and the sensor's rounding is not: else depth would have no weight."""
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.tiff", in_metres)
    assert run("init", folder, *BOARD_OPTIONS, "--yes").status == 0
    info = open_recording(folder).cameras["C1"]
    assert (info.depth_scale, info.depth_step_m) == (1.0, 0.001)
    rigs = {}
    for name, recording in (("float", folder), ("integer", drawn)):
        done = run("calibrate", recording, "-o", tmp_path / f"{name}.yaml")
        assert done.status == 0, done.stderr
        rigs[name] = read_rig(tmp_path / f"{name}.yaml")
    mean_mm = {name: rig.quality.expected_alignment.mean_mm for name, rig in rigs.items()}
    assert mean_mm["float"] == pytest.approx(mean_mm["integer"], rel=0.05)


def test_another_board_than_the_one_seen_is_named(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    out = run("init", folder, "--board", "10x7", "--square", "0.06", "--yes")
    assert out.status == 2 and "--board 10x7 expected in the images, 9x6 inner corners seen in" in out.stderr
    lacking = run("init", folder, "--board", "9x6", "--yes")
    assert lacking.status == 2 and "--square M expected beside it" in lacking.stderr
    assert not (folder / "dataset.yaml").exists()


def test_a_square_of_ten_times_is_doubted(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    out = run("init", folder, "--board", "9x6", "--square", "0.6", "--yes")
    assert "if depth is in millimetres, the squares would be 60 mm: check --square" in out.stderr


def test_a_pattern_of_depth_is_no_colour(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    out = run("init", folder, *BOARD_OPTIONS, "--yes", "--color", "{camera}/depth/{frame}.png")
    assert out.status == 2 and "8 bits a channel expected for --color, grey 16 seen" in out.stderr


def test_a_file_in_place_of_a_recording_is_told_the_way(run, tmp_path):
    for name, needle in (("a.mkv", "Import it: rgbd-calib import"), ("a.zip", "Import it")):
        (tmp_path / name).write_bytes(b"x")
        out = run("calibrate", tmp_path / name, "-o", tmp_path / "x.yaml")
        assert out.status == 2 and needle in out.stderr
    packed = run("import", tmp_path / "a.zip", "-o", tmp_path / "r")
    assert packed.status == 2 and "an archive seen. Unpack it" in packed.stderr


def test_what_was_found_and_imported_as_json(run, drawn, tmp_path):
    folder = lay_out(drawn, tmp_path / "f", "{camera}/color/{frame}.png", "{camera}/depth/{frame}.png")
    described = json.loads(run("init", folder, *BOARD_OPTIONS, "--yes", "--json").stdout)
    assert described["images"] == {c: {"color": 10, "depth": 10} for c in ("C1", "C2")}
    assert described["frames_together"] == 10 and any("0.001 m for each unit" in r for r in described["remarks"])
    written = json.loads(run("import", folder, "-o", tmp_path / "r", "--json").stdout)
    assert written["frames"] == 10 and written["images"]["C2"] == {"color": 10, "depth": 10, "ir": 0}


@pytest.mark.parametrize("kind", ["mirrored", "of other frames", "disparity"])
def test_depth_that_does_not_follow_the_board_is_no_unit(run, drawn, tmp_path, kind):
    """No --depth-scale mends these."""
    recording = open_recording(drawn)
    for camera in recording.cameras:
        for i, frame in enumerate(recording.frames):
            other = recording.frames[(i + 2) % len(recording.frames)] if kind == "of other frames" else frame
            depth = cv2.imread(str(recording.depth_files[camera][other]), cv2.IMREAD_UNCHANGED)
            if kind == "mirrored":
                depth = np.ascontiguousarray(depth[:, ::-1])
            if kind == "disparity":
                depth = np.where(depth > 0, 4e7 / np.maximum(depth, 700.0), 0).astype(np.uint16)
            for name, image in (("color", recording.color(camera, frame)), ("depth", depth)):
                path = tmp_path / "in" / camera / name / f"{frame}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), image)
    out = run("init", tmp_path / "in", "--board", "9x6", "--square", "0.06", "--yes")
    assert out.status == 2
    assert "depth does not follow the board" in out.stderr and "look at a pair" in out.stderr
