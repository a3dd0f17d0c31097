"""One camera's entry of a rig file changed or added in place: every other line stays as it is, byte for byte."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import yaml

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import safe_yaml
from rgbd_calib.io.files import dump_yaml, load_yaml, write_text
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.rig import camera_entry
from rgbd_calib.io.safe_yaml import MAX_BYTES
from rgbd_calib.quality import CameraUpdate
from rgbd_calib.types import RigCamera

STALE = ("alignment_on_recording", "expected_alignment")
"""Of a rig's quality: no longer true once a camera is changed."""
_HASH = "residuals_sha256"


def write_update(
    source: Path, output: Path, name: str, camera: RigCamera, report: CameraUpdate, provenance: dict[str, Any]
) -> None:
    """Write the rig file `source` with another entry for camera `name` to `output`.

    `quality` loses the figures of the whole rig and gains the report under `updates`, `provenance` likewise.

    Raises
    ------
    ConfigError
        The file's sections are not blocks (a whole section in braces).
    """
    write_updates(source, output, {name: (camera, report)}, {name: provenance})


def write_updates(
    source: Path,
    output: Path,
    changes: Mapping[str, tuple[RigCamera, CameraUpdate]],
    provenance: Mapping[str, dict[str, Any]],
) -> None:
    """The same for several cameras, or none: entry and report, and provenance, by camera."""
    load_yaml(source)  # that it is safe to read, and a mapping
    text = read_bytes(source, MAX_BYTES).decode("utf-8")
    for name, (camera, report) in changes.items():
        text = _updated(text, source, name, camera, report, provenance[name])
    write_text(output, text)


def _updated(
    text: str, source: Path, name: str, camera: RigCamera, report: CameraUpdate, provenance: dict[str, Any]
) -> str:
    """The text of a rig file with one entry changed; `source` is for messages."""
    data = safe_yaml.load(text)
    lines = text.splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    # load_yaml has seen that it is a mapping, and that it is safe to compose
    root = cast(yaml.MappingNode, yaml.compose(text, Loader=loader))
    top = _blocks(root, len(lines), source)
    if "cameras" not in top or any(getattr(event, "anchor", None) for event in yaml.parse(text, Loader=loader)):
        raise ConfigError(
            f"{source}: anchors (&), aliases (*) or merged keys (<<) seen; every camera written out is needed to change one. "
            "Write them out"
        )
    cameras = next(value for key, value in root.value if key.value == "cameras")
    end = top["cameras"][1]
    entries = _blocks(cameras, end, source)
    indent = " " * cameras.value[0][0].start_mark.column
    new = textwrap.indent(dump_yaml({name: camera_entry(camera)}), indent).splitlines(keepends=True)
    at = entries.get(name, (end, end))
    changes = [(at, new)]
    quality = {k: v for k, v in (data.get("quality") or {}).items() if k not in STALE}
    if _HASH in quality:
        quality[_HASH] = None
    for key, value, added in (
        ("quality", quality, report),
        ("provenance", data.get("provenance") or {}, provenance),
    ):
        section = {key: value | {"updates": [*value.get("updates", []), added]}}
        changes.append((top.get(key, (len(lines), len(lines))), dump_yaml(section).splitlines(keepends=True)))
    # from the end, so that earlier line numbers hold; of two additions at one line the later stands below
    for _, ((start, stop), block) in sorted(enumerate(changes), key=lambda c: (c[1][0][0], c[0]), reverse=True):
        lines[start:stop] = block
    return "".join(lines)


def _blocks(node: yaml.Node, end: int, path: Path) -> dict[str, tuple[int, int]]:
    """Lines (first, one past the last) of each key's block of a mapping that ends before line `end`."""
    if not isinstance(node, yaml.MappingNode) or node.flow_style or not node.value:
        raise ConfigError(
            f"{path}: a section in braces seen, one key a line is needed to change it. Write it as a block"
        )
    starts = [key.start_mark.line for key, _ in node.value]
    return {key.value: (a, b) for (key, _), a, b in zip(node.value, starts, [*starts[1:], end], strict=True)}
