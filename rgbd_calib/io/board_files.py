"""A board from a file: dataset.yaml and whatever else has a `board`, a rig with the shape that it found, and Kalibr's target.yaml.

https://github.com/ethz-asl/kalibr/wiki/calibration-targets: `tagSize` is the side of a tag, `tagSpacing` the gap to the next
over that side; the columns and rows of a checkerboard are inner corners.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.quality import board_fields
from rgbd_calib.io.schema_base import parse
from rgbd_calib.io.schema_parts import BoardModel
from rgbd_calib.io.tables import short
from rgbd_calib.types import Board


class _BoardFile(BaseModel):
    board: BoardModel


def read_board(path: Path) -> Board:
    """The board of a YAML file.

    Raises
    ------
    ConfigError
        No such file, no board in it, or a board of another kind.
    """
    data = load_yaml(path)
    if "target_type" in data:
        data = {"board": _of_kalibr(path, data)}
    quality = data.get("quality")
    if isinstance(quality, dict) and (fields := board_fields(quality)) is not None:
        data = {"board": fields}
    elif "board" not in data:
        raise ConfigError(
            f"{path}: a board was expected, {', '.join(map(short, list(data)[:6])) or 'nothing'} was found. Give a file with "
            "`board: {cols: ..., rows: ..., square: ...}`, or Kalibr's target.yaml"
        )
    return parse(_BoardFile, data, path).board.value()


def _of_kalibr(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    kind = data["target_type"]
    if kind == "aprilgrid":
        cols, rows, tag, spacing = (_number(path, data, key) for key in ("tagCols", "tagRows", "tagSize", "tagSpacing"))
        square = tag * (1 + spacing) / 2
        return {"type": "aprilgrid", "cols": 2 * int(cols), "rows": 2 * int(rows), "square": square, "marker": tag}
    if kind == "checkerboard":
        keys = ("targetCols", "targetRows", "colSpacingMeters", "rowSpacingMeters")
        cols, rows, width, height = (_number(path, data, key) for key in keys)
        if not math.isclose(width, height, rel_tol=1e-6):
            raise ConfigError(f"{path}: squares of {width:g} x {height:g} m seen; a checkerboard of squares needed")
        return {"cols": int(cols), "rows": int(rows), "square": width}
    raise ConfigError(
        f"{path}: target_type: {short(kind)} seen, aprilgrid or checkerboard needed. Use one of these boards"
    )


def _number(path: Path, data: dict[str, Any], key: str) -> float:
    value = data.get(key)
    whole = key.endswith(("Cols", "Rows"))
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e3 or (whole and value % 1):
        raise ConfigError(f"{path}: {key}: {short(value)} seen, {'a whole' if whole else 'a positive'} number needed")
    return float(value)
