"""Which reader takes which foreign file or folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.folder_guess import ARCHIVES
from rgbd_calib.io.foreign.azure import AzureMkv, is_azure
from rgbd_calib.io.foreign.bag import is_bag, open_bag
from rgbd_calib.io.foreign.bop import BopScene, is_bop
from rgbd_calib.io.foreign.caliscope import CaliscopeSession, is_caliscope
from rgbd_calib.io.foreign.folder import PictureFolder
from rgbd_calib.io.foreign.kinect2 import FreenectDump, IaiFolder, is_dump, is_iai
from rgbd_calib.io.foreign.orbbec import OrbbecBag
from rgbd_calib.io.foreign.orbbec_bag import is_orbbec
from rgbd_calib.io.foreign.own import OwnRecording, is_own
from rgbd_calib.io.foreign.realsense import RealSenseBag, is_realsense
from rgbd_calib.io.foreign.ros import RosBag
from rgbd_calib.io.foreign.ros_topics import CameraTopics
from rgbd_calib.io.foreign.source import Kind, Source
from rgbd_calib.io.foreign.tum import TumFolder, is_tum
from rgbd_calib.io.foreign.videos import Videos, has_videos
from rgbd_calib.sensors.oni_file import OniFile


@dataclass(frozen=True)
class OpenOptions:
    """What a reader may need besides the file."""

    topics: Mapping[str, CameraTopics] = field(default_factory=dict)
    """Of a bag, by camera; empty: found by name and type."""
    patterns: Mapping[Kind, str] = field(default_factory=dict)
    """Of a folder of images, by kind; empty: found by name and content."""
    redist: Path | None = None
    """Folder of the OpenNI2 runtime."""
    color_only: bool = False


def open_source(path: Path, camera: str, options: OpenOptions) -> Source:
    """The reader of a file or folder; `camera` names its camera, where it has only one and does not name it.

    Raises
    ------
    ConfigError
        No reader knows it, or it is damaged.
    """
    if path.is_dir() and options.patterns:
        return PictureFolder(path, camera, options.patterns, options.color_only)
    if path.suffix.lower() == ".oni":
        return OniFile(path, camera, options.redist)
    if is_azure(path):
        return AzureMkv(path, camera)
    if is_bag(path):
        return _open_bag(path, camera, options)
    if path.is_dir():
        return _open_folder(path, camera, options.color_only)
    if has_videos(path):
        return Videos(path, camera)
    if path.suffix.lower() in ARCHIVES:
        raise ConfigError(
            f"{path}: a folder or a recording expected, an archive seen. Unpack it, and give the folder that comes out of it"
        )
    raise ConfigError(
        f"{path}: not a recording that can be imported; a folder, .bag, .mcap, .db3, .mkv, .oni or a video needed"
    )


def _open_bag(path: Path, camera: str, options: OpenOptions) -> Source:
    with open_bag(path) as bag:
        types = dict(bag.types)
    if options.topics:
        return RosBag(path, options.topics)
    if is_realsense(types):
        return RealSenseBag(path, camera)
    if is_orbbec(types):
        return OrbbecBag(path, camera)
    return RosBag(path)


def _open_folder(path: Path, camera: str, color_only: bool) -> Source:
    if is_own(path):
        return OwnRecording(path)
    if is_tum(path):
        return TumFolder(path, camera)
    if is_bop(path):
        return BopScene(path, camera)
    if is_iai(path):
        return IaiFolder(path, camera)
    if is_dump(path):
        return FreenectDump(path, camera)
    if is_caliscope(path):
        return CaliscopeSession(path)
    if has_videos(path):
        return Videos(path, camera)
    return PictureFolder(path, camera, color_only=color_only)
