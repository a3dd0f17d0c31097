"""What the readers of foreign calibrations share: documents, matrices, lenses, and what is found."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydantic import ValidationError

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import safe_yaml
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.schema_parts import IntrinsicsModel
from rgbd_calib.io.tables import short
from rgbd_calib.types import DepthCamera

MAX_BYTES = 64 << 20
Size = tuple[int, int]
Tree = Mapping[str, Any]
Numbers = Sequence[float] | FloatArray


@dataclass(frozen=True)
class FoundCamera:
    """What a calibration says of one camera."""

    intrinsics: Intrinsics | None = None
    T_world_color: FloatArray | None = None
    """(4, 4), p_world = T_world_color @ p_color, metres; None: not said."""
    depth: DepthCamera | None = None
    """Its depth camera, where depth is not registered."""


@dataclass(frozen=True)
class FoundCalibration:
    """What a file or folder holds."""

    what: str
    """The format, in words."""
    cameras: dict[str, FoundCamera]
    notes: tuple[str, ...] = ()
    """What was assumed, and what is not used."""


@dataclass(frozen=True)
class Document:
    """A file of a calibration, or a folder."""

    path: Path
    tree: Tree = field(default_factory=dict)
    """Of YAML, JSON, XML or TOML: its mapping; empty otherwise."""
    text: str = ""
    """Empty for a folder."""
    size: Size | None = None
    """Of the images, px, where the user says it."""

    @property
    def stem(self) -> str:
        return self.path.stem

    def need_size(self, seen: Any = None) -> Size:
        """Width and height: as the file says, or the user.

        Raises
        ------
        ConfigError
            Nobody says it.
        """
        if seen is not None:
            width, height = numbers(self.path, "image size", seen, 2)
            return int(width), int(height)
        if self.size is None:
            raise ConfigError(f"{self.path}: the size of the images is not in it. Give it, as --size 640x480")
        return self.size


def load_document(path: Path, size: Size | None = None) -> Document:
    """A file by its suffix and content.

    Raises
    ------
    ConfigError
        No such file, no text, or not the YAML, JSON, XML or TOML that it seems to be.
    """
    if path.is_dir():
        return Document(path, size=size)
    data = read_bytes(path, MAX_BYTES)
    if b"\0" in data[:1000]:
        return Document(path, size=size)
    try:
        text = data.decode("utf-8-sig")
        tree = _parse(path.suffix.lower(), text)
    except (ValueError, RecursionError, safe_yaml.UnsafeYaml, ElementTree.ParseError) as error:
        why = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path}: cannot be read ({why}). Is it complete? Copy it again") from error
    return Document(path, tree if isinstance(tree, dict) else {"": tree}, text, size)


def _parse(suffix: str, text: str) -> Any:
    if suffix == ".json":
        try:
            return json.loads(text)
        except ValueError:
            return json.loads(_unescaped(text))
    if suffix == ".xml":
        return _xml_tree(text)
    if suffix == ".toml":
        try:
            import tomllib
        except ImportError:  # Python 3.10
            import tomli as tomllib  # type: ignore[no-redef, import-not-found, unused-ignore]
        return tomllib.loads(text)
    if suffix in (".yaml", ".yml"):
        of_opencv = text.startswith("%YAML")  # no YAML to others, and its words are not quoted
        if of_opencv:
            text = _unescaped(text.partition("\n")[2])
        return safe_yaml.load(re.sub(r"!!opencv-[\w-]+", "", text), as_text=of_opencv)
    return {}


def _unescaped(text: str) -> str:
    r"""Without the backslash that OpenCV writes before ', which neither JSON nor YAML has: "it\'s"."""
    return re.sub(r"(\\[^'])|\\'", lambda match: match[1] or "'", text)


def _xml_tree(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type in it; plain XML is needed")
    return _element(ElementTree.fromstring(text))


def _element(element: ElementTree.Element) -> Any:
    children = list(element)
    if not children:
        text = (element.text or "").strip()
        if len(text) > 1 and text[0] == text[-1] == '"' and not re.search(r'"\s+"', text):
            return text[1:-1]  # OpenCV quotes strings that are no words
        words = text.split()
        return words if len(words) > 1 else words[0] if words else ""
    if all(child.tag == "_" for child in children):
        return [_element(child) for child in children]
    return {child.tag: _element(child) for child in children}


def needed(path: Path, where: str, tree: Mapping[str, Any], *keys: str) -> Any:
    """The value of the first of these keys that is there; a lens without distortion says so, as zeros or an empty list.

    Raises
    ------
    ConfigError
        None of them is: a mistyped key would make a lens without distortion of any.
    """
    for key in keys:
        if key in tree:
            return tree[key]
    raise ConfigError(
        f"{path}: {where}: {keys[0]} expected, {', '.join(map(short, tree))} found. Write it, as [] for a lens without distortion"
    )


def numbers(path: Path, key: str, value: Any, n: int | Sequence[int] | None = None) -> FloatArray:
    """The numbers (n,) of a value: a list, nested lists, or an OpenCV or ROS matrix `{rows, cols, data}`.

    Raises
    ------
    ConfigError
        Something else than finite numbers, or another count than `n` (one of `n`) of them.
    """
    if isinstance(value, Mapping) and "data" in value:
        value = value["data"]
    try:
        flat = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"{path}: {key}: {short(value)} seen, numbers needed. Correct it") from None
    counts = () if n is None else (n,) if isinstance(n, int) else tuple(n)
    if not np.all(np.isfinite(flat)) or np.any(np.abs(flat) > 1e12):
        raise ConfigError(f"{path}: {key}: {short(value)} seen, finite numbers needed. Correct it")
    if counts and len(flat) not in counts:
        raise ConfigError(
            f"{path}: {key}: {len(flat)} numbers seen, {' or '.join(map(str, counts))} needed. Correct it"
        )
    return flat


