"""A recording of a carried board by free-running cameras: from stamped views to a problem that can be solved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.planes_of_depth import with_depth_cameras
from rgbd_calib.rig.motion.estimate import StampedView
from rgbd_calib.rig.motion.setup import ClockPrior
from rgbd_calib.rig.motion.start import Track, first_offsets
from rgbd_calib.types import Board, BoardView, Clock, DepthBias, PlacedView, PosedView
from rgbd_calib.views.association import AssociationResult, associate, label_views
from rgbd_calib.views.board_pose import pose_view

WRAP_S = 2.0**32 * 1e-6
"""Counters of 32 bits of microseconds begin anew after 72 minutes."""
NEAR_WRAP_S = 60.0
LONGEST_PAUSE_S = 60.0
"""A longer step between two frames is a jump of the clock, not dropped frames."""
MAX_TURN_RAD, MAX_SHIFT_M, SOON_S = 0.6, 0.25, 0.4
"""How far a carried board gets from one view to the next, within this time."""


@dataclass(frozen=True)
class CarriedStart:
    """Where the estimate of a carried board starts."""

    views: tuple[StampedView, ...]
    clocks: dict[str, ClockPrior]
    first_s: dict[str, float]
    T_world_color: dict[str, FloatArray]
    association: AssociationResult
    """Of these views."""
    left_out: dict[tuple[str, str], str]
    """Why, by (camera, frame)."""
    remarks: tuple[str, ...]


def stamps_s(recording: Recording, camera: str) -> tuple[dict[str, tuple[float, float]], str]:
    """Stamps (colour, depth) of a camera's frames in their order, s, on a clock without steps; and what was mended, or nothing.

    Raises
    ------
    ConfigError
        No stamps, a frame without one, or a clock that jumps.
    """
    mount, path = recording.cameras[camera].mount, recording.folder(camera) / "timestamps.csv"
    frames = list(recording.color_files[camera] or recording.depth_files[camera])
    known = recording.timestamps_us(camera)
    if mount is not None:  # all its images are of depth's instant
        known = {f: (d if np.isfinite(d) else c,) * 2 for f, (c, d) in known.items()}
    missing = [f for f in frames if f not in known or not np.isfinite(known[f][0])]
    if missing:
        raise ConfigError(
            f"{path}: a {'depth' if mount else 'colour'} timestamp of each of {len(frames)} frames expected, none of "
            f"{len(missing)} found ({missing[0]}, ...). Frames of cameras that run free say nothing without: record with "
            "timestamps, or take the frames out"
        )
    table = 1e-6 * np.array([known[f] for f in frames])
    color, depth, remark = table[:, 0].copy(), table[:, 1].copy(), ""
    for k in (np.flatnonzero(np.diff(color) < 0) + 1).tolist():
        step = color[k] - color[k - 1]
        if abs(step + WRAP_S) > NEAR_WRAP_S:
            raise ConfigError(
                f"{path}: frame {frames[k]}: a timestamp after that of frame {frames[k - 1]} expected, {-step:.3f} s before it "
                "found: the clock was set, or the frames are out of order. Record again, or cut the recording there"
            )
        color[k:] += WRAP_S
        depth[k:] += WRAP_S
        remark = f"{camera}: 32-bit timestamps wrap around at frame {frames[k]}; continued"
    pauses = np.flatnonzero(np.diff(color) > LONGEST_PAUSE_S)
    if len(pauses):
        k = pauses[0].item()
        raise ConfigError(
            f"{path}: frame {frames[k + 1]}: at most {LONGEST_PAUSE_S:g} s after frame {frames[k]} expected, "
            f"{color[k + 1] - color[k]:.1f} s found: the clock jumped. Cut the recording there"
        )
    return dict(zip(frames, zip(color.tolist(), depth.tolist(), strict=True), strict=True)), remark


def start_of(
    recording: Recording,
    views: Sequence[BoardView],
    board: Board,
    lenses: Mapping[str, Intrinsics],
    biases: Mapping[str, DepthBias],
    reference: str,
    config: Config,
    T_world_color: Mapping[str, FloatArray] | None = None,
) -> CarriedStart:
    """First offsets, faces and poses; with camera poses from a rig file, where `T_world_color` is given.

    Raises
    ------
    ConfigError, CalibrationError
        See :func:`stamps_s`, :func:`rgbd_calib.rig.motion.start.first_offsets` and
        :func:`rgbd_calib.views.association.associate`.
    """
    cameras = [c for c in recording.cameras if T_world_color is None or c in T_world_color]
    stamps, remarks = {}, []
    for c in cameras:
        stamps[c], remark = stamps_s(recording, c)
        remarks += [remark] if remark else []
    mine = [v for v in views if v.camera in cameras]
    seeing = [c for c in cameras if recording.color_files[c]]
    blind = [c for c in seeing if not any(v.camera == c for v in mine)]
    if blind:
        raise CalibrationError(
            f"{', '.join(blind)}: the board was found in no image. Carry it where this camera sees it"
        )
    posed = [pose_view(v, board, lenses[v.camera], biases.get(v.camera), config.board_pose) for v in mine]
    moves = [
        board.T_face_board(back, turned) for back in _either(board.two_sided) for turned in _either(board.symmetric)
    ]
    beside = {c: mount.camera for c in cameras if (mount := recording.cameras[c].mount) is not None}
    tracks = {c: _track(posed, c, stamps[c]) for c in cameras if c not in beside}
    offsets = first_offsets(tracks, reference, moves)
    offsets |= {c: offsets[color] for c, color in beside.items()}
    times = np.array([stamps[p.view.camera][p.view.frame][0] + offsets[p.view.camera] for p in posed])
    slots = _slots(posed, times)
    if T_world_color is None:
        association = associate(slots, board, reference, seeing, config.association)
    else:
        poses = {c: np.asarray(T_world_color[c]) for c in cameras}
        placed, dropped = label_views(slots, board, poses, config.association)
        association = AssociationResult(placed, poses, dropped, (), reference)
    read, left_out = _read_alike(posed, times, association, slots, board, moves)
    association = with_depth_cameras(replace(association, views=tuple(read)), recording, lenses, biases, board, config)
    stamped = tuple(StampedView(p, *stamps[p.view.camera][p.view.frame]) for p in association.views)
    first = {c: next(iter(stamps[beside.get(c, c)].values()))[0] for c in cameras}
    clocks = {c: ClockPrior(Clock(offsets[c]), beside=beside.get(c, "")) for c in cameras}
    return CarriedStart(stamped, clocks, first, association.T_world_color, association, left_out, tuple(remarks))


def _either(there: bool) -> tuple[bool, ...]:
    return (False, True) if there else (False,)


def _track(posed: Sequence[PosedView], camera: str, stamps: Mapping[str, tuple[float, float]]) -> Track:
    own = [p for p in posed if p.view.camera == camera]
    t = np.array([stamps[p.view.frame][0] for p in own])
    order = np.argsort(t, kind="stable")
    return Track(t[order], np.stack([own[k].T_color_face[:3, :3] for k in order]))


def _slots(posed: Sequence[PosedView], times: FloatArray) -> list[PosedView]:
    """The same views with the time slot of a frame's period for a name: what is nearly one instant has one name."""
    steps = [np.diff(np.sort(times[[p.view.camera == c for p in posed]])) for c in {p.view.camera for p in posed}]
    period = float(np.median(np.concatenate(steps))) if any(len(s) for s in steps) else 1.0
    number = np.floor((times - times.min()) / max(period, 1e-3)).astype(int)
    return [replace(p, view=replace(p.view, frame=f"{k:08d}")) for p, k in zip(posed, number, strict=True)]


