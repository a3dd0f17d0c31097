"""Schemas of what several files hold: intrinsics, depth errors, a board."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from rgbd_calib.geometry.camera import LENSES, Intrinsics
from rgbd_calib.geometry.depth_error import FIELD_AT_M, CellPattern, GridField, PolynomialField, n_terms
from rgbd_calib.io.schema_base import (
    MAX_CORNERS,
    Corners,
    DepthUnit,
    Finite,
    Length,
    Matrix4,
    Model,
    Positive,
    Side,
    Strict,
    Vector3,
    check_rigid,
    no_boolean,
)
from rgbd_calib.types import APRILGRID_TAGS, Board, BoardShape, BoardType, DepthBias, DepthCamera, DepthField


class IntrinsicsModel(Strict):
    """Pixel (0, 0) is the centre of the top left pixel; distortion has 4, 5, 8, 12 or 14 numbers in OpenCV's order (k1, k2,
    p1, p2, k3, ...), or, of `model: kannala_brandt`, the four of OpenCV's fisheye."""

    model: Literal["opencv", "kannala_brandt"] = "opencv"
    width: Side
    height: Side
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    distortion: Annotated[list[Finite], Field(max_length=14, default_factory=list)]

    @model_validator(mode="after")
    def _coefficients(self) -> IntrinsicsModel:
        sizes = LENSES[self.model].SIZES
        if not self.distortion:
            self.distortion = [0.0] * (5 if self.model == "opencv" else sizes[0])
        if len(self.distortion) not in sizes:
            raise ValueError(
                f"distortion: {len(self.distortion)} numbers, {' or '.join(map(str, sizes))} needed for model {self.model}"
            )
        return self

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> IntrinsicsModel:
        values = {k: getattr(intrinsics, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
        return cls(**values, model=intrinsics.model, distortion=list(intrinsics.distortion))

    def value(self) -> Intrinsics:
        own = self
        return Intrinsics(own.width, own.height, own.fx, own.fy, own.cx, own.cy, tuple(own.distortion), own.model)


class DepthBiasModel(Model):
    """z_true = z + c0 + c1 z + c2 z^2 + ... + r4 P4(t) + r5 P5(t) + ..., metres, on [min_m, max_m]; held at the ends outside.

    P4, P5, ... are Legendre's polynomials; t goes from -1 at min_m to 1 at max_m. data_m is the range of the data, where the
    curve goes on beyond it.
    """

    coefficients: Annotated[list[Finite], Field(min_length=1, max_length=8)]
    min_m: Finite
    max_m: Finite
    ripple_m: Annotated[list[Finite], Field(max_length=30)] = Field(default_factory=list)
    along_ray: bool = False
    """t is of the distance along the pixel's ray, in place of z."""
    rms_m: Finite = 0.0
    covariance: list[list[Finite]] | None = None
    data_m: tuple[Finite, Finite] | None = None

    @model_validator(mode="after")
    def _range(self) -> DepthBiasModel:
        if not self.min_m < self.max_m:
            raise ValueError(f"min_m {self.min_m} is not below max_m {self.max_m}")
        if self.data_m is not None and not self.min_m <= self.data_m[0] < self.data_m[1] <= self.max_m:
            raise ValueError(f"data_m {list(self.data_m)} is no range within {self.min_m} to {self.max_m}")
        n = len(self.coefficients) + len(self.ripple_m)
        if self.covariance is not None and [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"covariance is not {n} x {n}, one row for each coefficient")
        return self

    @classmethod
    def of(cls, bias: DepthBias) -> DepthBiasModel:
        covariance = None if bias.covariance is None else bias.covariance.tolist()
        return cls(
            coefficients=list(bias.coefficients),
            ripple_m=list(bias.ripple_m),
            along_ray=bias.along_ray,
            min_m=bias.min_m,
            max_m=bias.max_m,
            rms_m=bias.rms_m,
            covariance=covariance,
            data_m=bias.data_m,
        )

    def value(self) -> DepthBias:
        covariance = None if self.covariance is None else np.array(self.covariance)
        ripple_m = tuple(self.ripple_m)
        return DepthBias(
            tuple(self.coefficients),
            self.min_m,
            self.max_m,
            self.rms_m,
            covariance,
            ripple_m,
            self.along_ray,
            self.data_m,
        )


class CellPatternModel(Model):
    """sum_p z^p times values (powers, rows, columns) of cells that fill the image, linear between their middles."""

    powers: Annotated[list[Annotated[int, Field(ge=-2, le=4)]], Field(min_length=1, max_length=4)]
    values: Annotated[list[Annotated[list[list[Finite]], Field(min_length=1, max_length=500)]], Field(min_length=1)]
    covariance: list[list[Finite]] | None = None

    @model_validator(mode="after")
    def _box(self) -> CellPatternModel:
        n = len(self.powers)
        if self.covariance is not None and [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"covariance is not {n} x {n}, one row for each power")
        if len(self.values) != len(self.powers):
            raise ValueError("values are not one table for each power")
        if len({(len(table), len(row)) for table in self.values for row in table}) != 1 or not self.values[0][0]:
            raise ValueError("values are not tables of one size, with rows of one length")
        return self

    def value(self) -> CellPattern:
        covariance = None if self.covariance is None else np.array(self.covariance)
        return CellPattern(tuple(self.powers), np.array(self.values), covariance)


class PolynomialFieldModel(Model):
    """(z / z0)^(p + q ln(z / z0)) sum_k c_k T_k(x, y), z0 = at_m: products of Legendre polynomials in x, y (-1 to 1 over the image) by total degree from 1
    on, and within a degree by the power of y from the highest; z_true = z + bias(z) + field, z held to [min_m, max_m]."""

    basis: Literal["legendre"] = "legendre"
    width: Side
    height: Side
    degree: Annotated[int, Field(ge=1, le=20)]
    growth: tuple[Annotated[float, Field(ge=-30, le=30)], Annotated[float, Field(ge=-30, le=30)]]
    """p, q."""
    coefficients: list[Finite]
    min_m: Positive
    max_m: Positive
    at_m: Positive = FIELD_AT_M
    covariance: list[list[Finite]] | None = None
    pattern: CellPatternModel | None = None
    """What is finer than the polynomials, where walls showed it."""

    @model_validator(mode="after")
    def _lengths(self) -> PolynomialFieldModel:
        n = n_terms(self.degree) - 1
        if len(self.coefficients) != n:
            raise ValueError(f"{len(self.coefficients)} coefficients, {n} needed, one for each term")
        if self.covariance is not None and [len(row) for row in self.covariance] != [n + 2] * (n + 2):
            raise ValueError(f"covariance is not {n + 2} x {n + 2}, of the coefficients, p and q")
        return self

    def value(self) -> PolynomialField:
        own = self
        covariance = None if own.covariance is None else np.array(own.covariance)
        return PolynomialField(
            own.width,
            own.height,
            own.degree,
            own.growth,
            np.array(own.coefficients),
            own.min_m,
            own.max_m,
            covariance,
            None if own.pattern is None else own.pattern.value(),
            own.at_m,
        )


class GridFieldModel(Model):
    """Values on a grid over pixel and depth, linear in between and held outside."""

    basis: Literal["grid"]
    u_px: Annotated[list[Finite], Field(min_length=2, max_length=500)]
    v_px: Annotated[list[Finite], Field(min_length=2, max_length=500)]
    z_m: Annotated[list[Finite], Field(min_length=2, max_length=100)]
    error_m: list[list[list[Finite]]]

    @model_validator(mode="after")
    def _lengths(self) -> GridFieldModel:
        try:
            shape = np.shape(np.array(self.error_m, float))
        except ValueError:
            shape = ()
        if shape != (len(self.u_px), len(self.v_px), len(self.z_m)):
            raise ValueError("error_m has another shape than u_px, v_px, z_m")
        if any(np.any(np.diff(axis) <= 0) for axis in (self.u_px, self.v_px, self.z_m)):
            raise ValueError("u_px, v_px and z_m must ascend")
        return self

    def value(self) -> GridField:
        return GridField(*(np.array(axis) for axis in (self.u_px, self.v_px, self.z_m, self.error_m)))


def field_data(field: DepthField) -> dict[str, Any]:
    """A depth field as a file holds it."""
    if isinstance(field, GridField):
        return {"basis": "grid", "u_px": field.u_px, "v_px": field.v_px, "z_m": field.z_m, "error_m": field.error}
    names = ("width", "height", "degree", "coefficients", "min_m", "max_m", "at_m", "covariance")
    own = {name: getattr(field, name) for name in names if getattr(field, name) is not None}
    if field.pattern is not None:
        pattern = field.pattern
        own["pattern"] = {"powers": list(pattern.powers), "values": pattern.values}
        if pattern.covariance is not None:
            own["pattern"]["covariance"] = pattern.covariance
    return {"basis": "legendre", "growth": list(field.growth), **own}


class DepthCameraModel(Model):
    """Geometry of depth that is not the colour image's; p_color = T_color_depth @ p_depth."""

    width: Side
    height: Side
    intrinsics: IntrinsicsModel | None = None
    T_color_depth: Matrix4 | None = None
    covariance: list[list[Finite]] | None = None
    scale_m: DepthUnit | None = None
    invalid: list[Annotated[int, Field(ge=0, le=65535)]] | None = None

    @model_validator(mode="after")
    def _pose(self) -> DepthCameraModel:
        if self.T_color_depth is not None:
            check_rigid(np.array(self.T_color_depth))
        own = self.intrinsics
        if own and (own.width, own.height) != (self.width, self.height):
            raise ValueError(f"intrinsics are for {own.width}x{own.height} px, depth has {self.width}x{self.height}")
        if self.covariance is not None and [len(row) for row in self.covariance] != [10] * 10:
            raise ValueError("covariance is not 10 x 10, of fx, fy, cx, cy and the pose")
        return self

    @classmethod
    def of(cls, camera: DepthCamera) -> DepthCameraModel:
        return cls(
            width=camera.intrinsics.width,
            height=camera.intrinsics.height,
            intrinsics=IntrinsicsModel.of(camera.intrinsics),
            T_color_depth=camera.T_color_depth.tolist(),
            covariance=None if camera.covariance is None else camera.covariance.tolist(),
        )

    def value(self) -> DepthCamera | None:
        """None where the lens is not known."""
        if self.intrinsics is None:
            return None
        T = np.eye(4) if self.T_color_depth is None else np.array(self.T_color_depth)
        return DepthCamera(self.intrinsics.value(), T, None if self.covariance is None else np.array(self.covariance))


Points = Annotated[list[Vector3], Field(min_length=4, max_length=MAX_CORNERS**2)]


class BoardShapeModel(Strict):
    """A print as measured: all corners in the order r * cols + c of the front, in the board's frame, metres; `back_m` is the
    physical corner behind each, absent on one-sided boards."""

    front_m: Points
    back_m: Points | None = None
    front_sd_m: Points | None = None
    back_sd_m: Points | None = None

    @classmethod
    def of(cls, shape: BoardShape) -> BoardShapeModel:
        names = ("front_m", "back_m", "front_sd_m", "back_sd_m")
        return cls(**{name: own.tolist() for name in names if (own := getattr(shape, name)) is not None})

    def value(self) -> BoardShape:
        back, front_sd, back_sd = (
            None if own is None else np.array(own) for own in (self.back_m, self.front_sd_m, self.back_sd_m)
        )
        return BoardShape(np.array(self.front_m), back, front_sd, back_sd)


class BoardModel(Strict):
    """`cols` and `rows` count inner corners; `square`, `thickness` and `marker` are metres."""

    type: BoardType = "checkerboard"
    cols: Corners
    rows: Corners
    square: Length
    two_sided: bool = False
    thickness: Annotated[float, BeforeValidator(no_boolean), Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.0
    marker: Length | None = None
    dictionary: str | None = None
    legacy: bool | None = None
    """A ChArUco board in the layout before OpenCV 4.6; nothing means no."""
    shape: BoardShapeModel | None = None

    @model_validator(mode="after")
    def _charuco(self) -> BoardModel:
        if self.type == "charuco" and (self.marker is None or self.dictionary is None):
            raise ValueError("a charuco board needs 'marker' (metres) and 'dictionary' (as DICT_5X5_250)")
        return self

    @model_validator(mode="after")
    def _aprilgrid(self) -> BoardModel:
        if self.type != "aprilgrid":
            return self
        if self.marker is None or not self.square < self.marker < 2 * self.square:
            raise ValueError(
                "an aprilgrid needs 'marker', the side of a tag (metres), and 'square', half of what tags are apart"
            )
        if self.cols % 2 or self.rows % 2:
            raise ValueError(
                f"{self.cols} x {self.rows} corners; an aprilgrid has two for each tag along columns and rows"
            )
        return self

    @model_validator(mode="after")
    def _shape(self) -> BoardModel:
        n = self.cols * self.rows
        for name, points in self.shape or ():
            if isinstance(points, list) and len(points) != n:
                raise ValueError(f"shape.{name} has {len(points)} corners, a {self.cols}x{self.rows} board has {n}")
        return self

    @classmethod
    def of(cls, board: Board) -> BoardModel:
        markers: dict[str, Any] = (
            {"marker": board.marker_m, "dictionary": board.dictionary, "legacy": board.legacy or None}
            if board.type != "checkerboard"
            else {}
        )
        return cls(
            type=board.type,
            cols=board.cols,
            rows=board.rows,
            square=board.square_m,
            two_sided=board.two_sided,
            thickness=board.thickness_m,
            shape=None if board.shape is None else BoardShapeModel.of(board.shape),
            **markers,
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
            self.dictionary or (APRILGRID_TAGS if self.type == "aprilgrid" else ""),
            self.legacy or False,
            None if self.shape is None else self.shape.value(),
        )
