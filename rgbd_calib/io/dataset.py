"""dataset.yaml: what a recording's cameras are, where their images lie, and the board."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import dump_yaml, load_yaml, write_text
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.schema_base import DepthUnit, Finite, Matrix4, Name, Side, Strict, check_rigid, parse
from rgbd_calib.io.schema_parts import BoardModel, IntrinsicsModel
from rgbd_calib.types import Board, DepthCamera

SensorKind = Literal["structured_light", "stereo", "time_of_flight"]
TOF_SIZES = {(512, 424), (640, 576), (320, 288), (512, 512), (1024, 1024)}
"""Of the depth images of Kinect v2, Azure Kinect and Femto, not registered to colour; no other sensors have these."""
MAX_BASELINE_M = 1.0
"""Between a camera's colour and depth sensors; 0.05 m in the devices that are sold."""


@dataclass(frozen=True, eq=False)
class DepthGeometry:
    """What is known of the geometry of depth that is not registered to colour."""

    width: int
    height: int
    intrinsics: Intrinsics | None = None
    """Of the factory or calibrated: a start; None: unknown."""
    intrinsics_sd: tuple[float, ...] | None = None
    """Standard deviations of `intrinsics.vector`, where they are stated."""
    T_color_depth: FloatArray | None = None
    """(4, 4), p_color = T_color_depth @ p_depth, metres; None: unknown."""

    def camera(self, color: Intrinsics) -> DepthCamera | None:
        """The depth camera to start from; None where its lens is unknown.

        Depth of another size that has the place of the colour camera (T_color_depth is the identity) and no lens of its own
        has the colour camera's lens, scaled.
        """
        T = np.eye(4) if self.T_color_depth is None else self.T_color_depth
        if self.intrinsics is not None:
            return DepthCamera(self.intrinsics, T)
        if self.T_color_depth is not None and np.allclose(T, np.eye(4), atol=1e-9):
            return DepthCamera(scaled(color, self.width, self.height), T)
        return None


def scaled(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The lens of the same image at another size; pixel (0, 0) is the centre of the top left pixel."""
    x, y = width / lens.width, height / lens.height
    return replace(
        lens,
        width=width,
        height=height,
        fx=lens.fx * x,
        fy=lens.fy * y,
        cx=(lens.cx + 0.5) * x - 0.5,
        cy=(lens.cy + 0.5) * y - 0.5,
    )


@dataclass(frozen=True, eq=False)
class Mount:
    """Of a depth camera that is taken for a camera of its own: the colour camera beside it."""

    camera: str
    T_color_depth: FloatArray | None
    """(4, 4), p_color = T_color_depth @ p_depth, metres, as it was stated; None: unknown."""
    intrinsics_sd: tuple[float, ...] | None = None
    """Standard deviations of the intrinsics, where they are stated."""


_UNIT_OF_FLOATS_M = 0.1


@dataclass(frozen=True)
class CameraInfo:
    """What dataset.yaml says of a camera; `depth_scale` is metres for each unit of its 16-bit depth images."""

    width: int
    height: int
    depth_scale: float = 0.001
    serial: str | None = None
    intrinsics: Intrinsics | None = None
    depth: DepthGeometry | None = None
    """None: depth is registered, it has the colour camera's geometry."""
    invalid: tuple[float, ...] = ()
    """Depth values, as stored, besides 0 and 65535 that mean "no measurement"."""
    float_unit_m: float = 1.0
    """Metres for each unit of its floating-point depth images."""
    depth_stated: bool = False
    """dataset.yaml gives it a depth scale or a depth block, so that depth images are expected."""
    kind: SensorKind | None = None
    """How it measures depth, where that is known."""
    mount: Mount | None = None
    """None: a colour camera. Else its "colour" images are infrared ones."""

    @property
    def time_of_flight(self) -> bool:
        """Does its depth sensor measure a time of flight, as far as is known?"""
        own_geometry = self.depth is not None or self.mount is not None
        by_size = own_geometry and self.depth_size in TOF_SIZES
        return self.kind == "time_of_flight" or (self.kind is None and by_size)

    @property
    def depth_step_m(self) -> float:
        """Metres between neighbouring values of its depth.

        No unit of integers is 0.1 m or more: that is the unit of floating-point depth, of which sensors round to 1 mm or less.
        """
        return self.depth_scale if self.depth_scale < _UNIT_OF_FLOATS_M else 0.001

    @property
    def depth_size(self) -> tuple[int, int]:
        """Width and height of its depth and infrared images, px."""
        return (self.width, self.height) if self.depth is None else (self.depth.width, self.depth.height)


@dataclass(frozen=True)
class Dataset:
    """What dataset.yaml says."""

    cameras: dict[str, CameraInfo]
    board: Board | None = None
    files: FilePatterns | None = None
    """None: the layout of FORMATS.md."""
    synchronous: bool = True
    """Equal stems are the same instant."""
    depth_stated: bool = False
    """It gives a depth scale for all cameras, so that one of them at least should have depth images."""
    extra: dict[str, Any] = field(default_factory=dict)
    """`notes` and `corrected`."""


def _patterns(value: Any) -> Any:
    if isinstance(value, str) and len(value) > 500:
        raise ValueError("a pattern of 500 characters at most is needed")
    return value


class FilesModel(Strict):
    """Where the images lie, as paths in the recording with {camera} and {frame}."""

    color: Annotated[str, BeforeValidator(_patterns)]
    depth: Annotated[str, BeforeValidator(_patterns)] | None = None
    ir: Annotated[str, BeforeValidator(_patterns)] | None = None

    def value(self) -> FilePatterns:
        return FilePatterns(self.color, self.depth, self.ir)


class StartIntrinsicsModel(IntrinsicsModel):
    """Intrinsics with how sure they are."""

    sd: list[Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]] | None = None
    """Standard deviations of fx, fy, cx, cy and the distortion, in this order."""

    @model_validator(mode="after")
    def _one_each(self) -> StartIntrinsicsModel:
        if self.sd is not None and len(self.sd) != 4 + len(self.distortion):
            raise ValueError(
                f"sd: {len(self.sd)} numbers seen, {4 + len(self.distortion)} needed (fx, fy, cx, cy, ...)"
            )
        return self