def matrix(path: Path, key: str, value: Any, rows: int, cols: int) -> FloatArray:
    """A matrix (rows, cols); see :func:`numbers`."""
    return numbers(path, key, value, rows * cols).reshape(rows, cols)


def rigid(path: Path, key: str, R: FloatArray, t: FloatArray) -> FloatArray:
    """A motion (4, 4) of a rotation matrix (3, 3), which single precision may have rounded, and a translation (3,).

    Raises
    ------
    ConfigError
        It is no rotation.
    """
    U, s, Vt = np.linalg.svd(R)
    if np.abs(s - 1).max() > 1e-3 or np.linalg.det(U @ Vt) < 0:
        raise ConfigError(
            f"{path}: {key}: no rotation (singular values {s[0]:.3g}, {s[1]:.3g}, {s[2]:.3g}). Correct it"
        )
    T = np.eye(4)
    # matrices that are rotations to the last digit stay as they are
    T[:3, :3] = R if np.abs(R.T @ R - np.eye(3)).max() < 1e-12 else U @ Vt
    T[:3, 3] = t
    return T


def rigid_of_matrix(path: Path, key: str, value: Any) -> FloatArray:
    """A motion (4, 4) of a 4x4 or 3x4 matrix."""
    flat = numbers(path, key, value, (12, 16))
    top = flat[:12].reshape(3, 4)
    return rigid(path, key, top[:, :3], top[:, 3])


def rigid_of_vectors(path: Path, key: str, rotation: Any, translation: Any) -> FloatArray:
    """A motion (4, 4) of a rotation vector (rad) or matrix, and a translation."""
    turn, t = numbers(path, key, rotation, (3, 9)), numbers(path, key, translation, 3)
    return rigid(path, key, so3.exp(turn) if len(turn) == 3 else turn.reshape(3, 3), t)


def rigid_of_quaternion(path: Path, key: str, wxyz: Any, translation: Any) -> FloatArray:
    """A motion (4, 4) of a quaternion w, x, y, z and a translation."""
    q = numbers(path, key, wxyz, 4)
    norm = float(np.linalg.norm(q))
    if not 0.9 < norm < 1.1:
        raise ConfigError(f"{path}: {key}: a quaternion of length {norm:.3g} seen, 1 needed. Correct it")
    return rigid(path, key, so3.of_quaternion(q), numbers(path, key, translation, 3))


def lens(
    path: Path,
    camera: str,
    size: Size,
    focal: Numbers,
    centre: Numbers,
    distortion: Numbers = (),
    fisheye: bool = False,
) -> Intrinsics:
    """Intrinsics, checked; pixel (0, 0) is the centre of the top left pixel.

    Raises
    ------
    ConfigError
        A lens that cannot be, or a number of coefficients that no model has.
    """
    fields = dict(zip(("width", "height", "fx", "fy", "cx", "cy"), (*size, *focal, *centre), strict=True))
    own: dict[str, Any] = {
        "model": "kannala_brandt" if fisheye else "opencv",
        "distortion": list(map(float, distortion)),
    }
    try:
        return IntrinsicsModel(**fields, **own).value()  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "lens"
        raise ConfigError(
            f"{path}: {camera}: {key}: {first['msg'].removeprefix('Value error, ')}. Correct it"
        ) from None


def lens_of_matrix(
    path: Path, camera: str, size: Size, K: FloatArray, distortion: Numbers = (), fisheye: bool = False
) -> Intrinsics:
    """Intrinsics of a camera matrix (3, 3).

    Raises
    ------
    ConfigError
        The matrix has skew, or is none of a camera.
    """
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]) or np.any(np.abs(K[[1, 2, 2], [0, 0, 1]]) > 1e-9) or abs(K[2, 2] - 1) > 1e-9:
        raise ConfigError(f"{path}: {camera}: camera matrix with skew, or none at all, seen. Correct it")
    return lens(path, camera, size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), distortion, fisheye)
