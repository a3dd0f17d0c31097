"""A recording and a rig that are to be used together: which cameras both have, and whether they fit."""

from __future__ import annotations

from dataclasses import replace
from difflib import get_close_matches

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.tables import short
from rgbd_calib.pipeline.detection import board_of
from rgbd_calib.types import Board, Rig, RigCamera


def common_cameras(recording: Recording, rig: Rig) -> tuple[str, ...]:
    """Cameras that the recording and the rig share, in the recording's order.

    Raises
    ------
    ConfigError
        None is shared, or a camera's images have another size than its intrinsics are for.
    """
    shared = tuple(name for name in recording.cameras if name in rig.cameras)
    if not shared:
        raise ConfigError(
            f"{recording.path}: cameras {', '.join(recording.cameras)} seen, the rig has {', '.join(rig.cameras)}; "
            "at least one in common is needed. Is it the rig of this recording?"
        )
    for name in shared:
        info, lens = recording.cameras[name], rig.cameras[name].intrinsics
        if (info.width, info.height) != (lens.width, lens.height):
            raise ConfigError(
                f"{recording.path}: camera {name}: images of {info.width}x{info.height} px, the rig's intrinsics are "
                f"for {lens.width}x{lens.height}; the same size is needed. Calibrate at the size that you record"
            )
    if recording.extra.get("corrected"):
        _refuse_second_correction(recording, rig, shared)
    return shared


def check_depth_geometry(recording: Recording, name: str, camera: RigCamera) -> None:
    """Refuse depth images of another geometry than the rig's depth camera has.

    Raises
    ------
    ConfigError
        Depth that is not registered, and a rig of registered depth; or the reverse; or another size.
    """
    info, sensor = recording.cameras[name], camera.depth_sensor.camera.intrinsics
    registered = info.depth is None
    if info.depth_size != (sensor.width, sensor.height) or (not registered and camera.depth_camera is None):
        seen = "registered to colour" if registered else "not registered to colour"
        raise ConfigError(
            f"{recording.path}: camera {name}: depth of {info.depth_size[0]}x{info.depth_size[1]} px, {seen}; the rig's depth is "
            f"of {sensor.width}x{sensor.height} px. The geometry that it was calibrated with is needed: calibrate with depth as "
            "it is recorded here"
        )


def board_for(recording: Recording, rig: Rig) -> Board:
    """The recording's board, with the shape that the rig found of the same board.

    Raises
    ------
    ConfigError
        The recording has no board, or the rig's is none.
    """
    board = board_of(recording)
    known = rig.quality.board
    if fault := rig.quality.faults.get("board"):
        raise ConfigError(
            f"{recording.path}: the rig's quality.board describes no board ({short(fault)}). Take it out, or calibrate again"
        )
    same = known is not None and replace(known, shape=None) == board
    return known if known is not None and same else board


def left_out(recording: Recording, rig: Rig) -> str:
    """Sentence that names the cameras which only the recording or only the rig has; empty where there are none."""
    parts = []
    for names, others, where in (
        (recording.cameras, rig.cameras, "not in the rig"),
        (rig.cameras, recording.cameras, "not in the recording"),
    ):
        mounted = [name for name, info in recording.cameras.items() if info.mount is not None]
        missing = [name for name in names if name not in others and name not in mounted]
        if missing:
            parts.append(f"{', '.join(missing)} {where}")
    return f"Left out: {'; '.join(parts)}" if parts else ""


def _refuse_second_correction(recording: Recording, rig: Rig, shared: tuple[str, ...]) -> None:
    """Raise ConfigError where the rig would remove what `correct` removed from this recording already."""
    corrected = recording.extra["corrected"]
    undistorted = isinstance(corrected, dict) and corrected.get("undistorted")
    for name in shared:
        camera = rig.cameras[name]
        errors: list[object] = [camera.depth_bias, camera.depth_field]
        if not (isinstance(corrected, dict) and corrected.get("geometry") == "depth"):
            errors.append(camera.depth_camera)
        again = ["a depth bias"] if any(error is not None for error in errors) else []
        again += ["distortion"] if undistorted and any(camera.intrinsics.distortion) else []
        if again:
            raise ConfigError(
                f"{recording.path}: camera {name}: the rig has {' and '.join(again)}, which `rgbd-calib correct` has "
                f"removed from this recording already. Use the rig written with it, {recording.path / 'rig.yaml'}"
            )


def check_frame(recording: Recording, frame: str) -> None:
    """Raise ConfigError, with the nearest name, unless a camera of the recording has the frame."""
    if frame not in recording.frames:
        near = get_close_matches(frame, recording.frames, 1, 0.0)
        raise ConfigError(
            f"{recording.path}: frame '{frame}' is not there; {len(recording.frames)} frames from "
            f"{recording.frames[0]} to {recording.frames[-1]}. Did you mean '{near[0]}'?"
        )
