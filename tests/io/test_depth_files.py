"""Depth in other types of file, and values that are no measurement."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_recording import DEPTH, HEIGHT, WIDTH, edit

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import open_recording, save_depth


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
