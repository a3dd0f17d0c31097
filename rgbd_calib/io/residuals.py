"""What is left between every observation and the calibrated rig: RIG.residuals.csv beside RIG.yaml."""

from __future__ import annotations

import hashlib
import sys
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import dump_yaml, whole_file
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.rig import rig_data
from rgbd_calib.io.tables import MAX_BYTES, fill_table, number_or_nan, read_table, short
from rgbd_calib.types import Rig

COLUMNS = (
    "camera",
    "frame",
    "feature",
    "u_px",
    "v_px",
    "residual_u_px",
    "residual_v_px",
    "depth_m",
    "residual_depth_m",
    "used",
)
_USED = {(True, True): "both", (True, False): "pixel", (False, True): "depth", (False, False): "none"}


@dataclass(frozen=True)
class Residuals:
    """One row for each corner of each view; NaN where there is no such observation."""

    camera: np.ndarray
    """(n,) of str."""
    frame: np.ndarray
    """(n,) of str."""
    feature: np.ndarray
    """(n,) of str: the number of the corner on the board's front."""
    pixels_px: FloatArray
    """(n, 2), as detected."""
    residual_px: FloatArray
    """(n, 2), measured - predicted."""
    depth_m: FloatArray
    """(n,), as the sensor reported it."""
    residual_depth_m: FloatArray
    """(n,), measured, its bias removed, - predicted."""
    used_pixel: np.ndarray
    """(n,) bool: took part in the calibration."""
    used_depth: np.ndarray
    """(n,) bool."""

    def of(self, camera: str) -> Residuals:
        """The rows of one camera."""
        return self.select(self.camera == camera)

    def select(self, rows: np.ndarray) -> Residuals:
        """Some of the rows."""
        return Residuals(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def residuals_path(rig: Path) -> Path:
    """Where the residuals of a rig file stand."""
    return rig.with_name(f"{rig.stem}.residuals.csv")


def write_result(path: Path, rig: Rig, boards: Mapping[str, FloatArray], residuals: Residuals) -> None:
    """Write a rig and, beside it, its residuals, whose hash the rig's quality holds.

    Both are complete before either is put in its place: a kill leaves the old pair or the new one, or, between the two
    renames, a pair that :func:`read_residuals_of` refuses.
    """
    with whole_file(residuals_path(path)) as beside, whole_file(path) as main:
        fill_residuals(beside, residuals)
        digest = hashlib.sha256(beside.read_bytes()).hexdigest()
        signed = replace(rig, quality=replace(rig.quality, residuals_sha256=digest))
        main.write_text(dump_yaml(rig_data(signed, boards)), encoding="utf-8")


def write_residuals(path: Path, r: Residuals) -> None:
    """Write one row for each observation; empty where there is none; `used` is both, pixel, depth or none."""
    with whole_file(path) as temporary:
        fill_residuals(temporary, r)


def fill_residuals(path: Path, r: Residuals) -> None:
    """As :func:`write_residuals`, in place."""
    rows = (
        (
            camera,
            frame,
            feature,
            *(f"{x:.3f}" for x in uv),
            *("" if np.isnan(x) else f"{x:.4f}" for x in left),
            *("" if np.isnan(x) else f"{x:.5f}" for x in (z, left_z)),
            _USED[bool(pixel), bool(depth)],
        )
        for camera, frame, feature, uv, left, z, left_z, pixel, depth in zip(
            r.camera,
            r.frame,
            r.feature,
            r.pixels_px,
            r.residual_px,
            r.depth_m,
            r.residual_depth_m,
            r.used_pixel,
            r.used_depth,
            strict=True,
        )
    )
    fill_table(path, COLUMNS, rows)


def read_residuals_of(path: Path, rig: Rig) -> Residuals | None:
    """The residuals beside the rig file `path`; None where there are none, or `rig` was updated after they were made.

    Raises
    ------
    ConfigError
        They belong to another rig, or cannot be read.
    """
    beside = residuals_path(path)
    stated = rig.quality.residuals_sha256
    if not beside.exists() or stated is None:
        return None
    if stated:
        seen = hashlib.sha256(read_bytes(beside, MAX_BYTES)).hexdigest()
        if seen != stated:
            raise ConfigError(
                f"{beside}: SHA-256 {seen[:12]}... seen, {path.name} was written with {short(stated)}: the two are "
                "of different calibrations, or one was changed. Calibrate again, or take the table away"
            )
    return read_residuals(beside)


def read_residuals(path: Path) -> Residuals:
    """Read what :func:`write_residuals` wrote.

    Raises
    ------
    ConfigError
        Names the line: not a number, a corner twice, or another word under `used`.
    """
    flags = {word: pair for pair, word in _USED.items()}
    table: dict[tuple[str, str, str], None] = {}
    numbers, used = array("d"), []
    for line, row in read_table(path, COLUMNS):
        if row["used"] not in flags:
            raise ConfigError(
                f"{path}: line {line}: used: {short(row['used'])} seen, one of {', '.join(flags)} needed. Calibrate again"
            )
        label = sys.intern(row["camera"]), sys.intern(row["frame"]), sys.intern(row["feature"])
        if label in table:
            raise ConfigError(
                f"{path}: line {line}: camera, frame and feature {short(label)} stand there twice; once is needed. "
                "Calibrate again"
            )
        table[label] = None
        numbers.extend(number_or_nan(path, line, key, row[key]) for key in COLUMNS[3:9])
        used.append(flags[row["used"]])
    camera, frame, feature = np.array(list(table), dtype=str).reshape(-1, 3).T
    values = np.array(numbers, float).reshape(-1, 6)
    pixel, depth = np.array(used, bool).reshape(-1, 2).T
    return Residuals(camera, frame, feature, values[:, :2], values[:, 2:4], values[:, 4], values[:, 5], pixel, depth)
