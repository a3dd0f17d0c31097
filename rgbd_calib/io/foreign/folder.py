"""Folders of image files: Redwood, ScanNet-like, 3DMatch-like and 7-Scenes folders, those of Open3D's recorders, and any
whose names tell cameras and frames; PNG, JPEG, TIFF, NPY, and, as an import only, NPZ of one image and OpenEXR.

Lenses are those of calibration files in the folder. Nothing says the unit of 16-bit depth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations import FoundCamera, read_calibration
from rgbd_calib.io.folder_guess import Guess, guess_layout, names_coincide
from rgbd_calib.io.foreign.pictures import SUFFIXES, read_picture, sniff_picture
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Stems, Wanted
from rgbd_calib.io.frame_names import spelled_anew, times_us
from rgbd_calib.io.images import DEPTH_SUFFIXES as DEPTH_IMAGES
from rgbd_calib.io.images import SUFFIXES as IMAGES
from rgbd_calib.io.layout import others, walk

_CALIBRATIONS = (".yaml", ".yml", ".json", ".xml", ".toml", ".cameramodel", ".txt")
_MAX_CALIBRATION_FILES = 50


class PictureFolder(Source):
    """The cameras of a folder; equal numbers or names of files are one instant.

    Parameters
    ----------
    camera
        The name of an only camera.
    patterns
        Where the files of a kind are, where their names do not tell.
    color_only
        Pictures of depth do not matter.
    """

    def __init__(
        self, path: Path, camera: str, patterns: Mapping[Kind, str] | None = None, color_only: bool = False
    ) -> None:
        self.name = str(path)
        self._path = path
        self._guess: Guess = guess_layout(path, patterns, SUFFIXES, sniff_picture, color_only)
        own = self._guess.cameras
        self._names = {own[0]: camera} if len(own) == 1 else {name: name for name in own}
        remarks = list(self._guess.remarks)
        files = list(walk(path))
        self._calibrations = [f for f in files if Path(f).suffix.lower() in _CALIBRATIONS][:_MAX_CALIBRATION_FILES]
        self.cameras = {self._names[name]: self._camera(name, remarks) for name in own}
        taken = {
            file for of_kind in self._guess.streams.values() for own in of_kind.values() for file in own.files.values()
        }
        if not patterns:  # the guess names the images that it leaves
            taken |= {file for file in files if Path(file).suffix.lower() in (*IMAGES, *DEPTH_IMAGES, *SUFFIXES)}
        left = others(path, taken)
        self._times = self._times_of_names()
        self.by_time = bool(self._times) and not names_coincide(self._guess)
        if self.by_time:
            remarks.append("names of files are times, which differ from stream to stream: frames are joined by them")
        self.remarks = (*(f"{path}: {remark}" for remark in remarks), *([left] if left else []))

    def stems(self) -> Mapping[str, Stems]:
        """Numbers are padded to one length where streams spell them in several ways: 1 and 0001."""
        streams = self._guess.streams
        every = [list(own.files) for of_kind in streams.values() for own in of_kind.values()]
        names = [name for own in every for name in own]
        unclear = not spelled_anew(names) or any(map(spelled_anew, every))
        width = 0 if unclear else max(map(len, names))
        return {
            name: {
                kind: [frame.zfill(width) for frame in of_kind[own].files]
                for kind, of_kind in streams.items()
                if own in of_kind
            }
            for own, name in self._names.items()
        }

    def stamps(self) -> Mapping[str, Stamps]:
        """Where the names of all files are times."""
        return self._times

    def _times_of_names(self) -> dict[str, Stamps]:
        out: dict[str, Stamps] = {}
        for camera, streams in self.stems().items():
            times = {kind: times_us(names) for kind, names in streams.items()}
            known = {kind: own for kind, own in times.items() if own is not None}
            if len(known) < len(times):
                return {}
            out[camera] = known
        return out

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        for kind, of_kind in self._guess.streams.items():
            for own, stream in of_kind.items():
                for index, file in enumerate(stream.files.values()):
                    if wanted(self._names[own], kind, index):
                        yield SourceImage(self._names[own], kind, index, read_picture(self._path / file, kind))

    def _camera(self, name: str, remarks: list[str]) -> SourceCamera:
        color = self._guess.streams["color"][name].sniffed
        stream = self._guess.streams["depth"].get(name)
        size = (color.width, color.height)
        found = self._calibrated(name, size, ("color", "rgb"), remarks)
        if stream is None:
            return SourceCamera(found.intrinsics)
        registered = True if any(word in stream.words for word in ("aligned", "registered")) else None
        depth_size = (stream.sniffed.width, stream.sniffed.height)
        depth: Intrinsics | None = None
        T = None
        if found.depth is not None and (found.depth.intrinsics.width, found.depth.intrinsics.height) == depth_size:
            depth, T = found.depth.intrinsics, found.depth.T_color_depth
        elif depth_size != size:
            depth = self._calibrated(name, depth_size, ("depth",), remarks).intrinsics
        if stream.sniffed.pixels == "float":
            remarks.append(f"{name}: floating-point depth: its unit is told by its values")
        return SourceCamera(found.intrinsics, None, None, registered, depth, T)

    def _calibrated(self, name: str, size: tuple[int, int], words: tuple[str, ...], remarks: list[str]) -> FoundCamera:
        """What a calibration file says of a camera: by the camera's name, by the word, or the only one."""
        for relative in self._calibrations:
            path = self._path / relative
            try:
                cameras = read_calibration(path, size).cameras
            except ConfigError:
                continue
            for own, camera in cameras.items():
                lens = camera.intrinsics
                named = own.casefold() == name.casefold() or any(word in path.stem.lower() for word in words)
                other = any(word in path.stem.lower() for word in ("color", "rgb", "depth") if word not in words)
                if (
                    lens is not None
                    and (lens.width, lens.height) == size
                    and (named or (len(cameras) == 1 and not other))
                ):
                    remarks.append(f"{name}: lens of {relative}")
                    return camera
        return FoundCamera()
