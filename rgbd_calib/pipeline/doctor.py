"""What is wrong with a recording, before any calibration: every image looked at once, then the recording as a whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.cameras.intrinsics import calibrate_intrinsics
from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.correspondences import read_corners
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.rig import read_intrinsics
from rgbd_calib.pipeline.color_planes import color_plane_findings
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Progress, board_of, check_detector, check_seen, silent
from rgbd_calib.pipeline.detection_cache import Contents, DetectionCache, contents, detector
from rgbd_calib.pipeline.verify import fit_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.trust.displacement import LocatedCameras, joined_to, locate_cameras
from rgbd_calib.types import Board, BoardView, PosedView, Rig, RigCamera
from rgbd_calib.views import doctor
from rgbd_calib.views.association import AssociationResult, associate
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.coverage import CoverageParams, measure_coverage, nominal_intrinsics
from rgbd_calib.views.detect import DetectParams, detect_view
from rgbd_calib.views.doctor import DoctorParams, ImageMeasures, RecordingFinding, ViewMeasures

Key = tuple[str, str]
MIN_DISTANCES, MIN_RANGE = 5, 2.0
"""Walls of a depth-bias recording: how many, and farthest over nearest."""
MIN_OWN_VIEWS = 8
"""Views of a camera from which its lens is estimated; with fewer it is taken as an Xtion's."""
_MIN_COS, _MIN_SQUARE_PX, _MARGIN_SQUARES = 0.45, 9.0, 1.6
"""A board turned or far beyond these, or nearer to the image's rim, need not be found."""


@dataclass(frozen=True)
class Examination:
    """Findings, those that matter first, and what was looked at."""

    findings: tuple[RecordingFinding, ...]
    images: int
    views: int

    @property
    def healthy(self) -> bool:
        """Nothing that matters was found."""
        return not any(f.matters for f in self.findings)


@dataclass(frozen=True)
class _Task:
    """An image to look at."""

    recording: Recording
    """Of this image alone."""
    board: Board | None
    known: tuple[BoardView | None] | None
    """(the view, or None where the board is not in it,), where it was found before."""
    params: DetectParams
    key: Key
    hashed: bool

    def __str__(self) -> str:
        return f"{self.recording.path}: camera {self.key[0]}, frame {self.key[1]}"


@dataclass(frozen=True)
class _Look:
    """One image."""

    key: Key
    problems: tuple[str, ...]
    image: ImageMeasures | None
    view: BoardView | None
    measures: ViewMeasures | None
    contents: Contents | None = None
    detector: str | None = None


@one_blas_thread
def examine(
    recording: Recording,
    config: Config,
    *,
    intrinsics: Path | None = None,
    corners: Path | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
    params: DoctorParams | None = None,
) -> Examination:
    """Look at every image and judge the recording.

    Parameters
    ----------
    intrinsics : a file, so that lenses need not be guessed from the recording; regions and tilts are then not judged.
    corners : corners found before.

    Raises
    ------
    ConfigError
        No board in dataset.yaml, and no wall distances either.
    """
    params = params or DoctorParams()
    walls = recording.board is None and any(recording.distances_m(c) for c in recording.cameras)
    board = None if walls else board_of(recording)
    known = None if corners is None else {(v.camera, v.frame): v for v in read_corners(corners)}
    looks = _look_at_all(recording, board, known, config, workers or Workers(), progress)
    color = {c: tuple(files) for c, files in recording.color_files.items()}
    depth = {c: tuple(files) for c, files in recording.depth_files.items()}
    stamps = {c: rows for c in recording.cameras if (rows := recording.timestamps_us(c))}
    findings = [
        *_damaged(looks),
        *_check_files(recording),
        *doctor.check_frames(color, depth, params),
        *([] if walls else doctor.check_stems(color, stamps)),
        *([] if walls else doctor.check_timestamps(stamps, params)),
    ]
    if board is None:
        findings += _check_walls(recording)
    else:
        given = {} if intrinsics is None else read_intrinsics(intrinsics)
        findings += _check_board(recording, board, looks, given, config, params)
    findings.sort(key=lambda f: not f.matters)
    return Examination(tuple(findings), len(looks), sum(look.view is not None for look in looks))