class DepthModel(Strict):
    """A camera's depth: its geometry where it is not registered to colour, its unit, and what means "none"."""

    width: Side | None = None
    height: Side | None = None
    intrinsics: StartIntrinsicsModel | None = None
    T_color_depth: Matrix4 | None = None
    kind: SensorKind | None = None
    scale_m: DepthUnit | None = None
    invalid: Annotated[tuple[Finite, ...], Field(max_length=100)] = ()

    @property
    def has_geometry(self) -> bool:
        return not (self.width is self.height is self.intrinsics is self.T_color_depth is None)

    @model_validator(mode="after")
    def _fits(self) -> DepthModel:
        if self.has_geometry and (self.width is None or self.height is None):
            raise ValueError("width and height of its depth images are needed where it has a geometry of its own")
        own = self.intrinsics
        if own and (own.width, own.height) != (self.width, self.height):
            raise ValueError(f"intrinsics are for {own.width}x{own.height} px, depth has {self.width}x{self.height}")
        if self.T_color_depth is not None:
            T = np.array(self.T_color_depth)
            check_rigid(T)
            far = float(np.linalg.norm(T[:3, 3]))
            if far > MAX_BASELINE_M:
                raise ValueError(
                    f"T_color_depth moves by {far:g} m, {MAX_BASELINE_M:g} m at most needed. Is it in millimetres?"
                )
        return self

    def value(self) -> DepthGeometry | None:
        if self.width is None or self.height is None:
            return None
        own, T = self.intrinsics, self.T_color_depth
        return DepthGeometry(
            self.width,
            self.height,
            own.value() if own else None,
            tuple(own.sd) if own and own.sd is not None else None,
            None if T is None else np.array(T),
        )


class DatasetCameraModel(Strict):
    """One camera of a recording."""

    width: Side
    height: Side
    depth_scale: DepthUnit | None = None
    serial: str | None = None
    intrinsics: IntrinsicsModel | None = None
    depth: DepthModel | None = None
    notes: Any = None

    @model_validator(mode="after")
    def _sizes(self) -> DatasetCameraModel:
        own = self.intrinsics
        if own and (own.width, own.height) != (self.width, self.height):
            raise ValueError(
                f"intrinsics are for {own.width}x{own.height} px, the camera has {self.width}x{self.height}"
            )
        scale_m = self.depth.scale_m if self.depth else None
        if None not in (scale_m, self.depth_scale) and scale_m != self.depth_scale:
            raise ValueError(f"depth_scale {self.depth_scale} and depth.scale_m {scale_m} seen. Take one out")
        return self

    def value(self, depth_scale: float) -> CameraInfo:
        own = self.depth or DepthModel()
        return CameraInfo(
            self.width,
            self.height,
            own.scale_m or self.depth_scale or depth_scale,
            self.serial,
            self.intrinsics.value() if self.intrinsics else None,
            own.value(),
            own.invalid,
            own.scale_m or 1.0,
            self.depth_scale is not None or self.depth is not None,
            own.kind,
        )


