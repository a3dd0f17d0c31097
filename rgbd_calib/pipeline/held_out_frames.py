"""Frames that a rig was calibrated from prove nothing of it: they are found by the contents of their images."""

from __future__ import annotations

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import Recording
from rgbd_calib.types import Rig


def frames_of_calibration(rig: Rig, recording: Recording) -> tuple[str, ...]:
    """Frames of a recording of which the rig was calibrated from at least one colour image, whatever their names.

    A rig file without the hashes of its images is compared by the hash of its whole recording.
    """
    stated = rig.provenance.get("images_sha256")
    if not isinstance(stated, dict):
        same = rig.provenance.get("recording_sha256") == recording.digest()
        return recording.frames if same else ()
    known = {digest for own in stated.values() if isinstance(own, dict) for digest in own.values()}
    own = recording.image_digests()
    return tuple(f for f in recording.frames if any(own[camera].get(f) in known for camera in own))


def refuse_nothing_new(rig: Rig, recording: Recording, used: tuple[str, ...]) -> None:
    """Raise ConfigError where all frames of a recording were used to calibrate the rig."""
    if used and len(used) == len(recording.frames):
        raise ConfigError(
            f"{recording.path}: all {len(used)} frames were used to calibrate this rig; new frames are needed to verify it. "
            "Record the board again, five frames for each pair of cameras, or calibrate without a part of the recording"
        )