def _look_at_all(
    recording: Recording,
    board: Board | None,
    known: Mapping[Key, BoardView] | None,
    config: Config,
    workers: Workers,
    progress: Progress,
) -> list[_Look]:
    keys = [(camera, frame) for camera, files in recording.color_files.items() for frame in files]
    sent = recording if workers.dask is None else replace(recording, path=recording.path.absolute())
    cached = board is not None and known is None and workers.cache is not None
    with closing(
        DetectionCache(recording, board, config.detect, workers if cached else replace(workers, cache=None))
    ) as cache:

        def work() -> Iterator[_Task]:
            for key in keys:
                view = cache.look(*key) if known is None else (known.get(key),)
                yield _Task(sent.only(*key), board, view, config.detect, key, cached and view is None)

        looks: list[_Look] = []
        for look in progress(workers.in_order(_look, work()), len(keys), "Looking at the images"):
            check_detector(look.detector, workers)
            cache.keep(look.key[0], look.key[1], look.view, look.contents, look.detector)
            looks.append(look)
    return looks


def _look(task: _Task) -> _Look:
    recording, board, key, problems = task.recording, task.board, task.key, []
    color, depth_m = None, None
    check_seen(recording, *key)
    try:
        color = recording.color(*key)
    except ConfigError as error:
        problems.append(str(error))
    try:
        registered = recording.cameras[key[0]].depth is None
        depth_m = recording.depth_m(*key) if registered and recording.has_depth(*key) else None
    except ConfigError as error:
        problems.append(str(error))
    if color is None:
        return _Look(key, tuple(problems), None, None, None)
    gray = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    image = doctor.measure_image(gray)
    if board is None:
        return _Look(key, tuple(problems), image, None, None)
    view = detect_view(*key, color, depth_m, board, task.params) if task.known is None else task.known[0]
    measures = None if view is None else doctor.measure_view(gray, depth_m, view, board)
    hashes = contents(recording, *key) if task.hashed and not problems else None
    return _Look(key, tuple(problems), image, view, measures, hashes, detector())


def _check_files(recording: Recording) -> list[RecordingFinding]:
    """Files that nobody reads, and depth that is not registered to colour."""
    findings = [RecordingFinding("not read", (), (), False, remark) for remark in recording.remarks]
    own = tuple(c for c, info in recording.cameras.items() if info.depth is not None)
    if own:
        text = (
            f"{', '.join(own)}: depth is not registered to colour; its images are not looked at here. `rgbd-calib calibrate` finds "
            "its geometry"
        )
        findings.append(RecordingFinding("not registered", own, (), False, text))
    return findings


def _damaged(looks: Iterable[_Look]) -> list[RecordingFinding]:
    return [
        RecordingFinding("damaged", (look.key[0],), (look.key[1],), True, problem)
        for look in looks
        for problem in look.problems
    ]


def _check_walls(recording: Recording) -> list[RecordingFinding]:
    findings = []
    for camera in recording.cameras:
        distances = [distance_m for distance_m, _ in recording.distances_m(camera).values()]
        if recording.depth_files[camera] and (
            len(distances) < MIN_DISTANCES or max(distances) < MIN_RANGE * min(distances)
        ):
            span = f" from {min(distances):.2f} to {max(distances):.2f} m" if distances else ""
            text = (
                f"{camera}: {len(distances)} wall distances{span}; {MIN_DISTANCES} over a range of 1 to {MIN_RANGE:g} are needed. "
                "Film the wall nearer and farther"
            )
            findings.append(RecordingFinding("coverage", (camera,), (), True, text))
    return findings


