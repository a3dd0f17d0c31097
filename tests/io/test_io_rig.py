"""Rig files: bit for bit there and back; every wrong key is named with what is needed."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io import safe_yaml
from rgbd_calib.io.rig import (
    read_boards,
    read_depth_bias,
    read_intrinsics,
    read_rig,
    write_depth_bias,
    write_intrinsics,
    write_rig,
)
from rgbd_calib.quality import CameraStatistics, Quality
from rgbd_calib.simulation.depth_field import structured_light
from rgbd_calib.types import DepthBias, Rig, RigCamera

LENS = Intrinsics(640, 480, 571.2, 569.8, 318.4, 243.2, (0.06, -0.11, 0.0008, -0.0013, 0.045))
BIAS = DepthBias((0.012, -0.015, 0.004), 0.6, 3.6, 0.0004, np.diag([1e-8, 2e-8, 3e-9]))


def a_rig(seed=0):
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(6, 6))
    cameras = {
        "C1": RigCamera(LENS, np.eye(4), np.zeros((6, 6)), BIAS, CameraStatistics(sigma_2d_px=0.21, views=12)),
        "left top": RigCamera(
            LENS.with_vector(LENS.vector * rng.uniform(0.9, 1.1, 9)),
            se3.make(so3.exp(rng.normal(size=3)), rng.normal(size=3)),
            L @ L.T * 1e-7,
        ),
    }
    return Rig("C1", cameras, Quality(dropped={"C1": {"000003": "blurred"}}, other={"rms_px": 0.3}), {"seed": 4})


@settings(max_examples=30)
@given(st.integers(0, 2**31))
def test_there_and_back_bit_for_bit(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    rig = a_rig(seed)
    write_rig(path, rig)
    back = read_rig(path)
    assert back.reference == "C1" and back.quality == rig.quality and back.provenance == rig.provenance
    assert list(back.cameras) == ["C1", "left top"]
    for name, camera in rig.cameras.items():
        got = back.cameras[name]
        assert got.intrinsics == camera.intrinsics and got.statistics == camera.statistics
        assert np.array_equal(got.T_world_color, camera.T_world_color)
        assert np.array_equal(got.covariance, camera.covariance)
    first, second = back.cameras["C1"].depth_bias, back.cameras["left top"].depth_bias
    assert second is None and first.coefficients == BIAS.coefficients
    assert (first.min_m, first.max_m, first.rms_m) == (0.6, 3.6, 0.0004)
    assert np.array_equal(first.covariance, BIAS.covariance)


def test_writing_what_was_read_gives_the_same_bytes(tmp_path):
    write_rig(tmp_path / "a.yaml", a_rig())
    write_rig(tmp_path / "b.yaml", read_rig(tmp_path / "a.yaml"))
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()


def test_parts_of_a_rig_there_and_back(tmp_path):
    write_intrinsics(tmp_path / "i.yaml", {"C1": LENS}, {"C1": {"views": 15}}, {}, {})
    write_depth_bias(tmp_path / "d.yaml", {"C1": BIAS}, {}, {}, {})
    assert read_intrinsics(tmp_path / "i.yaml") == {"C1": LENS}
    assert read_depth_bias(tmp_path / "d.yaml")["C1"].coefficients == BIAS.coefficients
    with pytest.raises(ConfigError, match="no camera has 'depth_bias'"):
        read_depth_bias(tmp_path / "i.yaml")
    with pytest.raises(ConfigError, match="no camera has 'intrinsics'"):
        read_intrinsics(tmp_path / "d.yaml")
    with pytest.raises(ConfigError, match=r"cameras.C1.T_world_color is missing"):
        read_rig(tmp_path / "i.yaml")


def test_rigs_of_many_simulated_cameras_can_be_read(tmp_path):
    """16 held more values than the reader took for a rig's."""
    field = structured_light(160, 120, 0.008, np.random.default_rng(0)).grid
    camera = replace(a_rig().cameras["C1"], depth_field=field)
    write_rig(tmp_path / "truth.yaml", Rig("C1", {f"C{i}": camera for i in range(1, 17)}))
    back = read_rig(tmp_path / "truth.yaml").cameras
    assert len(back) == 16 and np.array_equal(back["C16"].depth_field.error, field.error)
    of_99 = 99 * (field.error.size + 200) + 99 * 8 * 17 + (99 * 6) ** 2
    assert of_99 < safe_yaml.MAX_VALUES  # with a board pose for each of eight frames a camera, and a joint covariance


