"""Sessions of caliscope: calibration/extrinsic/cam_N.mp4 (or port_N.mp4) and the times of their frames; colour alone.

timestamps.csv has `cam_id,frame_time`, frame_time_history.csv of older releases `port,frame_time` among others: a row for each
frame, in seconds of one clock. charuco.toml is the board, camera_array.toml the lenses.
https://github.com/mprib/caliscope
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.calibrations import read_calibration
from rgbd_calib.io.calibrations.common import load_document
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Wanted
from rgbd_calib.io.foreign.videos import Video
from rgbd_calib.io.layout import others
from rgbd_calib.io.schema_parts import BoardModel
from rgbd_calib.io.tables import number, read_table, whole_number
from rgbd_calib.types import Board

_TIMES = {"timestamps.csv": "cam_id", "frame_time_history.csv": "port"}
"""The column of the camera's number, by file."""


def is_caliscope(path: Path) -> bool:
    return _folder(path) is not None


class CaliscopeSession(Source):
    """The cameras of a session, cam_N, on one clock."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        folder = _folder(path)
        if folder is None:
            raise ConfigError(f"{path}: no times of frames in it; {', '.join(_TIMES)} needed beside the videos")
        self._times = _read_times(folder)
        self._videos: dict[str, Video] = {}
        remarks: list[str] = []
        taken: set[str] = set()
        for number_of in sorted(self._times):
            names = [f"{word}_{number_of}.mp4" for word in ("cam", "port")]
            file = next((folder / name for name in names if (folder / name).is_file()), None)
            if file is None:
                remarks.append(f"{folder}: camera {number_of} has times and no video: not used")
                continue
            video, n = Video(file), len(self._times[number_of])
            if video.frames != n:
                raise ConfigError(f"{file}: {video.frames} frames seen, {n} times. Record the session again")
            self._videos[f"cam_{number_of}"] = video
            taken.add(file.relative_to(path).as_posix())
        root = next((p for p in (path, *folder.parents[:2]) if (p / "camera_array.toml").is_file()), path)
        array = root / "camera_array.toml"
        lenses = read_calibration(array).cameras if array.is_file() else {}
        self.cameras = {c: SourceCamera(lenses[c].intrinsics if c in lenses else None) for c in self._videos}
        self.board = _read_board(root / "charuco.toml", remarks)
        if left := others(path, taken):
            remarks.append(left)
        self.remarks = tuple(remarks)

    def stamps(self) -> Mapping[str, Stamps]:
        return {c: {"color": self._times[int(c.rpartition("_")[2])]} for c in self.cameras}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        kind: Kind = "color"
        for camera, video in self._videos.items():
            for index, pixels in enumerate(video.images()):
                if wanted(camera, kind, index):
                    yield SourceImage(camera, kind, index, pixels())


def _folder(path: Path) -> Path | None:
    """The folder of the videos that several cameras took together."""
    for folder in (path, path / "calibration" / "extrinsic", path / "extrinsic"):
        if any((folder / name).is_file() for name in _TIMES) and any(folder.glob("*_*.mp4")):
            return folder
    return None


def _read_times(folder: Path) -> dict[int, list[int]]:
    """Times of the frames of each camera, us, in order."""
    name = next(name for name in _TIMES if (folder / name).is_file())
    column, times = _TIMES[name], defaultdict(list)
    for line, row in read_table(folder / name, (column, "frame_time")):
        camera = whole_number(folder / name, line, column, row[column])
        times[camera].append(round(1e6 * number(folder / name, line, "frame_time", row["frame_time"])))
    return {camera: sorted(own) for camera, own in times.items()}


def _read_board(path: Path, remarks: list[str]) -> Board | None:
    """The ChArUco board of charuco.toml, where the side of its squares is stated."""
    if not path.is_file():
        return None
    try:
        own: Any = load_document(path).tree
        side_cm = own.get("square_size_override_cm")
        if side_cm is None:
            remarks.append(f"{path}: the board's squares are not measured in it (square_size_override_cm): not used")
            return None
        if own.get("inverted"):
            remarks.append(f"{path}: the print is inverted; the board is not used")
            return None
        return BoardModel(
            type="charuco",
            cols=own["columns"] - 1,
            rows=own["rows"] - 1,
            square=side_cm / 100,
            marker=side_cm / 100 * own["aruco_scale"],
            dictionary=own["dictionary"],
            legacy=own.get("legacy_pattern") or None,
        ).value()
    except (ValueError, TypeError, LookupError) as error:
        raise ConfigError(f"{path}: cannot be read as a ChArUco board ({' '.join(str(error).split())[:200]})") from None
