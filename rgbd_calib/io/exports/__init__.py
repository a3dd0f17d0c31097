"""A rig in the formats of other programs: one module a format, each a pure function from a rig to texts.

Every module has ``export(rig, options) -> Export``. What a format cannot carry stops the export where it would change
the geometry, and is named in `Export.notes` where it only leaves something out.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.exports.common import Export, Options, without_lens
from rgbd_calib.io.files import whole_folder, write_text
from rgbd_calib.types import Rig


@dataclass(frozen=True)
class Format:
    """Of which form the result is; no suffixes means a folder."""

    suffixes: tuple[str, ...]
    what: str


FORMATS = {
    "ros": Format((), "folder: camera_info YAML, static transforms for ROS 2 (launch.py) and ROS 1 (launch)"),
    "kalibr": Format((".yaml", ".yml"), "camchain.yaml"),
    "colmap": Format((), "folder: text model with cameras, images, the rig and its one frame"),
    "nerfstudio": Format((".json",), "transforms.json"),
    "open3d": Format((".json",), "PinholeCameraTrajectory"),
    "opencv": Format((".yml", ".yaml", ".xml", ".json"), "FileStorage"),
    "mrcal": Format((), "folder: a .cameramodel of each camera"),
    "json": Format((".json",), "the rig file as JSON"),
}


def check_target(path: Path, to: str) -> None:
    """Raise ConfigError unless the name fits the format: the right suffix, or none for a folder."""
    suffixes = FORMATS[to].suffixes
    if suffixes and path.suffix.lower() not in suffixes:
        raise ConfigError(f"{path}: {to} is one file, its name must end in {' or '.join(suffixes)}. Rename it")
    if not suffixes and path.suffix.lower() in (".yaml", ".yml", ".json", ".txt", ".xml", ".zip"):
        raise ConfigError(f"{path}: {to} is several files in a folder. Give a folder, as {path.with_suffix('')}")


def export(rig: Rig, to: str, options: Options) -> Export:
    """The rig in format `to`, one of FORMATS.

    Raises
    ------
    ConfigError
        The format cannot carry this rig.
    """
    module: Callable[[Rig, Options], Export] = importlib.import_module(f"rgbd_calib.io.exports.{to}_").export
    return module(without_lens(rig) if options.undistorted else rig, options)


def write(path: Path, result: Export, overwrite: bool) -> None:
    """Write the file, or the folder of files, whole or not at all."""
    if list(result.files) == [""]:
        write_text(path, result.files[""])
        return
    with whole_folder(path, overwrite) as folder:
        for name, text in result.files.items():
            write_text(folder / name, text)
