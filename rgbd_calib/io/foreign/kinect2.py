"""Kinect v2: folders of iai_kinect2's calibration tool, and raw dumps of libfreenect2 frames.

iai_kinect2 writes NNNN_sync_color.png, _sync_ir.png, _sync_grey_ir.png and _sync_depth.png for pairs, and NNNN_color.png or
NNNN_ir.png, _depth.png for one camera alone, each with its own numbers; depth in millimetres. libfreenect2's frames are
512x424 floats (depth in millimetres, infrared) and 1920x1080 or 512x424 pixels of 4 bytes (B G R X), as `fwrite` or
`numpy.save` leave them; they are mirrored, and stay as they are.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.calibrations import FoundCamera, read_calibration
from rgbd_calib.io.foreign.pictures import read_picture
from rgbd_calib.io.foreign.source import Encoded, Kind, Source, SourceCamera, SourceImage, Stems, Wanted
from rgbd_calib.io.images import read_image
from rgbd_calib.io.layout import others
from rgbd_calib.io.reading import read_bytes

DEPTH_SCALE = 0.001
_IAI = re.compile(r"(\d+)(_sync)?_(color|ir|depth|grey_ir)\.(png|jpg)", re.IGNORECASE)
_DUMP = re.compile(r"(.*?)(rgb|color|ir|infrared|depth|registered)(.*)\.(bin|raw|npy)", re.IGNORECASE)
_DUMP_KINDS: dict[str, Kind] = {"rgb": "color", "color": "color", "ir": "ir", "infrared": "ir", "depth": "depth"}
_COLOR, _DEPTH = (1080, 1920), (424, 512)
_COLOR_BYTES, _DEPTH_BYTES = 1080 * 1920 * 4, 424 * 512 * 4
IR_FULL_SCALE = 65535.0
"""Of libfreenect2's infrared values."""


def is_iai(path: Path) -> bool:
    return path.is_dir() and any(_IAI.fullmatch(p.name) and "_depth" in p.name.lower() for p in path.iterdir())


def is_dump(path: Path) -> bool:
    return path.is_dir() and any(_is_depth_dump(p) for p in path.iterdir())


def _is_depth_dump(path: Path) -> bool:
    match = _DUMP.fullmatch(path.name)
    if match is None or match[2].lower() != "depth" or not path.is_file():
        return False
    size = path.stat().st_size
    return size == _DEPTH_BYTES if match[4].lower() != "npy" else _DEPTH_BYTES < size < _DEPTH_BYTES + 4096


