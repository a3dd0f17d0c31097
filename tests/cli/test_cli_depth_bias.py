"""`rgbd-calib depth-bias`: from a wall at known distances, or from the board's pose."""

from __future__ import annotations

import json

import numpy as np
import pytest
from synthetic_views import BOARD, arc, bias_of, make_recording

from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.recording import CameraInfo, save_color, save_depth, write_dataset, write_table
from rgbd_calib.io.rig import read_depth_bias
from rgbd_calib.simulation.depth_sensor import biased

W, H = 64, 48


def wall_recording(folder, distances=(0.8, 1.2, 1.6, 2.0, 2.5, 3.0), color_only=(), seed=0):
    """Two cameras of 64 x 48 px before a wall, each with its bias; 6 mm of noise at 2 m, in millimetres."""
    rng = np.random.default_rng(seed)
    for i, name in enumerate(("C1", "C2")):
        for k, z in enumerate(distances):
            save_color(folder, name, f"{k:06d}", np.zeros((H, W, 3), np.uint8))
            if name not in color_only:
                z_m = biased(np.full((H, W), z), bias_of(i)) + rng.normal(0, 1.5e-3 * z**2, (H, W))
                save_depth(folder, name, f"{k:06d}", np.rint(1000 * z_m).astype(np.uint16))
        if name not in color_only:
            rows = [(f"{k:06d}", z) for k, z in enumerate(distances)]
            write_table(folder / name / "distances.csv", ("frame", "distance_m"), rows)
    write_dataset(folder, {name: CameraInfo(W, H) for name in ("C1", "C2")}, None)
    return folder


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return wall_recording(tmp_path_factory.mktemp("wall") / "depth_bias")


def test_from_distances(run, wall, tmp_path):
    path = tmp_path / "bias.yaml"
    out = run("depth-bias", wall, "-o", path)
    assert out.status == 0, out.stderr
    assert [line.split(":")[0] for line in out.stdout.splitlines()] == ["C1", "C2"]
    assert "mm over 6 distances" in out.stdout
    for i, bias in enumerate(read_depth_bias(path).values()):
        z = np.linspace(0.8, 3.0, 5)
        off = bias.correct(biased(z, bias_of(i))) - z
        # a line may win where the curve of a millimetre is not seen in six distances of 0.3 mm: 1 mm on top
        assert np.all(np.abs(off) < 5 * bias.standard_error(z) + 1e-3)
    assert len(load_yaml(path)["cameras"]["C1"]["samples"]["z_m"]) == 6


def test_colour_only_cameras_are_passed_over(run, tmp_path):
    folder = wall_recording(tmp_path / "wall", color_only=["C1"])
    assert run("depth-bias", folder, "-o", tmp_path / "bias.yaml").status == 0
    assert list(read_depth_bias(tmp_path / "bias.yaml")) == ["C2"]
    none = wall_recording(tmp_path / "none", color_only=["C1", "C2"])
    out = run("depth-bias", none, "-o", tmp_path / "no.yaml")
    assert (out.status, "no camera has depth images" in out.stderr) == (1, True)


@pytest.mark.parametrize(
    ("distances", "says"),
    [((1.0, 2.0), "C1: 2 distance(s)"), ((1.0, 1.05, 1.1, 1.2), "C1: depth seen from 1.00 to 1.20 m")],
)
def test_too_few_or_too_near(run, tmp_path, distances, says):
    out = run("depth-bias", wall_recording(tmp_path / "wall", distances), "-o", tmp_path / "bias.yaml")
    assert out.status == 1
    assert says in out.stderr
    assert not (tmp_path / "bias.yaml").exists()


def test_a_line_of_distances_without_its_depth(run, tmp_path):
    folder = wall_recording(tmp_path / "wall")
    (folder / "C2" / "depth" / "000003.png").unlink()
    out = run("depth-bias", folder, "-o", tmp_path / "bias.yaml")
    assert out.status == 2
    assert f"{folder / 'C2' / 'distances.csv'}: frame 000003 has no depth image" in out.stderr


def test_from_the_board(run, tmp_path):
    recording = make_recording(tmp_path, arc(2, biased=True), BOARD, frames=30)
    args = ("depth-bias", recording.path, "--corners", recording.corners, "-o", tmp_path / "bias.yaml")
    out = run(*args)
    assert out.status == 2
    assert "C1 has no distances.csv" in out.stderr
    assert "Give --intrinsics" in out.stderr
    out = run(*args, "--intrinsics", recording.intrinsics)
    assert out.status == 0, out.stderr
    for i, bias in enumerate(read_depth_bias(tmp_path / "bias.yaml").values()):
        z = np.linspace(bias.min_m, bias.max_m, 5)
        off = bias.correct(biased(z, bias_of(i))) - z
        # as above; a board's distance by pixels is sure to 0.1 px / sqrt(54) of 130 px, 0.2 mm at 2 m
        assert np.all(np.abs(off) < 5 * bias.standard_error(z) + 1e-3)


def test_results_as_json(run, wall, tmp_path):
    out = run("depth-bias", wall, "-o", tmp_path / "bias.yaml", "--json")
    numbers = json.loads(out.stdout)
    for name, bias in read_depth_bias(tmp_path / "bias.yaml").items():
        own = numbers["cameras"][name]
        np.testing.assert_allclose(own["coefficients"], bias.coefficients, rtol=1e-4, atol=1e-6)
        assert own["distances"] == 6 and own["left_out"] == 0
