"""Values in the types of YAML and JSON, and JSON that every program reads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.io.text import valid
from rgbd_calib.quality import Record

_UNSAFE_IN_SCRIPTS = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}
"""`<!--<script>` inside a script element hides its end; two line separators end a line of JavaScript before 2019."""


def plain(value: Any) -> Any:
    """The same value in YAML's own types: arrays become lists, numpy scalars numbers, paths text; all text is valid.

    Records become mappings, without what equals its default; of other data classes, without what is None.
    """
    if is_dataclass(value):
        value = _mapping(value)
    if isinstance(value, Mapping):
        return {valid(str(k)): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype.kind in "biuf" else plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Enum):
        return value.value
    return valid(str(value)) if isinstance(value, str | Path) else value


def _mapping(value: Any) -> dict[str, Any]:
    known = {f.name.rstrip("_"): (getattr(value, f.name), f) for f in fields(value) if f.default_factory is MISSING}
    if not isinstance(value, Record):
        return {key: own for key, (own, _) in known.items() if own is not None}
    own = {key: own for key, (own, f) in known.items() if own is not f.default}
    return own | {key: other for key, other in value.other.items() if key not in own}


def to_json(value: Any, **options: Any) -> str:
    """JSON of any value of this program, on the options of `json.dumps`: numbers that are not finite become null.

    JSON has no NaN; `json.dumps` writes it nevertheless, and no other program reads that.
    """
    return json.dumps(_finite(plain(value)), allow_nan=False, **options)


def to_json_in_html(value: Any) -> str:
    """JSON for a script element of a page: nothing in it can end the element, or hide its end."""
    return to_json(value, separators=(",", ":")).translate(_UNSAFE_IN_SCRIPTS)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
