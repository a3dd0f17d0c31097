"""Recordings in other layouts and file types, depth that cannot be read, files that nobody reads, unknown keys."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recording import draw_recording

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry, read_dataset, write_dataset
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.recording import open_recording, save_color, save_depth

WIDTH, HEIGHT = 8, 6
DEPTH = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 100
LENS = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0, "distortion": [0.0] * 5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras of 8 x 6 px with depth, two frames."""
    path = tmp_path / "recording"
    for camera in ("C1", "C2"):
        for frame in ("000000", "000001"):
            save_color(path, camera, frame, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
            save_depth(path, camera, frame, DEPTH)
    write_dataset(path, {c: CameraInfo(WIDTH, HEIGHT) for c in ("C1", "C2")}, None)
    return path


def edit(folder: Path, change) -> None:
    data = load_yaml(folder / "dataset.yaml")
    change(data)
    (folder / "dataset.yaml").write_text(dump_yaml(data))


def expected_m(unit_m: float = 0.001) -> np.ndarray:
    return np.where(DEPTH == 0, np.nan, DEPTH * unit_m)


def rewrite_depth(folder: Path, write) -> None:
    """Another type of file in place of each depth image: `write(path without suffix, raw)`."""
    for path in folder.glob("*/depth/*.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        path.unlink()
        write(path.with_suffix(""), raw)


def write_tiff(stem: Path, image: np.ndarray, compression: int = 1) -> None:
    cv2.imwrite(str(stem.with_suffix(".tiff")), image, [cv2.IMWRITE_TIFF_COMPRESSION, compression])


@pytest.mark.parametrize("compression", [1, 5, 8], ids=["none", "LZW", "deflate"])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_depth_in_tiff(folder, dtype, compression):
    in_m = dtype == np.float32
    rewrite_depth(folder, lambda stem, raw: write_tiff(stem, (raw / 1000 if in_m else raw).astype(dtype), compression))
    np.testing.assert_allclose(open_recording(folder).depth_m("C1", "000001"), expected_m(), rtol=1e-7)


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float16, np.float32, np.float64])
def test_depth_in_npy(folder, dtype):
    in_m = np.dtype(dtype).kind == "f"
    rewrite_depth(folder, lambda stem, raw: np.save(stem, (raw / 1000 if in_m else raw).astype(dtype)))
    depth_m = open_recording(folder).depth_m("C1", "000000")
    np.testing.assert_allclose(depth_m, expected_m(), rtol=1e-3 if dtype == np.float16 else 1e-7)


def test_floating_point_depth_in_millimetres_is_refused_until_that_is_said(folder):
    rewrite_depth(folder, lambda stem, raw: write_tiff(stem, raw.astype(np.float32)))
    with pytest.raises(ConfigError, match=r"2400 m in the median seen.*scale_m: 0.001"):
        open_recording(folder).depth_m("C1", "000000")
    edit(folder, lambda data: data["cameras"]["C1"].update(depth={"scale_m": 0.001}))
    np.testing.assert_allclose(open_recording(folder).depth_m("C1", "000000"), expected_m(), rtol=1e-7)


def test_floats_that_are_no_number_are_no_measurement(folder):
    special = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    special[0, :5] = np.nan, np.inf, -np.inf, -1, 0
    rewrite_depth(folder, lambda stem, raw: write_tiff(stem, special))
    depth_m = open_recording(folder).depth_m("C1", "000000")
    assert np.isnan(depth_m[0, :5]).all() and np.isfinite(depth_m[0, 5:]).all()


def test_values_that_mean_no_measurement(folder):
    raw = DEPTH.copy()
    raw[0, :3] = 65535, 2047, 0
    save_depth(folder, "C1", "000000", raw)
    assert np.isnan(open_recording(folder).depth_m("C1", "000000")[0, :3]).tolist() == [True, False, True]
    edit(folder, lambda data: data["cameras"]["C1"].update(depth={"invalid": [2047]}))
    assert np.isnan(open_recording(folder).depth_m("C1", "000000")[0, :3]).all()


