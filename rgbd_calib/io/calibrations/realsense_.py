"""JSON with RealSense intrinsics, as scripts write them from `rs2_intrinsics` and `rs2_extrinsics`: anywhere in the file,
objects with width, height, fx, fy, ppx, ppy (model, coeffs), and depth_to_color with rotation (column by column) and
translation (m)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera, Tree, needed, numbers, rigid
from rgbd_calib.io.calibrations.makers_lens import lens_of_maker
from rgbd_calib.types import DepthCamera

_KEYS = ("width", "height", "fx", "fy", "ppx", "ppy")
_DEEPEST = 8


def recognises(document: Document) -> bool:
    return any(True for _ in _lenses(document.tree))


def read(document: Document) -> FoundCalibration:
    path, notes = document.path, []
    lenses = {}
    for keys, own in _lenses(document.tree):
        name = "_".join(k for k in keys if k not in ("intrinsics", "intrinsic", ""))[:200] or document.stem
        width, height, fx, fy, ppx, ppy = numbers(path, name, [own[key] for key in _KEYS], 6)
        size = (int(width), int(height))
        coefficients = needed(path, name, own, "coeffs", "coefficients")
        lenses[name], note = lens_of_maker(
            path, name, size, (fx, fy), (ppx, ppy), str(own.get("model", "")), coefficients
        )
        notes += [note] if note else []
    color = [n for n in lenses if not _is_depth(n)]
    depth = [n for n in lenses if _is_depth(n)]
    pose = next((own for key, own in _extrinsics(document.tree) if _from_depth(key)), None)
    if len(color) == len(depth) == 1 and pose is not None:
        R = numbers(path, "depth_to_color.rotation", pose["rotation"], 9).reshape(3, 3).T
        T = rigid(path, "depth_to_color", R, numbers(path, "depth_to_color.translation", pose["translation"], 3))
        camera = FoundCamera(lenses[color[0]], depth=DepthCamera(lenses[depth[0]], T))
        return FoundCalibration("RealSense intrinsics", {document.stem: camera}, tuple(notes))
    return FoundCalibration("RealSense intrinsics", {n: FoundCamera(own) for n, own in lenses.items()}, tuple(notes))


def _lenses(tree: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Tree]]:
    if not isinstance(tree, dict) or len(keys) > _DEEPEST:
        return
    if all(key in tree for key in _KEYS):
        yield keys, tree
        return
    for key, own in tree.items():
        yield from _lenses(own, (*keys, str(key)))


def _extrinsics(tree: Any, key: str = "", depth: int = 0) -> Iterator[tuple[str, Tree]]:
    if not isinstance(tree, dict) or depth > _DEEPEST:
        return
    if "rotation" in tree and "translation" in tree:
        yield key, tree
        return
    for own_key, own in tree.items():
        yield from _extrinsics(own, str(own_key), depth + 1)


def _is_depth(name: str) -> bool:
    return "depth" in name.lower()


def _from_depth(key: str) -> bool:
    words = key.lower().replace("2", "_to_")
    return words.startswith("depth") and words.endswith(("color", "colour", "rgb"))