def _check_board(
    recording: Recording,
    board: Board,
    looks: Sequence[_Look],
    given: Mapping[str, Intrinsics],
    config: Config,
    params: DoctorParams,
) -> list[RecordingFinding]:
    images = {look.key: look.image for look in looks if look.image is not None}
    measures = {look.key: look.measures for look in looks if look.measures is not None}
    views = [look.view for look in looks if look.view is not None]
    lenses = _lenses(recording, board, views, given, config)
    posed = [pose_view(v, board, lenses[v.camera], None, config.board_pose) for v in views]
    alone = len({frame for _, frame in images}) == len(images) and len(recording.cameras) > 1
    findings = doctor.check_exposure(images, measures, params)
    for own in color_plane_findings(recording, board, views):
        findings.append(RecordingFinding("colour planes", own.cameras, (), True, f"{own.text}. {own.advice}"))
    shift_m: dict[Key, float] = {}
    distance_m: dict[Key, float] = {}
    unfit: dict[Key, str] = {}
    missed: dict[Key, tuple[float, bool]] = {}
    for group in [] if alone else _groups(list(recording.cameras), views):
        try:
            mine = [p for p in posed if p.view.camera in group]
            found = associate(mine, board, group[0], group, config.association)
        except CalibrationError as error:
            findings.append(RecordingFinding("not joined", tuple(group), (), True, str(error)))
            continue
        poses = _poses(found, lenses, board)
        # a frame that one camera sees says where the others should see the board, too
        single = {p.view.frame: poses.T_world_color[p.view.camera] @ p.T_color_board for p in found.views}
        poses = replace(poses, T_world_board=single | poses.T_world_board)
        shift_m |= poses.shift_m
        distance_m |= {
            (p.view.camera, p.view.frame): float(np.linalg.norm(p.T_color_board[:3, 3])) for p in found.views
        }
        unfit |= found.dropped
        missed |= _expected(recording, poses, lenses, board, set(images) - set(measures))
    findings += doctor.check_consistency(shift_m, distance_m, unfit, list(measures), params)
    findings += doctor.check_sharpness(measures, missed, params)
    offsets = {k: o for k, o in _depth_offsets(posed, board).items() if k not in unfit}
    stated = {*given, *(c for c, info in recording.cameras.items() if info.intrinsics is not None)}
    enough = {c for c in recording.cameras if sum(v.camera == c for v in views) >= MIN_OWN_VIEWS}
    findings += doctor.check_depth_unit(offsets, stated | enough)
    findings += doctor.check_depth(measures, offsets, params)
    if not alone:
        findings += doctor.check_empty(set(images), set(measures))
    return findings + _check_coverage(recording, board, views, lenses, given, alone)


def _lenses(
    recording: Recording, board: Board, views: Sequence[BoardView], given: Mapping[str, Intrinsics], config: Config
) -> dict[str, Intrinsics]:
    """Given, of dataset.yaml, by the camera's own views, or an Xtion's."""
    lenses = {}
    for camera, info in recording.cameras.items():
        size, mine = (info.width, info.height), [v for v in views if v.camera == camera]
        lenses[camera] = given.get(camera) or info.intrinsics or nominal_intrinsics(size)
        if camera not in given and info.intrinsics is None and len(mine) >= MIN_OWN_VIEWS:
            try:
                lenses[camera] = calibrate_intrinsics(mine, board, size, config.intrinsics).intrinsics
            except CalibrationError:
                continue  # the views do not tell, which coverage will say
    return lenses


def _groups(cameras: Sequence[str], views: Sequence[BoardView]) -> list[list[str]]:
    """Cameras that common views join, in groups of two at least."""
    seen, groups, left = [(v.camera, v.frame) for v in views], [], list(cameras)
    while left:
        joined = joined_to(left[0], seen)
        group = [c for c in left if c in joined]
        left = [c for c in left if c not in joined]
        if len(group) > 1:
            groups.append(group)
    return groups