def test_a_numpy_file_that_is_no_image_is_refused(folder):
    rewrite_depth(folder, lambda stem, raw: np.save(stem, np.array([{"a": 1}], dtype=object)))
    with pytest.raises(ConfigError, match="damaged or no image"):
        open_recording(folder).depth_m("C1", "000000")


def move(source: str, target: str):
    def change(folder: Path) -> None:
        for camera in ("C1", "C2"):
            (folder / camera / source).rename(folder / camera / "moving")
            (folder / camera / target).parent.mkdir(exist_ok=True, parents=True)
            (folder / camera / "moving").rename(folder / camera / target)

    return change


def rename_depth(form: str):
    def change(folder: Path) -> None:
        for path in list(folder.glob("*/depth/*.png")):
            path.rename(path.with_name(form.format(path.stem)))

    return change


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (rename_depth("depth_{}.png"), "C1: none of its 2 depth images has the name.*depth_000000.* and 000000"),
        (rename_depth("{}.exr"), r"C1/depth is there, and no depth image can be read \(2 .exr in C1/depth"),
        (move("depth", "Depth"), r"C1/Depth is there, .*2 .png in C1/Depth \(as 000000.png\)"),
        (move("depth", "depth/sensor"), r"C1/depth is there, .*2 .png in C1/depth/sensor"),
        (
            lambda f: [shutil.rmtree(f / c / "depth") or (f / c / "depth").mkdir() for c in ("C1", "C2")],
            "no other files",
        ),
        (
            lambda f: (
                [(f / c / "depth").rename(f / f"raw{c}") for c in ("C1", "C2")]
                and edit(f, lambda d: d.update(depth_scale=0.001))
            ),
            "dataset.yaml states a depth scale, and no depth image can be read.*2 .png in rawC1",
        ),
        (
            lambda f: (
                (f / "C2/depth").rename(f / "other") and edit(f, lambda d: d["cameras"]["C2"].update(depth_scale=0.001))
            ),
            "camera C2: dataset.yaml states its depth, and no depth image can be read.*2 .png in other",
        ),
    ],
)
def test_depth_that_is_expected_and_cannot_be_read_is_an_error(folder, change, needle):
    change(folder)
    with pytest.raises(ConfigError, match=needle) as caught:
        open_recording(folder)
    assert "rgbd-calib init" in str(caught.value)


def test_a_camera_without_depth_needs_none(folder):
    shutil.rmtree(folder / "C2" / "depth")
    assert open_recording(folder).depth_files["C2"] == {}


def test_files_that_nobody_reads_are_counted(folder):
    assert open_recording(folder).unused == () and open_recording(folder).remarks == ()
    (folder / "C1" / "masks").mkdir()
    (folder / "C1" / "masks" / "a.bin").write_bytes(b"")
    (folder / "C1" / "color" / "000000.heic").write_bytes(b"")
    (folder / "C1" / "timestamps.csv").write_text("frame,color_us,depth_us\n")
    (folder / "C2" / "color" / "000001.png").unlink()  # its depth image is then of no frame
    save_color(folder, "C3", "000000", np.zeros((2, 2, 3), np.uint8))
    (folder / "notes.txt").write_text("")
    (folder / "C1" / ".hidden").write_text("")
    recording = open_recording(folder)
    assert recording.unused == (
        "C1/color/000000.heic",
        "C1/masks/a.bin",
        "C2/depth/000001.png",
        "C3/color/000000.png",
    )
    assert "4 files are not read: 1 .heic in C1/color (as 000000.heic)" in recording.remarks[0]


def test_doctor_and_calibrate_name_what_is_not_read(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 2)
    (path / "C1" / "confidence").mkdir()
    (path / "C1" / "confidence" / "000000.raw").write_bytes(b"")
    said = "1 files are not read: 1 .raw in C1/confidence (as 000000.raw)"
    assert said in run("doctor", path).stdout
    assert f"Warning: {path}: {said}" in run("calibrate", path, "-o", tmp_path / "rig.yaml").stderr


