"""How good a rig is: against the truth of a simulation, or against a recording that it was not made from.

Alignment is what users see: the distance between the places where two cameras put the same point, each by its own
pixel and its own depth, through its own intrinsics, depth bias and pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig, read_rig_and_boards
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import predicted_views, split, split_rig
from rgbd_calib.pipeline.detection import Progress, detections_from
from rgbd_calib.pipeline.rig_inputs import board_for, common_cameras
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import AlignmentNumbers, MeasuredAlignment, PoseNumbers
from rgbd_calib.trust import uncertainty
from rgbd_calib.types import Board, BoardView, PlacedView, Rig
from rgbd_calib.views.association import label_views
from rgbd_calib.views.board_pose import pose_view, repose
from rgbd_calib.views.corner_points import corner_points
from rgbd_calib.views.plane_filter import filter_planes

GRID = 12
"""Points along each side of the working volume."""
BIN_M = 0.5
"""Width of the bins of distance in a summary."""
_NONE = np.empty(0)
NEAR_M, FAR_M = 1.0, 3.0
"""Depths of the working volume where no board says where it is."""


@dataclass(frozen=True)
class PairAlignment:
    """Distances between where two cameras put the same points, metres."""

    cameras: tuple[str, str]
    distance_m: FloatArray
    """(n,)."""
    depth_m: FloatArray
    """(n,), mean depth of the point in the two cameras."""
    transfer_px: FloatArray
    """(n,), against a recording: error of the board posed by one camera and projected into the other; else empty."""
    transfer_m: FloatArray = field(default_factory=lambda: np.empty(0))
    """(n,), the same at the board, across the line of sight."""
    expected_m: FloatArray = field(default_factory=lambda: np.empty(0))
    """(n,), of `distance_m` by the rig's own covariance; NaN where it states none, or the two do not both see the point. Empty
    against a recording."""


@dataclass(frozen=True)
class PoseError:
    """The paper's measures, section 6.1."""

    rotation_rad: float
    translation_m: float
    relative_translation: float


@dataclass(frozen=True)
class Evaluation:
    pairs: tuple[PairAlignment, ...]
    poses: dict[str, PoseError]
    """By camera, against the truth; empty against a recording."""

    @property
    def distance_m(self) -> FloatArray:
        """Distances of all pairs together, metres."""
        return np.concatenate([pair.distance_m for pair in self.pairs])

    def summary(self) -> MeasuredAlignment:
        """Numbers for people and files."""
        expected, depth, *transfer = (
            np.concatenate([getattr(p, key) for p in self.pairs])
            for key in ("expected_m", "depth_m", "transfer_px", "transfer_m")
        )
        bins = np.floor(depth / BIN_M)
        by_distance = {
            f"{b * BIN_M:.1f}-{(b + 1) * BIN_M:.1f} m": _numbers(
                self.distance_m[bins == b], expected[bins == b] if len(expected) else expected
            )
            for b in np.unique(bins)
        }
        poses = {
            name: PoseNumbers(float(np.degrees(e.rotation_rad)), 1e3 * e.translation_m, e.relative_translation)
            for name, e in self.poses.items()
        }
        return MeasuredAlignment(
            _numbers(self.distance_m, expected, *transfer),
            {
                " - ".join(p.cameras): _numbers(p.distance_m, p.expected_m, p.transfer_px, p.transfer_m)
                for p in self.pairs
            },
            by_distance,
            poses or None,
        )


def against_truth(rig: Rig, truth: Rig, boards: Mapping[str, FloatArray], board: Board | None) -> Evaluation:
    """Errors of the poses, and alignment over the working volume.

    Parameters
    ----------
    boards : T_world_board (4, 4) by frame; the working volume is the box that their corners fill, else what two
        cameras see between `NEAR_M` and `FAR_M`.

    Raises
    ------
    ConfigError
        The rig has a camera that the truth has not.
    CalibrationError
        No point of the volume is seen by two cameras, or the rig's joint covariance is damaged.
    """
    missing = [name for name in rig.cameras if name not in truth.cameras]
    if missing:
        raise ConfigError(
            f"the truth has no camera {', '.join(missing)}; seen: {', '.join(truth.cameras)}. Is it of this rig?"
        )
    T_truth_world = truth.cameras[rig.reference].T_world_color @ se3.inverse(rig.cameras[rig.reference].T_world_color)
    poses = {
        name: _pose_error(T_truth_world @ rig.cameras[name].T_world_color, truth, name, rig.reference)
        for name in rig.cameras
        if name != rig.reference
    }
    points = _volume(truth, boards, board)
    in_truth = {name: uncertainty.observe(truth, name, points) for name in rig.cameras}
    expected = _expected(rig, se3.transform(se3.inverse(T_truth_world), points))
    pairs = []
    for a, b in combinations(rig.cameras, 2):
        seen = in_truth[a].seen & in_truth[b].seen
        if seen.any():
            places = [uncertainty.place(rig, name, in_truth[name].only(seen)) for name in (a, b)]
            distance = np.linalg.norm(places[0] - places[1], axis=1)
            depth = (in_truth[a].z_m + in_truth[b].z_m)[seen] / 2
            stated = expected[a, b][seen] if (a, b) in expected else np.full(len(distance), np.nan)
            pairs.append(PairAlignment((a, b), distance, depth, _NONE, expected_m=stated))
    if not pairs:
        raise CalibrationError("no point of the working volume is seen by two cameras of the rig; nothing to compare")
    return Evaluation(tuple(pairs), poses)


