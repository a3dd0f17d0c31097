"""Tables of features: bit for bit there and back, wrong rows named by line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.correspondences import read_corners, read_correspondences, write_corners, write_correspondences
from rgbd_calib.types import BoardView, Correspondences

HEADER = "camera,frame,feature,u_px,v_px,x_m,y_m,z_m\n"


def observations(data):
    """What a table says, whatever the order of its rows."""
    pixels = {
        (data.cameras[c], data.labels[p]): tuple(uv)
        for c, p, uv in zip(data.pixel_camera, data.pixel_point, data.pixels_px, strict=True)
    }
    points = {
        (data.cameras[c], data.labels[p]): tuple(xyz)
        for c, p, xyz in zip(data.xyz_camera, data.xyz_point, data.xyz_m, strict=True)
    }
    return pixels, points


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 5), st.integers(1, 12))
def test_there_and_back_bit_for_bit(tmp_path_factory, seed, n_cameras, n_points):
    rng = np.random.default_rng(seed)
    seen2, seen3 = rng.random((2, n_cameras, n_points)) < 0.6
    seen2[0, 0] = True  # one row at least
    c2, p2 = np.nonzero(seen2)
    c3, p3 = np.nonzero(seen3)
    data = Correspondences(
        tuple(f"C{i}" for i in range(n_cameras)),
        tuple((f"{i // 4:06d}", f"corner, {i}") for i in range(n_points)),
        c2,
        p2,
        rng.normal(300, 100, (len(c2), 2)),
        c3,
        p3,
        rng.normal(0, 1, (len(c3), 3)),
    )
    path = tmp_path_factory.mktemp("c") / "correspondences.csv"
    write_correspondences(path, data)
    assert observations(read_correspondences(path)) == observations(data)


@pytest.mark.parametrize(
    ("rows", "needle"),
    [
        ("", "no rows"),
        ("C1,0,a,1,2,,,\nC1,0,a,3,4,,,\n", "line 3: camera C1 has feature a of frame 0 a second time"),
        ("C1,0,a,1,,,,\n", "line 2: v_px: '' seen, a number needed"),
        ("C1,0,a,,,1,2,x\n", "line 2: z_m: 'x' seen"),
        ("C1,0,a,nan,2,,,\n", "line 2: u_px: 'nan' seen, a finite number"),
        ("C1,0,a,1,2\n", "line 2: 8 fields needed"),
    ],
)
def test_a_wrong_row_is_named_by_line(tmp_path, rows, needle):
    (tmp_path / "c.csv").write_text(HEADER + rows)
    with pytest.raises(ConfigError, match=needle):
        read_correspondences(tmp_path / "c.csv")


def test_a_missing_column_and_a_missing_file(tmp_path):
    (tmp_path / "c.csv").write_text("camera,frame,feature,u_px,v_px\n")
    with pytest.raises(ConfigError, match="column 'x_m' is missing"):
        read_correspondences(tmp_path / "c.csv")
    with pytest.raises(ConfigError, match="no such file"):
        read_correspondences(tmp_path / "none.csv")


def test_corners_there_and_back_with_missing_depth(tmp_path):
    rng = np.random.default_rng(0)
    views = [
        BoardView("C1", "000000", np.arange(6), rng.normal(300, 50, (6, 2)), rng.normal(2, 0.1, 6), np.full(6, 25)),
        BoardView(
            "C2", "000000", np.arange(6)[::-1], rng.normal(300, 50, (6, 2)), np.full(6, np.nan), np.zeros(6, int)
        ),
    ]
    write_corners(tmp_path / "corners.csv", views)
    back = read_corners(tmp_path / "corners.csv")
    assert [(v.camera, v.frame) for v in back] == [("C1", "000000"), ("C2", "000000")]
    for a, b in zip(views, back, strict=True):
        assert np.array_equal(a.ids, b.ids) and np.array_equal(a.corners_px, b.corners_px)
        assert np.array_equal(a.depth_m, b.depth_m, equal_nan=True)
        assert np.array_equal(a.depth_pixels, b.depth_pixels)


def test_a_corner_without_a_place_is_an_error(tmp_path):
    head = "camera,frame,feature,u_px,v_px,depth_m,depth_pixels\n"
    (tmp_path / "c.csv").write_text(head + "C1,0,0,1,2,,0\nC1,0,1,,2,,0\n")
    with pytest.raises(ConfigError, match="line 3: u_px: '' seen, a number needed"):
        read_corners(tmp_path / "c.csv")
