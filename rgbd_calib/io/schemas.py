"""The YAML files as pydantic models: one place says which keys there are, and JSON Schemas are published from it.

Keys that nobody knows pass, since other programs may keep their own there; a key that looks like a misspelt one is
an error with the suggestion.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.tables import MAX_NAME, short
from rgbd_calib.types import Board, DepthBias

VERSION = 1
MAX_SIDE = 8192
"""Of an image, px: twice the largest RGB-D camera's. 8192 x 8192 pixels of colour and of depth in metres are 0.7 GB."""
MAX_CORNERS = 256
"""In a row or column of a board."""
MAX_UNKNOWN_KEYS = 200
LARGEST = 1e12
"""No number of a rig is larger, and the square of its cube is still a double."""


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("a number is needed")
    return value


def check_name(text: str) -> str:
    """A camera's name, which becomes a folder's.

    Raises
    ------
    ValueError
        It would lead elsewhere, or cannot be shown.
    """
    alone = text != "" and PurePosixPath(text).name == text and PureWindowsPath(text).name == text
    if not alone or text.startswith(".") or not text.isprintable() or len(text) > MAX_NAME or text != text.strip():
        raise ValueError(
            f"a camera's name is that of its folder: 1 to {MAX_NAME} printable characters without / and \\, and no dot first"
        )
    return text


Name = Annotated[str, AfterValidator(check_name)]
Finite = Annotated[float, BeforeValidator(_no_boolean), Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, BeforeValidator(_no_boolean), Field(gt=0, le=LARGEST, allow_inf_nan=False)]
Side = Annotated[int, BeforeValidator(_no_boolean), Field(gt=0, le=MAX_SIDE)]
Corners = Annotated[int, BeforeValidator(_no_boolean), Field(ge=2, le=MAX_CORNERS)]
Length = Annotated[float, BeforeValidator(_no_boolean), Field(ge=0.001, le=1, allow_inf_nan=False)]
"""Metres, of a part of a board."""
DepthUnit = Annotated[float, BeforeValidator(_no_boolean), Field(ge=1e-6, le=1, allow_inf_nan=False)]
"""Metres for each unit of depth."""
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4)]
Vector6 = Annotated[list[Finite], Field(min_length=6, max_length=6)]
Matrix6 = Annotated[list[Vector6], Field(min_length=6, max_length=6)]