def _expected(rig: Rig, points_m: FloatArray) -> dict[tuple[str, str], FloatArray]:
    """Expected distances (n,) of each pair at points (n, 3) in the rig's world; NaN where the two do not both see the point."""
    joint = uncertainty.joint_of(rig)
    if joint is None or joint.parameters.keys() != rig.cameras.keys():  # depth is of cameras of its own
        return {}
    found = uncertainty.expected_alignment(rig, joint, points_m, list(rig.cameras))
    if found is None:
        return {}
    out = {pair: np.full(len(points_m), np.nan) for pair in found.pairs}
    for pair, error_m in found.pairs.items():
        out[pair][found.seen] = error_m
    return out


def against_views(rig: Rig, placed: Sequence[PlacedView], board: Board) -> Evaluation:
    """Alignment of corners that two cameras saw, by the depth that they measured, and the transfer error in px.

    Raises
    ------
    CalibrationError
        There are none.
    """
    found = common_corners(rig, placed, board)
    if found is None:
        raise CalibrationError(
            "no frame shows the board to two cameras of the rig; nothing to compare. Film the board between two cameras"
        )
    return found


def common_corners(rig: Rig, placed: Sequence[PlacedView], board: Board) -> Evaluation | None:
    """As :func:`against_views`; None where no two cameras measured, or found, the same corner."""
    by_frame: dict[str, list[PlacedView]] = {}
    for view in placed:
        by_frame.setdefault(view.view.frame, []).append(view)
    found: dict[tuple[str, str], list[tuple[FloatArray, ...]]] = {}
    for frame in sorted(by_frame):
        views = sorted(by_frame[frame], key=lambda view: view.view.camera)
        on_front = {view.view.camera: _on_front(rig, view, board) for view in views}
        for a, b in combinations(views, 2):
            row = _compare(rig, a, b, board, on_front)
            found.setdefault((a.view.camera, b.view.camera), []).append(row)
    pairs = [
        PairAlignment(key, *(np.concatenate([row[k] for row in rows]) for k in range(4))) for key, rows in found.items()
    ]
    pairs = [pair for pair in pairs if len(pair.distance_m) or len(pair.transfer_px)]
    return Evaluation(tuple(pairs), {}) if pairs else None


@one_blas_thread
def evaluate_truth(rig: Path, truth: Path) -> MeasuredAlignment:
    """Summary of a rig file against a simulation's truth.yaml; the board is that of the recording beside it, of still frames or
    of a carried board."""
    beside = [path for name in ("extrinsic", "wave") if (path := truth.parent / name).is_dir()]
    board = open_recording(beside[0]).board if beside else None
    return against_truth(read_rig(rig), *read_rig_and_boards(truth), board).summary()


@one_blas_thread
def evaluate_recording(
    rig_path: Path, path: Path, corners: Path | None, config: Config, workers: Workers | None, progress: Progress
) -> MeasuredAlignment:
    """Summary of a rig file against a recording of the board."""
    recording = split(open_recording(path))
    rig = split_rig(read_rig(rig_path), recording)
    board, shared = board_for(recording, rig), common_cameras(recording, rig)
    found = detections_from(recording, corners, config.detect, workers, progress)
    placed = place_views(rig, found.views, board, shared, config)
    lenses = {name: rig.cameras[name].intrinsics for name in shared}
    poses = {name: rig.cameras[name].T_world_color for name in shared}
    read = predicted_views(placed, recording, lenses, poses, board)
    return against_views(rig, (*placed, *read), board).summary()


def place_views(
    rig: Rig, views: Sequence[BoardView], board: Board, cameras: Sequence[str], config: Config
) -> tuple[PlacedView, ...]:
    """Views of these cameras, posed by the rig's intrinsics; face and half turn as they agree best with the rig's poses."""
    lenses = {name: rig.cameras[name].intrinsics for name in cameras}
    biases = {name: bias for name in cameras if (bias := rig.cameras[name].depth_bias) is not None}
    mine = [view for view in views if view.camera in lenses]
    filtered = filter_planes(mine, lenses, biases, config.plane_filter, config.seed)
    posed = [pose_view(v, board, lenses[v.camera], biases.get(v.camera), config.board_pose) for v in filtered.views]
    T_world_color = {name: rig.cameras[name].T_world_color for name in cameras}
    placed = label_views(posed, board, T_world_color, config.association)[0]
    return tuple(repose(p, board, lenses[p.view.camera]) for p in placed)