def _read_alike(
    posed: Sequence[PosedView],
    times: FloatArray,
    association: AssociationResult,
    slots: Sequence[PosedView],
    board: Board,
    moves: Sequence[FloatArray],
) -> tuple[list[PlacedView], dict[tuple[str, str], str]]:
    """All views with their face read as that of the view before: the board turns on its way, and does not leap.

    The order of time is followed from the slot that most cameras agree on, forth and back.
    """
    readings = [(back, turned) for back in _either(board.two_sided) for turned in _either(board.symmetric)]
    agreed: dict[str, int] = {}
    for p in association.views:
        agreed[p.view.frame] = agreed.get(p.view.frame, 0) + 1
    best = max(agreed, key=lambda frame: agreed[frame])
    anchor = next(p for p in association.views if p.view.frame == best)
    first = next(i for i, s in enumerate(slots) if (s.view.camera, s.view.frame) == (anchor.view.camera, best))
    order = np.argsort(times, kind="stable")
    at = int(np.flatnonzero(order == first)[0])
    placed: dict[int, PlacedView] = {}
    left_out: dict[tuple[str, str], str] = {}
    for way in (order[at:], order[:at][::-1]):
        last = association.T_world_color[anchor.view.camera] @ anchor.T_color_board
        last_s = times[first]
        for i in way:
            p = posed[i]
            T = association.T_world_color[p.view.camera] @ p.T_color_face @ np.stack(moves)
            angles = so3.angle_rad(last[:3, :3].T @ T[:, :3, :3])
            k = int(np.argmin(angles))
            shift = float(np.linalg.norm(T[k, :3, 3] - last[:3, 3]))
            if abs(times[i] - last_s) < SOON_S and (angles[k] > MAX_TURN_RAD or shift > MAX_SHIFT_M):
                left_out[p.view.camera, p.view.frame] = "the board leaps from where other views have it"
                continue
            placed[int(i)] = PlacedView(p.view, *readings[k], p.T_color_face @ moves[k])
            last, last_s = T[k], times[i]
    return [placed[i] for i in sorted(placed)], left_out