class DatasetModel(Strict):
    """dataset.yaml of a recording."""

    format: Literal["rgbd-calib/dataset"]
    version: Literal[1]
    depth_scale: DepthUnit | None = None
    depth_registered: bool = True
    synchronous: bool = True
    files: FilesModel | None = None
    cameras: Annotated[dict[Name, DatasetCameraModel], Field(min_length=1)]
    board: BoardModel | None = None
    corrected: dict[str, Any] | None = None
    """What `rgbd-calib correct` has removed."""
    notes: Any = None
    """Anything that people want to keep there."""

    @model_validator(mode="after")
    def _one_folder_each(self) -> DatasetModel:
        seen: dict[str, str] = {}
        for name in self.cameras:
            other = seen.setdefault(name.casefold(), name)
            if other != name:
                raise ValueError(f"cameras {other} and {name} are one folder on disks that know no case. Rename one")
        return self

    @model_validator(mode="after")
    def _registration(self) -> DatasetModel:
        own = [name for name, camera in self.cameras.items() if camera.depth and camera.depth.has_geometry]
        if self.depth_registered and own:
            raise ValueError(
                f"depth of {', '.join(own)} has a geometry of its own, and depth_registered is not false. Write "
                "`depth_registered: false`, or take width, height, intrinsics and T_color_depth out of its depth block"
            )
        if not self.depth_registered and not own:
            raise ValueError(
                "depth_registered is false, and no camera says which geometry its depth has. Write `depth: {width: ..., "
                "height: ..., intrinsics: {...}, T_color_depth: [[...]]}` under each camera whose depth is not registered"
            )
        if self.files:
            self.files.value().check(list(self.cameras))
        return self


def read_dataset(path: Path) -> Dataset:
    """What a dataset.yaml says.

    Raises
    ------
    ConfigError
        No such file, an unknown or a wrong key.
    """
    model = parse(DatasetModel, load_yaml(path), path)
    try:
        cameras = {name: camera.value(model.depth_scale or 0.001) for name, camera in model.cameras.items()}
    except ValueError as error:  # a lens
        raise ConfigError(f"{path}: {error}") from None
    extra = {key: value for key in ("corrected", "notes") if (value := getattr(model, key)) is not None}
    return Dataset(
        cameras,
        model.board.value() if model.board else None,
        model.files.value() if model.files else None,
        model.synchronous,
        model.depth_scale is not None,
        extra,
    )


def write_dataset(
    folder: Path,
    cameras: Mapping[str, CameraInfo],
    board: Board | None,
    extra: Mapping[str, Any] | None = None,
    *,
    files: FilePatterns | None = None,
    synchronous: bool = True,
) -> None:
    """Write dataset.yaml into `folder`; the depth scale stands with each camera of which it is known."""
    write_text(folder / "dataset.yaml", dump_yaml(dataset_data(cameras, board, extra, files, synchronous)))


def dataset_data(
    cameras: Mapping[str, CameraInfo],
    board: Board | None,
    extra: Mapping[str, Any] | None = None,
    files: FilePatterns | None = None,
    synchronous: bool = True,
) -> dict[str, Any]:
    """What dataset.yaml holds, as a mapping."""
    registered = all(info.depth is None for info in cameras.values())
    data: dict[str, Any] = {"format": "rgbd-calib/dataset", "version": 1, "depth_registered": registered}
    if not synchronous:
        data["synchronous"] = False
    if files is not None:
        data["files"] = {kind: text for kind, text in files.by_kind().items() if text is not None}
    data["cameras"] = {name: _camera_data(info) for name, info in cameras.items()}
    if board is not None:
        data["board"] = BoardModel.of(board).model_dump(exclude_none=True)
    return data | dict(extra or {})


def _camera_data(info: CameraInfo) -> dict[str, Any]:
    entry: dict[str, Any] = {"width": info.width, "height": info.height}
    depth: dict[str, Any] = {}
    if info.float_unit_m == info.depth_scale or info.float_unit_m != 1.0:
        depth["scale_m"] = info.float_unit_m
    elif info.depth_stated or info.depth_scale != 0.001:
        entry["depth_scale"] = info.depth_scale
    if info.serial is not None:
        entry["serial"] = info.serial
    if info.intrinsics is not None:
        entry["intrinsics"] = IntrinsicsModel.of(info.intrinsics).model_dump()
    if info.depth is not None:
        depth = {"width": info.depth.width, "height": info.depth.height} | depth
        if info.depth.intrinsics is not None:
            sd = {} if info.depth.intrinsics_sd is None else {"sd": list(info.depth.intrinsics_sd)}
            depth["intrinsics"] = IntrinsicsModel.of(info.depth.intrinsics).model_dump() | sd
        if info.depth.T_color_depth is not None:
            depth["T_color_depth"] = info.depth.T_color_depth.tolist()
    if info.kind is not None:
        depth["kind"] = info.kind
    if info.invalid:
        depth["invalid"] = [int(v) if v == int(v) else v for v in info.invalid]
    return entry | ({"depth": depth} if depth else {})
