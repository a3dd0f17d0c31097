"""A rig and what is known of it, gathered into one page; the clouds before and after are made here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from jinja2 import TemplateError

from rgbd_calib.errors import ConfigError, RgbdCalibError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import write_text
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.io.residuals import Residuals, read_residuals_of, residuals_path
from rgbd_calib.io.rig import read_boards, read_depth_bias_samples, read_rig
from rgbd_calib.io.tables import short
from rgbd_calib.io.text import valid
from rgbd_calib.pipeline import fuse
from rgbd_calib.pipeline.depth_cameras import name_of
from rgbd_calib.pipeline.rig_inputs import common_cameras
from rgbd_calib.pipeline.view_pictures import view_pictures
from rgbd_calib.report import compare_page, numbers, splat
from rgbd_calib.report.compare import Comparison, compare
from rgbd_calib.report.page import CloudComparison, Contents, render
from rgbd_calib.report.scene import MovedCloud
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Board, DepthCamera, Rig, RigCamera

VIEWS = {"oblique": "from the side", "top": "from above"}
EDGE_ON = "the board alone, edge on"
SIZE = (800, 600)
"""Width and height of a picture, px."""
_MARGIN = 0.15  # of the box that several cameras see
_BEYOND = 1.15  # how much farther than the farthest board a cloud is shown: beyond it nothing was calibrated
_SLAB_M = 0.08  # half the thickness of what is shown of a board edge on
_BAR_M = 0.02
POINTS = 16_000
"""Of all clouds together in the 3D view."""


def report_of_file(path: Path, recording: Path | None, depth_bias: Path | None, folder: Path) -> Path:
    """Report of a rig file, with the residuals beside it and the recording that it names, where they are there.

    Raises
    ------
    ConfigError
        The rig, or a file that was asked for, cannot be read.
    """
    rig, missing = read_rig(path), {}
    if depth_bias is not None:
        rig = replace(rig, quality=replace(rig.quality, depth_bias_samples=read_depth_bias_samples(depth_bias)))
    left, beside = read_residuals_of(path, rig), residuals_path(path)
    if left is None and beside.exists():
        missing["residuals"] = (
            f"Coverage and residuals are not shown: {path.name} was updated after {beside.name} was made."
        )
    elif left is None:
        missing["residuals"] = (
            f"Coverage and residuals are not shown: {beside.name} is not beside {path.name}. `rgbd-calib calibrate` writes "
            "it with the rig; keep the two together, or calibrate again."
        )
    named = Path(str(rig.provenance.get("recording", "")))
    if recording is not None:
        opened: Recording | None = open_recording(recording)
    elif rig.provenance.get("recording") and (named / "dataset.yaml").exists():
        opened = open_recording(named)
    else:
        opened = None
        where = f"the recording {named or ''} is not there. Say where it is: `rgbd-calib report {path} --recording DIR -o {folder}`."
        missing |= {"clouds": f"The clouds are not shown: {where}", "images": f"The images are not shown: {where}"}
    boards = read_boards(path)
    with schemaless(path):
        return write_report(folder, path.name, rig, boards, left, opened, missing)


def comparison_of_files(path: Path, other: Path, folder: Path) -> tuple[Path, Comparison]:
    """Page of two rig files side by side, the second against the first.

    Raises
    ------
    ConfigError
        One of them is not a rig, they are one file, or have no camera in common.
    """
    if path.resolve() == other.resolve():
        raise ConfigError(f"--compare {other}: another rig was expected, RIG itself found. Name two files")
    (first, verdict), (second, other_verdict) = verdict_of_file(path), verdict_of_file(other)
    names = (path.name, other.name) if path.name != other.name else (str(path), str(other))
    with schemaless(path, other):
        found = compare((first, second), names, (verdict, other_verdict))
        text = compare_page.render((first, second), found)
    written = folder / "index.html"
    write_text(written, valid(text))
    return written, found


def verdict_of_file(path: Path) -> tuple[Rig, Verdict]:
    """A rig and whether to trust it.

    Raises
    ------
    ConfigError
        Not a rig file.
    """
    rig = read_rig(path)
    with schemaless(path):
        return rig, numbers.verdict_of(rig, read_residuals_of(path, rig))


@contextmanager
def schemaless(*paths: Path) -> Iterator[None]:
    """`quality` and `provenance` have no schema, since what they hold changes with the methods: ConfigError where it is not as expected."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, TemplateError) as error:
        where = " or ".join(map(str, paths))
        raise ConfigError(
            f"{where}: quality: cannot be shown ({type(error).__name__}: {short(str(error))}); what `rgbd-calib calibrate` wrote "
            "there is needed. Calibrate again, or take `quality` out"
        ) from error


