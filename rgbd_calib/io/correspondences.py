"""Tables of features: correspondences.csv (bring your own) and corners.csv (what `detect` writes)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.tables import name, number, number_or_nan, read_table, short, whole_number, write_table
from rgbd_calib.types import BoardView, Correspondences

CORRESPONDENCES = ("camera", "frame", "feature", "u_px", "v_px", "x_m", "y_m", "z_m")
CORNERS = ("camera", "frame", "feature", "u_px", "v_px", "depth_m", "depth_pixels")


def write_correspondences(path: Path, data: Correspondences) -> None:
    """Write one row for each observation; pixel and 3D point of one camera and point share a row."""
    rows: dict[tuple[int, int], list[str]] = {}
    for c, p, uv in zip(data.pixel_camera, data.pixel_point, data.pixels_px, strict=True):
        rows[int(p), int(c)] = [*map(repr, uv.tolist()), "", "", ""]
    for c, p, xyz in zip(data.xyz_camera, data.xyz_point, data.xyz_m, strict=True):
        rows.setdefault((int(p), int(c)), ["", "", "", "", ""])[2:] = map(repr, xyz.tolist())
    lines = ([data.cameras[c], *data.labels[p], *rows[p, c]] for p, c in sorted(rows))
    write_table(path, CORRESPONDENCES, lines)


def read_correspondences(path: Path) -> Correspondences:
    """Read correspondences of any origin.

    Raises
    ------
    ConfigError
        Names the line: not a number, a pixel or a point given in part, the same observation twice.
    """
    cameras: dict[str, int] = {}
    labels: dict[tuple[str, str], int] = {}
    seen: set[tuple[int, int]] = set()
    pixels: list[tuple[int, int, list[float]]] = []
    points: list[tuple[int, int, list[float]]] = []
    for line, row in read_table(path, CORRESPONDENCES):
        if row["camera"] not in cameras:
            _check_camera(path, line, row["camera"])
        c = cameras.setdefault(row["camera"], len(cameras))
        label = name(path, line, "frame", row["frame"]), name(path, line, "feature", row["feature"])
        p = labels.setdefault(label, len(labels))
        if (c, p) in seen:
            raise ConfigError(
                f"{path}: line {line}: camera {row['camera']} has feature {row['feature']} of frame {row['frame']} "
                "a second time; one row for each observation is needed. Give the features different names"
            )
        seen.add((c, p))
        for keys, into in ((("u_px", "v_px"), pixels), (("x_m", "y_m", "z_m"), points)):
            texts = [row[key].strip() for key in keys]
            if any(texts):
                values = [number(path, line, key, text) for key, text in zip(keys, texts, strict=True)]
                into.append((c, p, values))
    if not seen:
        raise ConfigError(f"{path}: no rows. At least two cameras with common features are needed")

    def column(table: list[tuple[int, int, list[float]]], k: int) -> np.ndarray:
        return np.array([row[k] for row in table], int)

    return Correspondences(
        tuple(cameras),
        tuple(labels),
        column(pixels, 0),
        column(pixels, 1),
        np.array([row[2] for row in pixels], float).reshape(-1, 2),
        column(points, 0),
        column(points, 1),
        np.array([row[2] for row in points], float).reshape(-1, 3),
    )


def write_corners(path: Path, views: Iterable[BoardView]) -> None:
    """Write detected corners, one row each; depth_m is as measured, before bias correction, empty where missing."""
    rows = (
        (view.camera, view.frame, i, *map(repr, uv.tolist()), "" if np.isnan(z) else repr(float(z)), int(k))
        for view in views
        for i, uv, z, k in zip(view.ids, view.corners_px, view.depth_m, view.depth_pixels, strict=True)
    )
    write_table(path, CORNERS, rows)


def read_corners(path: Path) -> tuple[BoardView, ...]:
    """Read what :func:`write_corners` wrote.

    Raises
    ------
    ConfigError
        Names the line: not a number, a corner twice, a camera whose name is none.
    """
    grouped: dict[tuple[str, str], dict[int, tuple[float, float, float, int]]] = {}
    for line, row in read_table(path, CORNERS):
        key = row["camera"], row["frame"]
        if key not in grouped:
            _check_camera(path, line, row["camera"])
            grouped[key] = {}
            name(path, line, "frame", row["frame"])
        feature = whole_number(path, line, "feature", row["feature"])
        if feature in grouped[key]:
            raise ConfigError(
                f"{path}: line {line}: camera {row['camera']} has feature {feature} of frame {row['frame']} a second time; "
                "each corner once is needed. Detect again with `rgbd-calib detect`"
            )
        u_px, v_px = (number(path, line, key, row[key]) for key in ("u_px", "v_px"))
        depth_m = number_or_nan(path, line, "depth_m", row["depth_m"])
        if depth_m <= 0:
            raise ConfigError(
                f"{path}: line {line}: depth_m: {depth_m:g} seen; more than 0, or nothing, needed. Correct it"
            )
        pixels = whole_number(path, line, "depth_pixels", row["depth_pixels"].strip() or "0")
        grouped[key][feature] = u_px, v_px, depth_m, pixels
    views = []
    for (camera, frame), corners in grouped.items():
        values = np.array(list(corners.values()), float)
        ids, counts = np.array(list(corners), int), values[:, 3].astype(int)
        views.append(BoardView(camera, frame, ids, values[:, :2], values[:, 2], counts))
    return tuple(views)


def _check_camera(path: Path, line: int, camera: str) -> None:
    try:
        check_name(camera)
    except ValueError as error:
        raise ConfigError(f"{path}: line {line}: camera: {short(camera)} seen; {error}. Rename it") from None