class IaiFolder(Source):
    """One Kinect v2."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._camera = camera
        self._files: dict[Kind, dict[str, Path]] = {"color": {}, "depth": {}, "ir": {}}
        grey, files = 0, sorted(path.iterdir())
        has_sync = any("_sync_" in file.name for file in files)
        for file in files:
            match = _IAI.fullmatch(file.name)
            if match is None:
                continue
            if match[3].lower() == "grey_ir":
                grey += 1
                continue
            kind: Kind = match[3].lower()  # type: ignore[assignment]
            # one camera's own pictures have numbers of their own: they are no instant of the other
            prefix = "" if match[2] or not has_sync else "color_" if kind == "color" else "ir_"
            self._files[kind][prefix + match[1]] = file
        if not self._files["color"]:
            raise ConfigError(f"{path}: no colour images in it; a calibration needs colour. Record both")
        found = _calibration(path)
        depth = found.depth
        self.cameras = {
            camera: SourceCamera(
                found.intrinsics,
                None,
                DEPTH_SCALE,
                False,
                None if depth is None else depth.intrinsics,
                None if depth is None else depth.T_color_depth,
            )
        }
        remarks = (
            [f"{path}: {grey} grey_ir images are not used: they are drawn from the infrared images"] if grey else []
        )
        if found.intrinsics is None:
            remarks.append(f"{path}: no calib_color.yaml in it: its lenses are not known")
        known = {file.name for file in files if _IAI.fullmatch(file.name)}
        if left := others(path, known):
            remarks.append(left)
        self.remarks = tuple(remarks)

    def stems(self) -> Mapping[str, Stems]:
        return {self._camera: {kind: list(files) for kind, files in self._files.items() if files}}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        for kind, files in self._files.items():
            for index, path in enumerate(files.values()):
                if wanted(self._camera, kind, index):
                    yield SourceImage(self._camera, kind, index, read_picture(path, kind))


class FreenectDump(Source):
    """One Kinect v2, frames as libfreenect2 has them in memory."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._camera = camera
        found: dict[Kind, dict[str, Path]] = defaultdict(dict)
        left = 0
        for file in sorted(path.iterdir()):
            match = _DUMP.fullmatch(file.name)
            kind = None if match is None else _DUMP_KINDS.get(match[2].lower())
            if match is not None and kind is not None:
                stem = "".join(re.findall(r"\d+", match[1] + match[3])) or (match[1] + match[3]).strip("_-. ") or "0"
                found[kind][stem] = file
            elif match is not None:
                left += 1
        if not found["color"]:  # people save colour with imwrite
            for file in sorted(path.iterdir()):
                digits = "".join(re.findall(r"\d+", file.stem))
                if file.suffix.lower() in (".png", ".jpg") and re.search("rgb|color", file.stem, re.IGNORECASE):
                    found["color"].setdefault(digits or file.stem, file)
        self._files = {kind: files for kind, files in found.items() if files}
        if not found["color"]:
            raise ConfigError(f"{path}: no colour frames in it; a calibration needs colour. Save them too")
        self.cameras = {camera: SourceCamera(None, None, DEPTH_SCALE, False)}
        remarks = [f"{path}: libfreenect2 mirrors its images: they are turned back"]
        if left:
            remarks.append(f"{path}: {left} registered frames are not used: they are drawn from colour and depth")
        known = {p.name for own in found.values() for p in own.values()}
        known |= {p.name for p in path.iterdir() if _DUMP.fullmatch(p.name)}
        if rest := others(path, known):
            remarks.append(rest)
        self.remarks = tuple(remarks)

    def stems(self) -> Mapping[str, Stems]:
        return {self._camera: {kind: list(files) for kind, files in self._files.items()}}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        for kind, files in self._files.items():
            for index, path in enumerate(files.values()):
                if wanted(self._camera, kind, index):
                    yield SourceImage(self._camera, kind, index, _dump(path, kind))


def _calibration(path: Path) -> FoundCamera:
    for folder in (path, path.parent):
        if (folder / "calib_color.yaml").is_file():
            return next(iter(read_calibration(folder).cameras.values()))
    return FoundCamera()


def _dump(path: Path, kind: Kind) -> np.ndarray | Encoded:
    """A frame, turned back from the mirror."""
    suffix = path.suffix.lower()
    if suffix in (".png", ".jpg"):
        return read_picture(path, kind)
    array = read_image(path) if suffix == ".npy" else _raw(path, kind)
    if kind == "color":
        if array.ndim != 3 or array.dtype != np.uint8:
            raise ConfigError(f"{path}: {array.dtype} {array.shape} seen, 1080x1920 pixels of 4 bytes needed")
        return np.ascontiguousarray(array[:, ::-1, :3])
    if array.shape != _DEPTH or array.dtype.kind != "f":
        raise ConfigError(f"{path}: {array.dtype} {array.shape} seen, 424x512 floats needed")
    values = np.nan_to_num(array, nan=0.0, posinf=0.0, neginf=0.0)
    return np.ascontiguousarray(np.rint(np.clip(values, 0, IR_FULL_SCALE)).astype(np.uint16)[:, ::-1])


def _raw(path: Path, kind: Kind) -> np.ndarray:
    needed = _COLOR_BYTES if kind == "color" else _DEPTH_BYTES
    data = read_bytes(path, _COLOR_BYTES)
    if len(data) != needed:
        raise ConfigError(f"{path}: {len(data)} bytes seen, {needed} needed for {kind}. Is it complete?")
    if kind == "color":
        return np.frombuffer(data, np.uint8).reshape(*_COLOR, 4)
    return np.frombuffer(data, "<f4").reshape(_DEPTH)
