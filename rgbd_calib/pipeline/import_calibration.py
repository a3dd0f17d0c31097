"""Calibrations of other programs to this program's intrinsics.yaml or rig.yaml."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import rgbd_calib
from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.io.calibrations import FoundCamera, Size, read_calibration
from rgbd_calib.io.files import dump_yaml, write_text
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.schema_parts import DepthCameraModel, IntrinsicsModel
from rgbd_calib.io.tables import short


@dataclass(frozen=True)
class ImportedCalibration:
    """What several files say together."""

    cameras: dict[str, FoundCamera]
    origins: dict[str, str]
    """Format and file by camera."""
    notes: tuple[str, ...]

    @property
    def is_rig(self) -> bool:
        """Every camera has a lens and a pose."""
        return all(own.intrinsics is not None and own.T_world_color is not None for own in self.cameras.values())


def read_calibrations(
    files: Sequence[tuple[str | None, Path]],
    rename: Mapping[str, str],
    size: Size | None = None,
    unit_m: float = 1.0,
) -> ImportedCalibration:
    """Read files and join their cameras.

    Parameters
    ----------
    files
        (name or None, path): a name is for the one camera of the file.
    rename
        New names by old ones.
    size
        Of the images, px, for files that do not say it.
    unit_m
        Metres for each unit of the files' translations.

    Raises
    ------
    ConfigError
        A file that cannot be read, a camera of two files, a name for a file of several cameras, or that is no name.
    """
    cameras: dict[str, FoundCamera] = {}
    origins: dict[str, str] = {}
    notes: list[str] = []
    renamed: set[str] = set()
    for given, path in files:
        found = read_calibration(path, size)
        notes += [f"{path}: {note}" for note in found.notes]
        if given is not None and len(found.cameras) > 1:
            raise ConfigError(
                f"{path}: {len(found.cameras)} cameras in it ({', '.join(found.cameras)[:200]}), one needed for the name "
                f"{given}. Name them with --rename OLD=NEW"
            )
        for name, camera in found.cameras.items():
            own = given or rename.get(name, name)
            renamed.add(name)
            try:
                check_name(own)
            except ValueError as error:
                raise ConfigError(f"{path}: camera {short(own)} seen; {error}. Name it: NAME=FILE, --rename") from None
            if own in cameras:
                raise ConfigError(
                    f"{path}: camera {own} is in {origins[own]} too. Name them: NAME=FILE, --rename OLD=NEW"
                )
            cameras[own] = _in_metres(camera, unit_m)
            origins[own] = f"{found.what} {path}"
    unknown = [old for old in rename if old not in renamed]
    if unknown:
        raise ConfigError(f"--rename {unknown[0]}: no such camera; there are {', '.join(cameras)}")
    return ImportedCalibration(cameras, origins, tuple(notes))


def write_calibration(path: Path, found: ImportedCalibration) -> None:
    """Write a rig file, or, where poses are missing, one with intrinsics alone."""
    data: dict[str, Any] = {"format": "rgbd-calib/rig", "version": 1}
    if found.is_rig:
        data["reference"] = _reference(found.cameras)
    data["cameras"] = {name: _entry(own, found.is_rig) for name, own in found.cameras.items()}
    program = f"rgbd-calib {rgbd_calib.__version__}"
    data["provenance"] = {"program": program, "imported_from": dict(found.origins)}
    write_text(path, dump_yaml(data))


def _entry(camera: FoundCamera, posed: bool) -> dict[str, Any]:
    entry: dict[str, Any] = {}
    if camera.intrinsics is not None:
        entry["intrinsics"] = IntrinsicsModel.of(camera.intrinsics).model_dump()
    if posed and camera.T_world_color is not None:
        T = camera.T_world_color
        entry |= {"T_world_color": T, "rotation_wxyz": so3.quaternion_wxyz(T[:3, :3]), "translation_m": T[:3, 3]}
    if camera.depth is not None:
        entry["depth"] = DepthCameraModel.of(camera.depth).model_dump(exclude_none=True)
    return entry


def _reference(cameras: Mapping[str, FoundCamera]) -> str:
    """The camera that is the world, else the first."""
    at_origin = [
        n for n, own in cameras.items() if own.T_world_color is not None and np.allclose(own.T_world_color, np.eye(4))
    ]
    return (at_origin or list(cameras))[0]


def _in_metres(camera: FoundCamera, unit_m: float) -> FoundCamera:
    if camera.T_world_color is None or unit_m == 1.0:
        return camera
    T = camera.T_world_color.copy()
    T[:3, 3] *= unit_m
    return replace(camera, T_world_color=T)