def test_boards_of_a_truth_file(tmp_path):
    boards = {"000000": se3.make(so3.exp([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))}
    write_rig(tmp_path / "truth.yaml", a_rig(), boards)
    assert np.array_equal(read_boards(tmp_path / "truth.yaml")["000000"], boards["000000"])
    write_rig(tmp_path / "rig.yaml", a_rig())
    assert read_boards(tmp_path / "rig.yaml") == {}


@pytest.fixture
def data(tmp_path):
    write_rig(tmp_path / "good.yaml", a_rig())
    return yaml.safe_load((tmp_path / "good.yaml").read_text())


def change(data, path, value):
    data = copy.deepcopy(data)
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "needle"),
    [
        (("format",), "rgbd-calib/dataset", "format: 'rgbd-calib/dataset' seen, 'rgbd-calib/rig' needed"),
        (("version",), 2, "version: 2 seen, this program reads version 1"),
        (("version",), None, "version: None seen"),
        (("reference",), "C9", "reference: 'C9' seen, one of C1, left top needed"),
        (("cameras",), {}, "cameras"),
        (("cameras", "C1", "intrinsics"), None, "cameras.C1.intrinsics is missing"),
        (("cameras", "C1", "intrinsics", "fx"), None, r"cameras.C1.intrinsics.fx: Field required"),
        (("cameras", "C1", "intrinsics", "fx"), -3.0, r"cameras.C1.intrinsics.fx: -3.0 seen; .*greater than 0"),
        (("cameras", "C1", "intrinsics", "fx"), "wide", r"cameras.C1.intrinsics.fx: 'wide' seen"),
        (("cameras", "C1", "intrinsics", "cx"), float("nan"), r"cameras.C1.intrinsics.cx: nan seen"),
        (("cameras", "C1", "intrinsics", "distortion"), [0.1], "cameras.C1.intrinsics: distortion: 1 numbers, 4 or 5"),
        (("cameras", "C1", "intrinsics", "model"), "fisheye", "'fisheye' seen.*opencv"),
        (("cameras", "C1", "T_world_color"), [[1.0, 0, 0, 0]] * 4, "not a rigid motion"),
        (("cameras", "C1", "T_world_color"), [[1.0, 0, 0]], "T_world_color"),
        (("cameras", "C1", "translation_m"), [1.0, 0.0, 0.0], "translation_m and T_world_color disagree"),
        (("cameras", "C1", "rotation_wxyz"), [0.0, 1.0, 0.0, 0.0], "rotation_wxyz and T_world_color disagree"),
        (("cameras", "C1", "depth_bias", "max_m"), 0.5, "min_m 0.6 is not below max_m 0.5"),
        (("cameras", "C1", "depth_bias", "covariance"), [[1.0]], "covariance is not 3 x 3"),
    ],
)
def test_a_wrong_key_is_named_with_what_was_seen(tmp_path, data, path, value, needle):
    bad = tmp_path / "bad.yaml"
    bad.write_text(yaml.safe_dump(change(data, path, value)))
    with pytest.raises(ConfigError, match=needle) as caught:
        read_rig(bad)
    assert str(caught.value).startswith(f"{bad}: ")


@pytest.mark.parametrize(
    ("path", "key", "meant"),
    [
        (("cameras", "C1"), "T_world_colour", "T_world_color"),
        (("cameras", "C1", "intrinsics"), "distorsion", "distortion"),
        (("cameras", "C1", "depth_bias"), "coeficients", "coefficients"),
        ((), "refrence", "reference"),
    ],
)
def test_a_misspelt_key_is_an_error_with_the_right_one(tmp_path, data, path, key, meant):
    at = data
    for step in path:
        at = at[step]
    at[key] = at.pop(meant)
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=f"no such key '{key}'; did you mean '{meant}'"):
        read_rig(tmp_path / "bad.yaml")


def test_keys_of_other_programs_pass_and_are_kept(tmp_path, data):
    data["cameras"]["C1"]["lens_vendor"] = "ACME"
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
    assert read_rig(tmp_path / "a.yaml").cameras["C1"].statistics.other["lens_vendor"] == "ACME"


def test_a_rig_of_one_camera(tmp_path):
    rig = a_rig()
    write_rig(tmp_path / "one.yaml", replace(rig, cameras={"C1": rig.cameras["C1"]}))
    assert list(read_rig(tmp_path / "one.yaml").cameras) == ["C1"]


def test_depth_bias_is_held_outside_its_range_and_knows_its_error():
    z_m = np.array([0.2, 0.6, 2.0, 3.6, 9.0])
    added_m = BIAS.correct(z_m) - z_m
    wanted_m = 0.012 - 0.015 * z_m + 0.004 * z_m**2
    assert np.allclose(added_m[1:4], wanted_m[1:4])
    assert added_m[0] == pytest.approx(added_m[1]) and added_m[4] == pytest.approx(added_m[3])
    assert BIAS.standard_error(np.array(2.0)) == pytest.approx(np.sqrt(1e-8 + 4 * 2e-8 + 16 * 3e-9))
    assert np.isnan(BIAS.correct(np.array(np.nan)))
    with pytest.raises(ValueError, match="no covariance"):
        replace(BIAS, covariance=None).standard_error(z_m)