@one_blas_thread
def write_report(
    folder: Path,
    title: str,
    rig: Rig,
    boards: Mapping[str, FloatArray],
    residuals: Residuals | None,
    recording: Recording | None,
    missing: Mapping[str, str] | None = None,
) -> Path:
    """Write folder/index.html; returns its path."""
    contents = Contents(title, rig, boards, residuals, missing=missing or {}, start=_start(rig))
    if recording is not None:
        try:
            contents = _with_clouds(contents, recording)
        except RgbdCalibError as error:
            contents = _without(contents, "clouds", f"The clouds are not shown: {error}.")
    if recording is not None and residuals is not None:
        try:
            contents = replace(contents, views=view_pictures(recording, rig, boards, residuals))
        except RgbdCalibError as error:
            contents = _without(contents, "images", f"The images are not shown: {error}.")
    path = folder / "index.html"
    write_text(path, valid(render(contents)))
    return path


def _without(contents: Contents, section: str, why: str) -> Contents:
    return replace(contents, missing={**contents.missing, section: why})


def _start(rig: Rig) -> Rig | None:
    """The rig before, where the file says what it was."""
    return before(rig) if rig.quality.start is not None else None


def before(rig: Rig) -> Rig:
    """The rig that the calibration started from: first poses, given intrinsics, depth as the sensors report it.

    Rigs without that record are returned with their depth bias removed and nothing else.
    """
    start = rig.quality.start.cameras if rig.quality.start is not None else {}
    T_world_start = rig.cameras[rig.reference].T_world_color
    cameras = {}
    for name, own in rig.cameras.items():
        if name in start:
            T = start[name].T_world_color
            depth, beside = None, start.get(name_of(name))
            if beside is not None:
                depth = DepthCamera(beside.intrinsics, se3.inverse(T) @ beside.T_world_color)
            cameras[name] = RigCamera(start[name].intrinsics, T_world_start @ T, np.zeros((6, 6)), depth_camera=depth)
        else:
            cameras[name] = RigCamera(own.intrinsics, own.T_world_color, np.zeros((6, 6)))
    return Rig(rig.reference, cameras)


def _with_clouds(contents: Contents, recording: Recording) -> Contents:
    rig, boards = contents.rig, contents.boards
    frame, first = _frame(recording, rig, boards), before(rig)
    params = fuse.FuseParams(max_depth_m=_farthest_m(rig, boards))
    clouds = tuple(fuse.clouds_of(recording, one, frame, params) for one in (first, rig))
    board = rig.quality.board
    pictures = [_edge_on(clouds, rig, board, boards[frame])] if frame in boards and board is not None else []
    focus_m = splat.seen_by_several([cloud.points_m for cloud in clouds[1]])
    pictures += [_part(clouds, rig, view, focus_m) for view in VIEWS]
    how = rig.quality.start.poses_from if rig.quality.start is not None else None
    note = f"Depth is that of frame {frame}. " + (
        f"Before: poses by the {how}, intrinsics as given, depth as reported. After: the calibrated rig."
        if how
        else "Before: depth as reported. After: depth corrected. The rig file does not say from which poses it started."
    )
    moved = _moved_clouds(recording, first, rig, frame, params)
    return replace(contents, pictures=tuple(pictures), cloud_note=note, clouds=moved)


