"""`quality` of a rig file: the records of :mod:`rgbd_calib.quality` from what YAML holds, and back."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from itertools import zip_longest
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import ValidationError

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.plain import plain
from rgbd_calib.io.schema_parts import BoardModel, BoardShapeModel
from rgbd_calib.io.tables import short
from rgbd_calib.quality import CameraStatistics, Quality
from rgbd_calib.types import Board, BoardShape

_KINDS = "corrected_kinds"
"""In a file, beside the sentences of `corrected`."""


def quality_data(quality: Quality) -> dict[str, Any]:
    """What a rig file holds of it."""
    data: dict[str, Any] = plain(quality)
    if quality.corrected is not None:
        data |= {"corrected": [own.text for own in quality.corrected]}
        data |= {_KINDS: [own.kind and own.kind.value for own in quality.corrected]}
    if quality.board_shape is not None:
        data["board"] = {"shape": data.pop("board_shape")}
    return data


def quality_of(data: Mapping[str, Any]) -> Quality:
    """The records; a key whose value is not as expected stays as it is in `other`, and `faults` says why."""
    form = {key: value for key, value in data.items() if key != _KINDS}
    if isinstance(texts := data.get("corrected"), list):
        kinds = data.get(_KINDS) or ()
        form["corrected"] = [{"text": t, "kind": k} for t, k in zip_longest(texts, kinds)]
    if isinstance(board := data.get("board"), Mapping) and set(board) == {"shape"}:
        form["board_shape"] = form.pop("board")["shape"]
    known, other, faults = _fitting(Quality, form)
    for key in faults:
        other |= {own: data[own] for own in (key, _KINDS if key == "corrected" else key) if own in data}
    return Quality(**known, other=other, faults=faults)


def statistics_of(data: Mapping[str, Any]) -> CameraStatistics:
    """What a rig file says of a camera beside its parameters; what is not as expected stays in `other`."""
    known, other, _ = _fitting(CameraStatistics, data)
    return CameraStatistics(**known, other=other)


def _fitting(kind: type, data: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
    """Values that fit a record's fields, the others as they are, and why those do not fit that have a field's name."""
    keys, known, other, faults = _keys(kind), {}, {}, {}
    for key, value in data.items():
        if key not in keys:
            other[key] = value
            continue
        try:
            known[keys[key][0]] = _read(keys[key][1], value, key)
        except (TypeError, ValueError, OverflowError) as error:
            other[key], faults[key] = value, _why(error, key)
    return known, other, faults


def _why(error: Exception, key: str) -> str:
    """In one sentence, of a schema's error too."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    place = ".".join(map(str, (key, *first["loc"])))
    seen = "" if isinstance(first["input"], dict) else f" {short(first['input'])} seen;"
    return f"{place}:{seen} {first['msg'].removeprefix('Value error, ')}"


def board_fields(quality: Mapping[str, Any]) -> dict[str, Any] | None:
    """The board of a rig file as a dataset's `board` has it, unchecked."""
    own = quality.get("board")
    if not isinstance(own, Mapping) or "cols" not in own:
        return None
    return {
        name.removesuffix("_m"): value for name, value in own.items() if value or name not in ("marker_m", "dictionary")
    }


@cache
def _keys(kind: type) -> dict[str, tuple[str, Any]]:
    """Name and type, by key of a file, of a record's fields."""
    hints = get_type_hints(kind)
    return {f.name.rstrip("_"): (f.name, hints[f.name]) for f in fields(kind) if f.default_factory is MISSING}


def _read(hint: Any, value: Any, at: str) -> Any:
    """The value as the type of the hint; an empty mapping stands for no record.

    Raises
    ------
    TypeError, ValueError
        It is of another type.
    """
    kind, args = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        if value is None or (value == {} and any(map(is_dataclass, args))):
            return None
        *others, last = (own for own in args if own is not NoneType)
        with suppress(TypeError, ValueError):
            return _read(others[0], value, at) if others else _read(last, value, at)
        return _read(last, value, at)
    if kind is Board and isinstance(value, Mapping):
        return BoardModel.model_validate(board_fields({"board": value}) or value).value()
    if kind is BoardShape:
        return BoardShapeModel.model_validate(value).value()
    if isinstance(kind, type) and is_dataclass(kind) and isinstance(value, Mapping):
        return _record(kind, value, at)
    if kind is Mapping and isinstance(value, Mapping):
        return {str(key): _read(args[1], own, f"{at}.{key}") for key, own in value.items()}
    if kind is tuple and isinstance(value, list | tuple):
        kinds = args[:1] * len(value) if args[-1] is ... else args
        return tuple(_read(k, own, f"{at}[{i}]") for i, (k, own) in enumerate(zip(kinds, value, strict=True)))
    if kind is Literal and value in args:
        return value
    with suppress(TypeError, ValueError):
        if hint == FloatArray:
            return np.array(value, float)
        if isinstance(kind, type) and issubclass(kind, Enum):
            return kind(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return value
    if type(value) is kind:
        return value
    raise ValueError(f"{at}: {short(value)} seen, {getattr(hint, '__name__', hint)} needed")


def _record(kind: type, value: Mapping[str, Any], at: str) -> Any:
    keys, known, other = _keys(kind), {}, {}
    for key, own in value.items():
        if key in keys:
            name, hint = keys[key]
            known[name] = _read(hint, own, f"{at}.{key}")
        else:
            other[key] = own
    try:
        return kind(**known, **({"other": other} if other else {}))
    except TypeError as error:  # it names what is missing
        raise ValueError(f"{at}: {str(error).partition('() ')[2]}") from None