@pytest.mark.parametrize(
    "files",
    [
        {"color": "rgb_{camera}_{frame}.png", "depth": "depth_{camera}_{frame}.png"},
        {"color": "{frame}/{camera}-rgb.png", "depth": "{frame}/{camera}-depth.png"},
        {"color": "color/{camera}/{camera}_{frame}.color.png", "depth": "depth.{camera}/f{frame}.png"},
    ],
)
def test_patterns_name_files_of_another_layout(folder, files):
    original = open_recording(folder)
    moved = folder.parent / "moved"
    for kind, of_camera in (("color", original.color_files), ("depth", original.depth_files)):
        for camera, paths in of_camera.items():
            for frame, path in paths.items():
                target = moved / files[kind].format(camera=camera, frame=frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)
    shutil.copy(folder / "dataset.yaml", moved)
    edit(moved, lambda data: data.update(files=files))
    recording = open_recording(moved)
    assert recording.frames == original.frames and recording.unused == ()
    np.testing.assert_array_equal(recording.depth_m("C2", "000001"), original.depth_m("C2", "000001"))
    assert recording.only("C1", "000000").color("C1", "000000").shape == (HEIGHT, WIDTH, 3)
    (moved / "rgb_C9_000000.png").write_bytes(b"")
    assert open_recording(moved).unused == ("rgb_C9_000000.png",)


@pytest.mark.parametrize(
    ("color", "needle"),
    [
        ("/tmp/{camera}_{frame}.png", "a path inside the recording"),
        ("../{camera}_{frame}.png", "a path inside the recording"),
        ("{camera}.png", "{frame} is missing"),
        ("{frame}.png", "{camera} is missing"),
        ("{camera}_{frame}_{index}.png", "all that a pattern may have in braces"),
        ("{camera}_{frame.png", "all that a pattern may have in braces"),
        (7, "files.color: 7 seen"),
    ],
)
def test_a_wrong_pattern_is_refused(folder, color, needle):
    edit(folder, lambda data: data.update(files={"color": color}))
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder)


def test_two_files_of_one_image_are_refused(folder):
    edit(
        folder, lambda data: data.update(files={"color": "{camera}/color/{frame}.png", "depth": "{camera}/{frame}.png"})
    )
    shutil.copy(folder / "C1/color/000000.png", folder / "C1/color/000000.jpg")
    with pytest.raises(ConfigError, match="one image a frame needed"):
        edit(folder, lambda data: data.pop("files"))
        open_recording(folder)


