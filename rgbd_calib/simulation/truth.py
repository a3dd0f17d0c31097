"""truth.yaml: the ground truth of a simulation as a rig file; what has no key there is in `quality`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.rig import write_rig
from rgbd_calib.quality import Quality
from rgbd_calib.simulation.printed import Printed
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.wall import TapedWall
from rgbd_calib.types import Clock, Rig


def write_truth(
    path: Path,
    rig: TrueRig,
    board: Printed | None,
    walls: Mapping[str, Mapping[str, TapedWall]],
    warm: Mapping[str, float],
    T_room_board: Mapping[str, FloatArray],
    provenance: Mapping[str, Any],
    clocks: Mapping[str, Clock],
) -> None:
    """Write the rig, T_world_board (4, 4) by frame, and in `quality` the board shape, walls and depth drift (metres along the
    ray) by camera and frame, and the clocks of free-running cameras.

    `warm` is the elapsed share of the session by frame.
    """
    taped_walls = any(taped.sd_m for own in walls.values() for taped in own.values())
    drift = {c: {f: rig.drift_m(c, share) for f, share in warm.items()} for c in rig.cold_m}
    quality = Quality(
        board_shape=None if board is None else board.board.shape,
        walls={c: {f: taped.truth for f, taped in own.items()} for c, own in walls.items()} if taped_walls else None,
        depth_drift=drift or None,
    )
    cameras = {c: replace(own, clock=clocks.get(c)) for c, own in rig.rig_cameras.items()}
    truth = Rig(rig.cameras[0], cameras, quality, dict(provenance))
    write_rig(path, truth, {f: rig.T_world_room @ T for f, T in T_room_board.items()})
