"""A recording that is another one with other names and stamps: its images are links, not copies."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from rgbd_calib.io.dataset import write_dataset
from rgbd_calib.io.files import whole_folder
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.tables import write_table

COLUMNS = ("frame", "color_us", "depth_us", "apart_us", "source")
"""`apart_us`: instant of the colour image less that of its set; `source`: the frame in the original."""


def write_linked(
    path: Path,
    recording: Recording,
    sets: Sequence[tuple[float, Mapping[str, tuple[str, float, float]]]],
    overwrite: bool,
) -> None:
    """Write sets of frames as a synchronous recording.

    Parameters
    ----------
    sets : instant (s), and by camera the frame and the instants of its colour and depth (s).
    """
    with whole_folder(path, overwrite) as folder:
        rows: dict[str, list[tuple[object, ...]]] = {c: [] for c in recording.cameras}
        for k, (t_s, frames) in enumerate(sets):
            stem = f"{k:06d}"
            for camera, (frame, color_s, depth_s) in frames.items():
                for kind, files in (
                    ("color", recording.color_files),
                    ("depth", recording.depth_files),
                    ("ir", recording.ir_files),
                ):
                    if frame in files[camera]:
                        source = files[camera][frame]
                        _link(source, folder / camera / kind / f"{stem}{source.suffix}")
                stamps = (f"{1e6 * color_s:.1f}", f"{1e6 * depth_s:.1f}", f"{1e6 * (color_s - t_s):.1f}")
                rows[camera].append((stem, *stamps, frame))
        for camera, own in rows.items():
            write_table(folder / camera / "timestamps.csv", COLUMNS, own)
        write_dataset(folder, recording.cameras, recording.board, recording.extra)


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:  # another file system
        shutil.copyfile(source, target)
