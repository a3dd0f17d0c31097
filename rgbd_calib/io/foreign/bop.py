"""Scenes of the BOP benchmark: rgb/ (or gray/), depth/, and scene_camera.json with cam_K and depth_scale (millimetres for
each unit) of every image. Depth is registered.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import MAX_BYTES, lens_of_matrix, numbers
from rgbd_calib.io.foreign.folder import PictureFolder
from rgbd_calib.io.foreign.source import Source, SourceCamera, SourceImage, Stems, Wanted
from rgbd_calib.io.reading import read_bytes


def is_bop(path: Path) -> bool:
    return (path / "scene_camera.json").is_file()


class BopScene(Source):
    """One camera."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        color = "rgb" if (path / "rgb").is_dir() else "gray"
        patterns = {"color": f"{color}/{{frame}}.*"}
        if (path / "depth").is_dir():
            patterns["depth"] = "depth/{frame}.*"
        self._folder = PictureFolder(path, camera, patterns)  # type: ignore[arg-type]
        file = path / "scene_camera.json"
        images = list(_scene(file).values())
        stream = self._folder._guess.streams["color"]["C1"].sniffed
        size = (stream.width, stream.height)
        lens, remarks = _lens(file, images, size)
        scales = {float(numbers(file, "depth_scale", own.get("depth_scale"), 1)[0]) for own in images}
        if len(scales) > 1 or not 1e-3 <= next(iter(scales)) <= 1000:
            raise ConfigError(
                f"{file}: depth_scale {sorted(scales)[:3]} seen, one from 0.001 to 1000 for all images needed"
            )
        self.cameras = {camera: SourceCamera(lens, None, next(iter(scales)) / 1000, True)}
        self.remarks = (*remarks, *self._folder.remarks)

    def stems(self) -> Mapping[str, Stems]:
        return self._folder.stems()

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        return self._folder.pictures(wanted)


def _scene(path: Path) -> dict[str, dict[str, Any]]:
    try:
        tree = json.loads(read_bytes(path, MAX_BYTES).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON ({str(error)[:200]}). Is it complete?") from None
    if not isinstance(tree, dict) or not tree or not all(isinstance(own, dict) for own in tree.values()):
        raise ConfigError(f"{path}: an entry with cam_K and depth_scale for each image needed. Is it the right file?")
    return tree


def _lens(path: Path, images: list[dict[str, Any]], size: tuple[int, int]) -> tuple[Intrinsics | None, list[str]]:
    matrices = {tuple(numbers(path, "cam_K", own.get("cam_K"), 9).tolist()) for own in images}
    if len(matrices) > 1:
        return None, [f"{path}: cam_K differs from image to image (cropped images): not used"]
    K = numbers(path, "cam_K", next(iter(matrices)), 9).reshape(3, 3)
    return lens_of_matrix(path, "cam_K", size, K), []