class _Model(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(extra="allow")

    @model_validator(mode="before")
    @classmethod
    def _no_misspelt_key(cls, data: Any) -> Any:
        if isinstance(data, dict):
            unknown = [key for key in data if key not in cls.model_fields]
            if len(unknown) > MAX_UNKNOWN_KEYS:
                raise ValueError(
                    f"{len(unknown)} keys that nobody knows, as {short(unknown[0])}; is it the right file?"
                )
            for key in unknown:
                near = get_close_matches(str(key), [k for k in cls.model_fields if k not in data], 1, 0.8)
                if near:
                    raise ValueError(f"no such key {short(key)}; did you mean '{near[0]}'?")
        return data


class IntrinsicsModel(_Model):
    """Pixel (0, 0) is the centre of the top left pixel; distortion is k1, k2, p1, p2, k3 (OpenCV's order)."""

    model: Literal["opencv"] = "opencv"
    width: Side
    height: Side
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    distortion: Annotated[list[Finite], Field(min_length=5, max_length=5)] = [0.0] * 5

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> IntrinsicsModel:
        values = {k: getattr(intrinsics, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
        return cls(**values, distortion=list(intrinsics.distortion))

    def value(self) -> Intrinsics:
        k1, k2, p1, p2, k3 = self.distortion
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy, (k1, k2, p1, p2, k3))


class DepthBiasModel(_Model):
    """z_true = z + c0 + c1 z + c2 z^2 + ..., metres, on [min_m, max_m]; held at the ends outside."""

    coefficients: Annotated[list[Finite], Field(min_length=1, max_length=8)]
    min_m: Finite
    max_m: Finite
    rms_m: Finite = 0.0
    covariance: list[list[Finite]] | None = None

    @model_validator(mode="after")
    def _range(self) -> DepthBiasModel:
        if not self.min_m < self.max_m:
            raise ValueError(f"min_m {self.min_m} is not below max_m {self.max_m}")
        n = len(self.coefficients)
        if self.covariance is not None and [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"covariance is not {n} x {n}, one row for each coefficient")
        return self

    @classmethod
    def of(cls, bias: DepthBias) -> DepthBiasModel:
        covariance = None if bias.covariance is None else bias.covariance.tolist()
        return cls(
            coefficients=list(bias.coefficients),
            min_m=bias.min_m,
            max_m=bias.max_m,
            rms_m=bias.rms_m,
            covariance=covariance,
        )

    def value(self) -> DepthBias:
        covariance = None if self.covariance is None else np.array(self.covariance)
        return DepthBias(tuple(self.coefficients), self.min_m, self.max_m, self.rms_m, covariance)


class BoardModel(_Model):
    """`cols` and `rows` count inner corners; `square`, `thickness` and `marker` are metres."""

    type: Literal["checkerboard", "charuco"] = "checkerboard"
    cols: Corners
    rows: Corners
    square: Length
    two_sided: bool = False
    thickness: Annotated[float, BeforeValidator(_no_boolean), Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.0
    marker: Length | None = None
    dictionary: str | None = None
    legacy: bool | None = None
    """A ChArUco board in the layout before OpenCV 4.6; nothing means no."""

    @model_validator(mode="after")
    def _charuco(self) -> BoardModel:
        if self.type == "charuco" and (self.marker is None or self.dictionary is None):
            raise ValueError("a charuco board needs 'marker' (metres) and 'dictionary' (as DICT_5X5_250)")
        return self

    @classmethod
    def of(cls, board: Board) -> BoardModel:
        charuco: dict[str, Any] = (
            {"marker": board.marker_m, "dictionary": board.dictionary, "legacy": board.legacy or None}
            if board.type == "charuco"
            else {}
        )
        return cls(
            type=board.type,
            cols=board.cols,
            rows=board.rows,
            square=board.square_m,
            two_sided=board.two_sided,
            thickness=board.thickness_m,
            **charuco,
        )

    def value(self) -> Board:
        return Board(
            self.cols,
            self.rows,
            self.square,
            self.two_sided,
            self.thickness,
            self.type,
            self.marker or 0.0,
            self.dictionary or "",
            self.legacy or False,
        )


class DatasetCameraModel(_Model):
    width: Side
    height: Side
    depth_scale: DepthUnit | None = None
    serial: str | None = None
    intrinsics: IntrinsicsModel | None = None

    @model_validator(mode="after")
    def _sizes(self) -> DatasetCameraModel:
        own = self.intrinsics
        if own and (own.width, own.height) != (self.width, self.height):
            raise ValueError(
                f"intrinsics are for {own.width}x{own.height} px, the camera has {self.width}x{self.height}"
            )
        return self


class DatasetModel(_Model):
    """dataset.yaml of a recording."""

    format: Literal["rgbd-calib/dataset"]
    version: Literal[1]
    depth_scale: DepthUnit = 0.001
    depth_registered: bool = True
    cameras: Annotated[dict[Name, DatasetCameraModel], Field(min_length=1)]
    board: BoardModel | None = None

    @model_validator(mode="after")
    def _one_folder_each(self) -> DatasetModel:
        seen: dict[str, str] = {}
        for name in self.cameras:
            other = seen.setdefault(name.casefold(), name)
            if other != name:
                raise ValueError(f"cameras {other} and {name} are one folder on disks that know no case. Rename one")
        return self


class RigCameraModel(_Model):
    """One camera; `p_world = T_world_color @ p_color`; the covariance is of the left perturbation (rad, m)."""

    intrinsics: IntrinsicsModel | None = None
    T_world_color: Matrix4 | None = None
    rotation_wxyz: Vector4 | None = None
    translation_m: Vector3 | None = None
    covariance: Matrix6 | None = None
    depth_bias: DepthBiasModel | None = None
    intrinsics_sd: Annotated[list[Finite], Field(min_length=9, max_length=9)] | None = None
    sigma_2d_px: Finite | None = None
    sigma_3d_m: Finite | None = None
    sigma_3d_model: str | None = None

    @model_validator(mode="after")
    def _pose(self) -> RigCameraModel:
        if self.T_world_color is None:
            return self
        T = np.array(self.T_world_color)
        check_rigid(T)
        if self.translation_m is not None and not np.allclose(T[:3, 3], self.translation_m, atol=1e-6):
            raise ValueError("translation_m and T_world_color disagree")
        q = self.rotation_wxyz
        if q is not None and not np.allclose(abs(so3.quaternion_wxyz(T[:3, :3]) @ np.array(q)), 1, atol=1e-6):
            raise ValueError("rotation_wxyz and T_world_color disagree")
        return self


class RigModel(_Model):
    """rig.yaml; intrinsics.yaml, depth_bias.yaml and truth.yaml are the same with fewer or more keys."""

    format: Literal["rgbd-calib/rig"]
    version: Literal[1]
    reference: str | None = None
    cameras: Annotated[dict[Name, RigCameraModel], Field(min_length=1)]
    boards: dict[str, Matrix4] | None = None
    quality: dict[str, Any] = {}
    provenance: dict[str, Any] = {}


def check_rigid(T: np.ndarray) -> None:
    """Raise ValueError unless T (4, 4) is a rigid motion to 1e-6."""
    R = T[:3, :3]
    if not np.allclose(T[3], [0, 0, 0, 1]) or np.linalg.det(R) < 0 or np.abs(R.T @ R - np.eye(3)).max() > 1e-6:
        raise ValueError("not a rigid motion: the upper 3x3 must be a rotation, the last row 0 0 0 1")


M = TypeVar("M", bound=BaseModel)


def parse(model: type[M], data: dict[str, Any], path: Path) -> M:
    """The data as a model.

    Raises
    ------
    ConfigError
        Names the file, the key, what was seen and what is needed; for a file of another version, says so.
    """
    wanted = model.model_fields.get("format")
    if wanted is not None:
        name = str(wanted.annotation.__args__[0])  # type: ignore[union-attr]
        if data.get("format") != name:
            raise ConfigError(
                f"{path}: format: {short(data.get('format'))} seen, '{name}' needed. Is it the right file?"
            )
        if data.get("version") != VERSION:
            raise ConfigError(
                f"{path}: version: {short(data.get('version'))} seen, this program reads version {VERSION}. "
                "Convert the file, or install the release of rgbd-calib that wrote it"
            )
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"] if part != "[key]") or "(top level)"
        key = key if key.isprintable() and len(key) < 200 else short(key)
        seen = "" if isinstance(first["input"], dict) else f" {short(first['input'])} seen;"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        raise ConfigError(f"{path}: {key}:{seen} {first['msg'].removeprefix('Value error, ')}{more}") from None