def _poses(found: AssociationResult, lenses: Mapping[str, Intrinsics], board: Board) -> LocatedCameras:
    """Cameras and boards by all views together, lenses as they are."""
    nothing = np.zeros((6, 6))
    cameras = {c: RigCamera(lenses[c], T, nothing) for c, T in found.T_world_color.items()}
    # depth may be off by its bias: the pixels alone are compared
    bare = [replace(p, view=replace(p.view, depth_m=np.full(len(p.view.ids), np.nan))) for p in found.views]
    return locate_cameras(fit_views(Rig(found.reference, cameras), bare, board), found.T_world_color, found.reference)


def _expected(
    recording: Recording,
    poses: LocatedCameras,
    lenses: Mapping[str, Intrinsics],
    board: Board,
    without: set[Key],
) -> dict[Key, tuple[float, bool]]:
    """Texture where the board must be, of images in which it was not found, and whether it should have been."""
    out = {}
    low, high = -_MARGIN_SQUARES, np.array([board.cols, board.rows]) - 1 + _MARGIN_SQUARES
    rim = np.array([[low, low, 0], [high[0], low, 0], [high[0], high[1], 0], [low, high[1], 0]]) * board.square_m
    for camera, frame in sorted(without):
        if camera not in poses.T_world_color or frame not in poses.T_world_board:
            continue
        own = lenses[camera]
        T_color_board = se3.inverse(poses.T_world_color[camera]) @ poses.T_world_board[frame]
        p = se3.transform(T_color_board, rim)
        middle = p.mean(axis=0)
        facing = float(T_color_board[:3, 2] @ middle / np.linalg.norm(middle))  # positive: the front is seen
        if p[:, 2].min() < 0.2 or (facing < 0 and not board.two_sided):
            continue
        size = np.array([own.width, own.height])
        px, corners = (own.project(x) for x in (p, se3.transform(T_color_board, board.corners_m())))
        side = min(float(np.linalg.norm(corners[k] - corners[0])) for k in (1, board.cols))
        if side < _MIN_SQUARE_PX or np.any(corners < 0) or np.any(corners > size - 1):
            continue
        gray = cv2.cvtColor(recording.color(camera, frame), cv2.COLOR_BGR2GRAY)
        texture = doctor.texture_of(gray, doctor.hull_mask(gray.shape[:2], corners), side)
        out[camera, frame] = (texture, bool(np.all((px > 0) & (px < size - 1)) and abs(facing) > _MIN_COS))
    return out


def _depth_offsets(posed: Sequence[PosedView], board: Board) -> dict[Key, tuple[float, float]]:
    """The board's distance by pixels, metres, and depth over it, less one, by view."""
    out = {}
    for p in posed:
        z_m: FloatArray = se3.transform(p.T_color_face, board.corners_m()[p.view.ids])[:, 2]
        measured = np.isfinite(p.view.depth_m)
        if measured.sum() >= len(measured) // 2:
            ratio = float(np.median(p.view.depth_m[measured] / z_m[measured]))
            out[p.view.camera, p.view.frame] = (float(np.median(z_m[measured])), ratio - 1)
    return out


def _check_coverage(
    recording: Recording,
    board: Board,
    views: Sequence[BoardView],
    lenses: Mapping[str, Intrinsics],
    given: Mapping[str, Intrinsics],
    alone: bool,
) -> list[RecordingFinding]:
    """Pairs that share no view matter; where the board has not been is advice, but for a recording of each camera alone."""
    sizes = {c: (info.width, info.height) for c, info in recording.cameras.items()}
    known = set(given) | {c for c, info in recording.cameras.items() if info.intrinsics is not None}
    findings = []
    together = CoverageParams(judge_cameras=False, judge_pairs=not alone)
    for text in measure_coverage(views, board, sizes, lenses, together).missing:
        findings.append(RecordingFinding("not joined", (), (), True, text))
    for camera in recording.cameras:
        mine = [v for v in views if v.camera == camera]
        if camera in known or not mine:
            continue
        only = CoverageParams(judge_pairs=False)
        for text in measure_coverage(mine, board, {camera: sizes[camera]}, lenses, only).missing:
            findings.append(RecordingFinding("coverage", (camera,), (), alone, text))
    return findings