def _moved_clouds(
    recording: Recording, first: Rig, rig: Rig, frame: str, params: fuse.FuseParams
) -> tuple[MovedCloud, ...]:
    """Some pixels of each camera's depth, the same ones by both rigs."""
    names = [name for name in common_cameras(recording, rig) if recording.has_depth(name, frame)]
    out = []
    for name in names:
        depth_m = recording.depth_own_m(name, frame)
        both = [one.cameras[name] for one in (first, rig)]
        in_color = [own.depth_image.points(depth_m) for own in both]
        dropped = fuse.left_out(both[1], depth_m, in_color[1], params)
        kept = np.isfinite(depth_m) & np.all(np.isfinite(in_color), axis=(0, -1))
        kept &= ~np.any(list(dropped.values()), axis=0)
        points = [se3.transform(own.T_world_color, p) for own, p in zip(both, in_color, strict=True)]
        chosen = np.flatnonzero(kept)
        chosen = chosen[:: max(1, len(chosen) * len(names) // POINTS)]
        out.append(MovedCloud(name, *(p.reshape(-1, 3)[chosen] for p in points)))
    return tuple(out)


def _frame(recording: Recording, rig: Rig, boards: Mapping[str, FloatArray]) -> str:
    """The frame with the most depth images, the board in it where there is one."""
    cameras = common_cameras(recording, rig)
    fullest = fuse.fullest_frame(recording, cameras)
    count = {f: sum(recording.has_depth(c, f) for c in cameras) for f in recording.frames}
    with_board = [f for f in recording.frames if f in boards and count[f] == count[fullest]]
    return max(with_board, key=lambda f: _facing(rig, boards[f]), default=fullest)


def _facing(rig: Rig, T_world_board: FloatArray) -> float:
    """How many cameras look at the board's front, rather than along it or at its back: sum of their cosines."""
    return sum(max(0.0, float(own.T_world_color[:3, 2] @ T_world_board[:3, 2])) for own in rig.cameras.values())


def _farthest_m(rig: Rig, boards: Mapping[str, FloatArray]) -> float:
    depths = [
        (T[:3, 3] - own.T_world_color[:3, 3]) @ own.T_world_color[:3, 2]
        for T in boards.values()
        for own in rig.cameras.values()
    ]
    return _BEYOND * float(max(depths)) if depths else np.inf


Clouds = tuple[tuple[fuse.Cloud, ...], ...]


def _part(clouds: Clouds, rig: Rig, view: str, focus_m: FloatArray) -> CloudComparison:
    """The part of the scene that several cameras see, points `focus_m` (n, 3)."""
    low, high = np.percentile(focus_m, [1, 99], axis=0)
    margin = _MARGIN * (high - low)
    in_order = sorted(rig.cameras, key=lambda name: name != rig.reference)
    viewpoint = splat.viewpoint(view, [rig.cameras[name].T_world_color for name in in_order], focus_m)
    return _draw(
        clouds, rig, viewpoint, VIEWS[view], lambda p: np.all((p > low - margin) & (p < high + margin), axis=1)
    )


def _edge_on(clouds: Clouds, rig: Rig, board: Board, T_world_board: FloatArray) -> CloudComparison:
    """The board of this frame, looked at along its rows of squares: cameras that agree make one line."""
    size_m = np.array([board.cols - 1, board.rows - 1]) * board.square_m
    T_board_world = se3.inverse(T_world_board)

    def near(points_m: FloatArray) -> np.ndarray:
        p = se3.transform(T_board_world, points_m)
        inside = np.all((p[:, :2] > -board.square_m) & (p[:, :2] < size_m + board.square_m), axis=1)
        return np.asarray(inside & (np.abs(p[:, 2]) < _SLAB_M))

    x, y, z = T_world_board[:3, :3].T
    middle_m = se3.transform(T_world_board, np.array([*size_m / 2, 0.0]))
    viewpoint = splat.Viewpoint(np.stack([x, -z, y]), middle_m, 0.4 * float(size_m[0]))
    drawn = _draw(clouds, rig, viewpoint, EDGE_ON, near, (SIZE[0], SIZE[1] // 2))
    first, then = (splat.with_scale(p, viewpoint, _BAR_M) for p in (drawn.before, drawn.after))
    return CloudComparison(EDGE_ON, first, then)


def _draw(
    clouds: Clouds,
    rig: Rig,
    viewpoint: splat.Viewpoint,
    name: str,
    shown: Callable[[FloatArray], np.ndarray],
    size: tuple[int, int] = SIZE,
) -> CloudComparison:
    color = {camera: splat.camera_color(i) for i, camera in enumerate(rig.cameras)}
    pictures = []
    for fused in clouds:
        points_m = [cloud.points_m[shown(cloud.points_m)] for cloud in fused]
        colors = [np.full((len(p), 3), color[c.camera], np.uint8) for c, p in zip(fused, points_m, strict=True)]
        pictures.append(splat.render(np.concatenate(points_m), np.concatenate(colors), viewpoint, *size))
    return CloudComparison(name, *pictures)