def test_a_pattern_of_one_camera_needs_no_name(tmp_path):
    for frame in "012":
        cv2.imwrite(str(tmp_path / f"frame-00{frame}.color.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        cv2.imwrite(str(tmp_path / f"frame-00{frame}.depth.png"), DEPTH)
    files = FilePatterns("frame-{frame}.color.png", "frame-{frame}.depth.png")
    write_dataset(tmp_path, {"C1": CameraInfo(WIDTH, HEIGHT)}, None, files=files)
    recording = open_recording(tmp_path)
    assert recording.files == files and recording.frames == ("000", "001", "002") and recording.has_depth("C1", "002")


@pytest.fixture
def unregistered(folder) -> Path:
    """C1's depth is 4 x 3 px, with an infrared image; C2's is registered."""
    for frame in ("000000", "000001"):
        save_depth(folder, "C1", frame, DEPTH[:3, :4])
    (folder / "C1" / "ir").mkdir()
    cv2.imwrite(str(folder / "C1" / "ir" / "000000.png"), DEPTH[:3, :4])
    T = np.eye(4)
    T[0, 3] = -0.05
    depth = {
        "width": 4,
        "height": 3,
        "intrinsics": {**LENS, "sd": [1.0] * 9},
        "T_color_depth": T.tolist(),
        "invalid": [7],
    }
    edit(folder, lambda data: data.update(depth_registered=False) or data["cameras"]["C1"].update(depth=depth))
    return folder


def test_depth_with_a_geometry_of_its_own(unregistered):
    recording = open_recording(unregistered)
    own = recording.cameras["C1"].depth
    assert own is not None and own.intrinsics is not None and own.T_color_depth is not None
    assert (own.width, own.height, own.intrinsics.fx, own.T_color_depth[0, 3]) == (4, 3, 5.0, -0.05)
    assert own.intrinsics_sd == (1.0,) * 9 and recording.cameras["C1"].invalid == (7.0,)
    assert recording.depth_own_m("C1", "000000").shape == (3, 4) and recording.ir("C1", "000000").dtype == np.uint16
    assert not recording.depth_registered and recording.cameras["C2"].depth is None
    assert recording.depth_m("C2", "000000").shape == (HEIGHT, WIDTH)
    with pytest.raises(ConfigError, match="depth of camera C1 is not registered to colour"):
        recording.depth_m("C1", "000000")
    save_depth(unregistered, "C1", "000001", DEPTH)
    with pytest.raises(ConfigError, match=r"8x6 px seen, dataset\.yaml says for depth 4x3"):
        recording.depth_own_m("C1", "000001")


@pytest.mark.parametrize(
    ("name", "camera", "size", "has_ir"),
    [("kinect1_xw", "kinect", (480, 640), False), ("kinect2_20", "kinect2", (424, 512), True)],
)
def test_depth_of_a_kinect_has_its_own_geometry(real_data, name, camera, size, has_ir):
    recording = open_recording(real_data(name))
    own = recording.cameras[camera].depth
    assert not recording.depth_registered and own is not None and own.intrinsics is not None
    assert own.T_color_depth is not None and not recording.remarks
    frame = next(iter(recording.depth_files[camera]))
    depth_m = recording.depth_own_m(camera, frame)
    assert depth_m.shape == size == (own.height, own.width) and 0.4 < np.nanmedian(depth_m) < 4
    assert bool(recording.ir_files[camera]) == has_ir
    if has_ir:
        assert recording.ir(camera, frame).shape == size


def test_depth_cameras_there_and_back(unregistered, tmp_path):
    first = open_recording(unregistered)
    write_dataset(tmp_path, first.cameras, first.board, synchronous=False)
    back = read_dataset(tmp_path / "dataset.yaml")
    own, again = first.cameras["C1"].depth, back.cameras["C1"].depth
    assert (
        isinstance(own, DepthGeometry) and isinstance(again, DepthGeometry) and isinstance(own.intrinsics, Intrinsics)
    )
    assert again.intrinsics == own.intrinsics and again.intrinsics_sd == own.intrinsics_sd
    np.testing.assert_array_equal(again.T_color_depth, own.T_color_depth)
    assert back.cameras["C1"].invalid == (7.0,) and back.cameras["C2"] == first.cameras["C2"] and not back.synchronous


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (
            lambda d: d.pop("depth_registered"),
            "depth of C1 has a geometry of its own, and depth_registered is not false",
        ),
        (lambda d: d["cameras"]["C1"]["depth"].pop("width"), "width and height of its depth images are needed"),
        (
            lambda d: d["cameras"]["C1"]["depth"]["intrinsics"].update(width=8),
            "intrinsics are for 8x3 px, depth has 4x3",
        ),
        (lambda d: d["cameras"]["C1"]["depth"]["T_color_depth"][0].__setitem__(3, -52.0), "Is it in millimetres"),
        (lambda d: d["cameras"]["C1"]["depth"]["T_color_depth"][0].__setitem__(0, 2.0), "not a rigid motion"),
        (
            lambda d: (
                d["cameras"]["C1"].update(depth_scale=0.0002) or d["cameras"]["C1"]["depth"].update(scale_m=0.001)
            ),
            "Take one out",
        ),
        (lambda d: d["cameras"]["C1"]["depth"]["intrinsics"].update(sd=[1.0]), "sd: 1 numbers seen, 9 needed"),
    ],
)
def test_a_wrong_depth_block_is_refused(unregistered, change, needle):
    edit(unregistered, change)
    with pytest.raises(ConfigError, match=needle):
        open_recording(unregistered)


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (
            lambda d: d.update(depth_scal=0.001),
            r"line \d+: \(top level\): no such key 'depth_scal'; did you mean 'depth_scale'",
        ),
        (
            lambda d: d.pop("depth_registered") and d.update(registered=False),
            r"no such key 'registered'; did you mean 'depth_registered'",
        ),
        (lambda d: d.update(sync=False), r"no such key 'sync'"),
        (
            lambda d: d["cameras"]["C1"].update(scale=0.0002),
            r"line \d+: cameras.C1: no such key 'scale'; did you mean 'depth_scale'",
        ),
        (
            lambda d: d["cameras"]["C1"].update(
                intrinsics={"width": 8, "height": 6, "fx": 9, "fy": 9, "cx": 4, "cy": 3, "distorsion": [0.1] * 5}
            ),
            r"line 15: cameras.C1.intrinsics: no such key 'distorsion'; did you mean 'distortion'",
        ),
        (
            lambda d: d.update(board={"cols": 9, "rows": 6, "square": 0.06, "color": "red", "by": "me"}),
            r"line \d+: board: no such key 'color', nor 'by'; ",
        ),
        (
            lambda d: d["cameras"]["C1"].update(depth={"unit": 1}),
            r"cameras.C1.depth: no such key 'unit'; known are width",
        ),
        (lambda d: d.update(files={"colour": "{camera}_{frame}.png"}), "did you mean 'color'"),
    ],
)
def test_an_unknown_key_is_named_with_its_line(folder, change, needle):
    edit(folder, change)
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder)


