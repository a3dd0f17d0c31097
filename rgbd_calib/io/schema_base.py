"""What all schemas share: numbers and names with their limits, the base of the models, and how a file is parsed.

A key that nobody knows is an error in what people write: dataset.yaml, lenses, boards. In files that this program writes
it passes, since other programs may keep their own there, unless it looks like a misspelt one.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.safe_yaml import MAX_BYTES
from rgbd_calib.io.tables import MAX_NAME, short
from rgbd_calib.io.yaml_lines import line_of

VERSION = 1
MAX_SIDE = 8192
"""Of an image, px: twice the largest RGB-D camera's. 8192 x 8192 pixels of colour and of depth in metres are 0.7 GB."""
MAX_CORNERS = 256
"""In a row or column of a board."""
MAX_UNKNOWN_KEYS = 200
LARGEST = 1e12
"""No number of a rig is larger, and the square of its cube is still a double."""


def no_boolean(value: Any) -> Any:
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
            f"a camera's name is that of its folder: 1 to {MAX_NAME} printable characters without / : and \\, no dot first and no "
            f"space at its ends; {short(text)} seen"
        )
    return text


Name = Annotated[str, AfterValidator(check_name)]
Finite = Annotated[float, BeforeValidator(no_boolean), Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, BeforeValidator(no_boolean), Field(gt=0, le=LARGEST, allow_inf_nan=False)]
Side = Annotated[int, BeforeValidator(no_boolean), Field(gt=0, le=MAX_SIDE)]
Corners = Annotated[int, BeforeValidator(no_boolean), Field(ge=2, le=MAX_CORNERS)]


def metres(value: Any) -> Any:
    """Refuse a length that is in another unit, and say what it is in metres."""
    if isinstance(value, int | float) and 1 < value <= 1000:
        unit, factor = ("cm", 0.01) if value <= 20 else ("mm", 0.001)
        raise ValueError(f"metres needed, at most 1: for {value:g} {unit} write {factor * value:g}")
    return value


Length = Annotated[
    float, BeforeValidator(metres), BeforeValidator(no_boolean), Field(ge=0.001, le=1, allow_inf_nan=False)
]
"""Metres, of a part of a board."""
DepthUnit = Annotated[float, BeforeValidator(no_boolean), Field(ge=1e-6, le=1, allow_inf_nan=False)]
"""Metres for each unit of depth."""
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4)]
Vector6 = Annotated[list[Finite], Field(min_length=6, max_length=6)]
Matrix6 = Annotated[list[Vector6], Field(min_length=6, max_length=6)]


class Model(BaseModel):
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


class Strict(BaseModel):
    """Of files that people write: no other keys than these."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _no_unknown_key(cls, data: Any) -> Any:
        unknown = [key for key in data if key not in cls.model_fields] if isinstance(data, dict) else []
        if unknown:
            left = [k for k in cls.model_fields if k not in data]
            near = get_close_matches(str(unknown[0]).lower(), [k.lower() for k in left], 1, 0.6)
            similar = next((k for k in left if near and k.lower() == near[0]), None)
            hint = f"did you mean '{similar}'?" if similar else f"known are {', '.join(cls.model_fields)}"
            others = [short(key) for key in unknown[1:4]] + (["..."] if len(unknown) > 4 else [])
            named = f"no such key {short(unknown[0])}" + (f", nor {', '.join(others)}" if others else "")
            raise PydanticCustomError("unknown_key", "{text}", {"text": f"{named}; {hint}", "key": unknown[0]})
        return data


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
        unknown = first.get("ctx", {}).get("key") if first["type"] == "unknown_key" else None
        place = tuple(part for part in first["loc"] if part != "[key]") + (() if unknown is None else (str(unknown),))
        loc = place if unknown is None else place[:-1]
        key = ".".join(map(str, loc)) or "(top level)"
        key = key if key.isprintable() and len(key) < 200 else short(key)
        seen = "" if isinstance(first["input"], dict) else f" {short(first['input'])} seen;"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        line = find_line(path, place)
        where = f"{path}: line {line}: {key}" if line else f"{path}: {key}"
        raise ConfigError(f"{where}:{seen} {first['msg'].removeprefix('Value error, ')}{more}") from None


def find_line(path: Path, place: tuple[str | int, ...]) -> int | None:
    """Line of a key in the file, where the file can still be read."""
    try:
        return line_of(read_bytes(path, MAX_BYTES).decode("utf-8"), place)
    except (ConfigError, UnicodeDecodeError):
        return None