def _numbers(
    distance_m: FloatArray, expected_m: FloatArray, transfer_px: FloatArray = _NONE, transfer_m: FloatArray = _NONE
) -> AlignmentNumbers:
    out = AlignmentNumbers(len(distance_m))
    if len(distance_m):
        mm = 1e3 * distance_m
        mean, median, p95 = float(mm.mean()), float(np.median(mm)), float(np.percentile(mm, 95))
        out = replace(out, mean_mm=mean, median_mm=median, p95_mm=p95)
    if np.isfinite(expected_m).any():
        out = replace(out, expected_mm=1e3 * float(np.nanmean(expected_m)))
    if len(transfer_px):
        out = replace(out, median_px=float(np.median(transfer_px)), mean_px=float(transfer_px.mean()))
    if len(transfer_m):
        out = replace(out, median_board_mm=1e3 * float(np.median(transfer_m)))
    return out


def _pose_error(T_world_color: FloatArray, truth: Rig, name: str, reference: str) -> PoseError:
    T_true = truth.cameras[name].T_world_color
    baseline = float(np.linalg.norm(T_true[:3, 3] - truth.cameras[reference].T_world_color[:3, 3]))
    shift = float(np.linalg.norm(T_world_color[:3, 3] - T_true[:3, 3]))
    angle = float(so3.angle_rad(T_world_color[:3, :3].T @ T_true[:3, :3]))
    return PoseError(angle, shift, shift / baseline if baseline > 0 else float("nan"))


def _volume(truth: Rig, boards: Mapping[str, FloatArray], board: Board | None) -> FloatArray:
    if boards and board is not None:
        corners = np.concatenate([se3.transform(T, board.corners_m()) for T in boards.values()])
    else:
        corners = volume_corners(truth)
    return uncertainty.volume(corners, GRID)


def volume_corners(rig: Rig) -> FloatArray:
    """Points (n, 3), metres, in the world, about the working volume: that of the calibration, else what the cameras see."""
    expected = rig.quality.expected_alignment
    if expected is not None and expected.grid is not None:
        return se3.transform(rig.cameras[rig.reference].T_world_color, expected.grid.points_in_reference_m)
    return np.concatenate([_frustum(rig, name) for name in rig.cameras])


def _frustum(truth: Rig, name: str) -> FloatArray:
    own = truth.cameras[name]
    pixels = np.array([(u, v) for u in (0, own.intrinsics.width - 1) for v in (0, own.intrinsics.height - 1)], float)
    rays = own.intrinsics.rays(pixels)
    return se3.transform(own.T_world_color, np.concatenate([rays * NEAR_M, rays * FAR_M]))


def _on_front(rig: Rig, placed: PlacedView, board: Board) -> FloatArray:
    """Where a view puts its corners (n, 3), metres, in the world, carried through the board to its front."""
    own = rig.cameras[placed.view.camera]
    p = corner_points(placed.view, placed.T_color_board, own.intrinsics, own.depth_sensor)
    to_front = (board.corners_m()[placed.front_corner(board)] - placed.points_m(board)) @ placed.T_color_board[:3, :3].T
    return se3.transform(own.T_world_color, p + to_front)


def _compare(
    rig: Rig, a: PlacedView, b: PlacedView, board: Board, on_front: Mapping[str, FloatArray]
) -> tuple[FloatArray, ...]:
    """Distances, depths and transfer errors in px and at the board of the corners that both saw (of the same physical corner)."""
    _, ia, ib = np.intersect1d(a.front_corner(board), b.front_corner(board), return_indices=True)
    distance = np.linalg.norm(on_front[a.view.camera][ia] - on_front[b.view.camera][ib], axis=1)
    depth = (a.view.depth_m[ia] + b.view.depth_m[ib]) / 2
    finite = np.isfinite(distance)
    transfer = np.concatenate([_transfer(rig, a, b, board), _transfer(rig, b, a, board)])
    return distance[finite], depth[finite], *transfer.T


def _transfer(rig: Rig, source: PlacedView, target: PlacedView, board: Board) -> FloatArray:
    """Board posed by the pixels of `source`, projected into `target`: errors (n, 2) of its corners, where they were seen: px, and
    metres across the line of sight at the board."""
    if source.view.predicted or target.view.predicted:
        return np.empty((0, 2))
    T_world_board = rig.cameras[source.view.camera].T_world_color @ source.T_color_board
    T_color_board = se3.inverse(rig.cameras[target.view.camera].T_world_color) @ T_world_board
    lens = rig.cameras[target.view.camera].intrinsics
    p_color = se3.transform(T_color_board, target.points_m(board))
    off_px = lens.project(p_color) - target.view.corners_px
    off_m = off_px / [lens.fx, lens.fy] * p_color[:, 2:]
    return np.column_stack([np.linalg.norm(off_px, axis=1), np.linalg.norm(off_m, axis=1)])