def test_the_line_is_that_of_the_key(folder):
    text = (folder / "dataset.yaml").read_text().replace("width: 8", "width: 8\n    scale: 1", 1)
    (folder / "dataset.yaml").write_text(text)
    line = 1 + text.splitlines().index("    scale: 1")
    with pytest.raises(ConfigError, match=f"dataset.yaml: line {line}: cameras.C1: no such key"):
        open_recording(folder)


def test_notes_are_kept_anywhere(folder):
    edit(folder, lambda d: d.update(notes={"by": "me"}) or d["cameras"]["C1"].update(notes="left of the door"))
    assert open_recording(folder).extra == {"notes": {"by": "me"}}


def test_clocks_that_are_not_one(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 2)
    edit(path, lambda d: d.update(synchronous=False))
    assert not open_recording(path).synchronous
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 2 and "a colour timestamp of each of 2 frames expected" in out.stderr


def shift_frames(path: Path, camera: str) -> None:
    for image in list(path.glob(f"{camera}/*/*.png")):
        image.rename(image.with_name(f"{100000 + int(image.stem):06d}.png"))


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    """9 before 10: checks over time go by it."""
    for stem in ("10", "9", "2", "11"):
        save_color(tmp_path, "C1", stem, np.zeros((48, 64, 3), np.uint8))
    write_dataset(tmp_path, {"C1": CameraInfo(64, 48)}, None)
    recording = open_recording(tmp_path)
    assert recording.frames == ("2", "9", "10", "11") == tuple(recording.color_files["C1"])


def test_frames_that_never_have_the_same_name(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 3)
    shift_frames(path, "C2")
    said = "C1, C2: no frame has the name of another camera's frame.*C1: 000000, 000001, 000002; C2: 100000, 100001, 100002"
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 1
    assert _found(said, out.stderr) and "--match order" in out.stderr
    found = run("doctor", path).stdout
    assert any(line.startswith("- ") and _found(said, line) for line in found.splitlines())
    for camera, offset in (("C1", 0), ("C2", 100000)):
        rows = "".join(f"{offset + i:06d},{i * 33333},\n" for i in range(3))
        (path / camera / "timestamps.csv").write_text(f"frame,color_us,depth_us\n{rows}")
    found = run("doctor", path).stdout
    assert any(
        line.startswith("! ") and _found(said, line) and "--match timestamp" in line for line in found.splitlines()
    )


def test_cameras_filmed_one_after_the_other_have_no_name_in_common(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 3)
    shift_frames(path, "C2")
    for camera, offset in (("C1", 0), ("C2", 100000)):
        rows = "".join(f"{offset + i:06d},{(offset + i) * 33333},\n" for i in range(3))
        (path / camera / "timestamps.csv").write_text(f"frame,color_us,depth_us\n{rows}")
    assert "no frame has the name" not in run("doctor", path).stdout


def test_one_camera_of_three_whose_names_differ(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 3, 2)
    shift_frames(path, "C3")
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 1 and _found("C3: no frame has the name of another", out.stderr)


def _found(pattern: str, text: str) -> bool:
    return re.search(pattern, text) is not None
