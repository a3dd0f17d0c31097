"""Whether a recording's colour planes lie on each other, by the views in which the board was found."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import Recording
from rgbd_calib.trust.self_check import Finding
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.color_planes import PlaneShift, corners_apart, plane_shifts, sentence

VIEWS = 6
"""Images of each camera that are looked at, spread over its views: all say the same."""
ADVICE = (
    "The corners lie between the planes: calibrate with images whose planes are registered (the camera's raw images, or "
    "another debayering), or with another lens"
)


def shifts_of(recording: Recording, board: Board, views: Sequence[BoardView]) -> dict[str, tuple[PlaneShift, ...]]:
    """Shifts of red and blue against green by camera; cameras with grey images or too few views are left out."""
    out = {}
    for camera, info in recording.cameras.items():
        mine = [v for v in views if v.camera == camera and v.frame in recording.color_files[camera]]
        if not mine:
            continue
        some = [mine[i] for i in sorted({round(x) for x in np.linspace(0, len(mine) - 1, VIEWS)})]
        apart = []
        for view in some:
            try:
                image = recording.color(camera, view.frame)
            except (ConfigError, cv2.error):  # what cannot be read is reported by whoever needs it
                image = np.zeros((info.height, info.width, 3), np.uint8)
            apart.append(corners_apart(image, view, board))
        corners_px = np.concatenate([v.corners_px for v in some])
        shifts = plane_shifts(corners_px, np.concatenate(apart), (info.width, info.height))
        if shifts:
            out[camera] = shifts
    return out


def color_plane_findings(recording: Recording, board: Board, views: Sequence[BoardView]) -> list[Finding]:
    """A finding for each camera whose planes are apart."""
    shifts = shifts_of(recording, board, views)
    texts = {camera: sentence(camera, own) for camera, own in shifts.items()}
    return [Finding("colour planes", "caution", (c,), text, ADVICE) for c, text in texts.items() if text]
