"""What dataset.yaml says: depth with a geometry of its own, unknown keys, notes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_recording import DEPTH, HEIGHT, WIDTH, edit

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.dataset import DepthGeometry, read_dataset, write_dataset
from rgbd_calib.io.recording import open_recording, save_depth

LENS = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0, "distortion": [0.0] * 5}


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
