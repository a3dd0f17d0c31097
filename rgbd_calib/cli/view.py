"""`rgbd-calib view`: a rig and its clouds in an interactive viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rgbd_calib.cli.options import OUTPUT, overwrite_option, progress, refuse_existing, say
from rgbd_calib.errors import ConfigError


@click.command
@click.argument("rig", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path), required=False)
@click.option("--frame", help="Only this instant of the recording.  [default: all]")
@click.option(
    "--color", type=click.Choice(["image", "camera"]), default="camera", show_default=True, help="Of the clouds."
)
@click.option("--stride", type=click.IntRange(1), default=2, show_default=True, help="Show every n-th point.")
@click.option("--save", type=OUTPUT, help="Write a .rrd file instead of opening the viewer.")
@click.option("--serve", is_flag=True, help="Serve the viewer to a browser on this computer instead, until Ctrl-C.")
@overwrite_option
def command(
    rig: Path,
    recording: Path | None,
    frame: str | None,
    color: str,
    stride: int,
    save: Path | None,
    serve: bool,
    overwrite: bool,
) -> None:
    """Show a rig and its clouds in the viewer Rerun.

    Cameras with their frusta and, with a recording, images and clouds over time, prepared in memory. Without --save the
    command runs until the viewer is closed. Needs `pip install rgbd-calib[view]`.

    \b
    Examples:
      rgbd-calib view demo/rig.yaml demo/extrinsic
      rgbd-calib view demo/rig.yaml demo/extrinsic --frame 000003 --save demo/rig.rrd
      rgbd-calib view demo/rig.yaml demo/extrinsic --serve          # on a machine without a display
    """
    if save is not None and serve:
        raise ConfigError("view: --save and --serve seen; one of them is needed. Leave one out")
    if frame is not None and recording is None:
        raise ConfigError("view: --frame seen without a recording. Name the recording too")
    if save is not None:
        refuse_existing(save, overwrite)

    from rgbd_calib.io.files import whole_file
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.pipeline.rig_inputs import check_frame, common_cameras, left_out
    from rgbd_calib.report import viewer

    read = read_rig(rig)
    opened = None
    if recording is not None:
        opened = open_recording(recording)
        common_cameras(opened, read)
        if frame is not None:
            check_frame(opened, frame)
        if left_out(opened, read):
            say(left_out(opened, read))
    stream = viewer.rerun().RecordingStream("rgbd-calib")
    encoded = stream.binary_stream()  # in memory: rerun's own writer may wait for ever where the disk is full
    viewer.log_rig(stream, read)
    if opened is not None:
        frames = opened.frames if frame is None else (frame,)
        for name in progress(frames, len(frames), "Fusing"):
            _log_frame(stream, read, opened, name, color, stride)
    stream.flush()
    data = encoded.read()
    if save is not None:
        with whole_file(save) as temporary:
            temporary.write_bytes(data)
        say(f"{len(read.cameras)} cameras -> {save}. Open it with: rerun {save}")
    elif serve:
        viewer.serve(data, say)
    else:
        viewer.show(data)


def _log_frame(stream: Any, rig: Any, recording: Any, frame: str, color: str, stride: int) -> None:
    import numpy as np

    from rgbd_calib.pipeline.fuse import clouds_of
    from rgbd_calib.report import splat, viewer

    cameras = [name for name in recording.cameras if name in rig.cameras]
    clouds = {}
    if any(recording.has_depth(name, frame) for name in cameras):
        number = {name: i for i, name in enumerate(rig.cameras)}
        for cloud in clouds_of(recording, rig, frame):
            points_m = cloud.points_m[::stride]
            own = np.full((len(points_m), 3), splat.camera_color(number[cloud.camera]), np.uint8)
            clouds[cloud.camera] = points_m, own if color == "camera" else cloud.colors[::stride]
    images = {name: recording.color_files[name][frame] for name in cameras if frame in recording.color_files[name]}
    viewer.log_frame(stream, recording.frames.index(frame), clouds, images)
