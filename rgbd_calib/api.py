"""What Python programs call: recordings, calibrations and rigs. The commands call the same functions.

Nothing is printed: messages go to the logger `rgbd_calib` of :mod:`logging`, progress to whoever asks for it. Lengths are metres,
angles radians, unless a name ends in `_mm` or `_deg`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as recordings
from rgbd_calib.io.cache import default_folder
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals, read_residuals_of, write_result
from rgbd_calib.io.rig import read_rig, read_rig_and_boards, write_rig
from rgbd_calib.pipeline import fuse as fusing
from rgbd_calib.pipeline import notebook
from rgbd_calib.pipeline.calibrate import Calibration
from rgbd_calib.pipeline.calibrate import calibrate as run_calibration
from rgbd_calib.pipeline.calibrate_carried import calibrate_carried
from rgbd_calib.pipeline.carried_calibration import check_possible
from rgbd_calib.pipeline.checked_views import reference_of
from rgbd_calib.pipeline.config import Config, Method, load_config, with_settings
from rgbd_calib.pipeline.depth_cameras import split
from rgbd_calib.pipeline.detection import Progress, detections_from, silent
from rgbd_calib.pipeline.held_out_frames import frames_of_calibration, refuse_nothing_new
from rgbd_calib.pipeline.prepare import check_sources, check_together
from rgbd_calib.pipeline.progress import bar
from rgbd_calib.pipeline.report import write_report
from rgbd_calib.pipeline.verify import Verification
from rgbd_calib.pipeline.verify import verify as run_verify
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.pipeline.world import in_world
from rgbd_calib.report.numbers import verdict_of
from rgbd_calib.trust.displacement import VerdictParams
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Rig

log = logging.getLogger("rgbd_calib")
log.addHandler(logging.NullHandler())


@dataclass(frozen=True)
class CalibratedRig(Rig):
    """A rig with what is known of its calibration. `rig["C2"]` is a camera: `T_world_color`, `intrinsics`, `project`."""

    boards: Mapping[str, FloatArray] = field(default_factory=dict)
    """T_world_board (4, 4) by frame."""
    residuals: Residuals | None = None
    """Per corner of each view; None where they are not known."""

    def __iter__(self) -> Iterator[str]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def verdict(self) -> Verdict:
        """Whether to trust the rig, and why."""
        return verdict_of(self, self.residuals)

    def save(self, path: str | Path) -> None:
        """Write the rig, and its residuals beside it as NAME.residuals.csv; existing files are replaced.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        if self.residuals is None:
            write_rig(Path(path), self, self.boards or None)
        else:
            write_result(Path(path), self, self.boards, self.residuals)

    def fuse(
        self, recording: Recording | str | Path, frame: str, *, max_depth_m: float = np.inf
    ) -> tuple[FloatArray, np.ndarray]:
        """The depth of all cameras in one frame as one cloud: points (N, 3), metres, in the world; colours (N, 3), uint8, R G B.

        Depth is corrected by the rig; pixels at depth edges, and those beyond `max_depth_m`, are left out.

        Raises
        ------
        ConfigError
            No such frame, or the rig is not of this recording.
        CalibrationError
            No camera of the rig has depth in this frame.
        """
        clouds = fusing.clouds_of(_opened(recording), self, frame, fusing.FuseParams(max_depth_m=max_depth_m))
        return np.concatenate([c.points_m for c in clouds]), np.concatenate([c.colors for c in clouds])

    def __repr__(self) -> str:
        return f"<CalibratedRig of {', '.join(self.cameras)}; reference {self.reference}>"

    def _repr_html_(self) -> str:
        return notebook.rig_html(self)


@dataclass(frozen=True, repr=False)
class Result:
    """A calibration: the rig, whether to trust it, and what the report shows."""

    rig: CalibratedRig
    recording: Recording
    calibration: Calibration
    """All intermediate results; its fields are not stable."""

    @property
    def verdict(self) -> Verdict:
        """Whether to trust the rig, and why; `str` of it is one sentence."""
        return self.rig.verdict

    @property
    def expected_mm(self) -> float | None:
        """Mean expected distance between the places where two cameras see one point, mm; None where it is not known."""
        return self.rig.quality.expected_mm

    def report(self, folder: str | Path, *, title: str = "rig") -> Path:
        """Write the report, one HTML file without links to others, into `folder`; its path."""
        rig = self.rig
        return write_report(Path(folder), title, rig, rig.boards, rig.residuals, self.recording)

    def __repr__(self) -> str:
        return f"<Result: {self.verdict}>"

    def _repr_html_(self) -> str:
        return self.verdict._repr_html_() + self.rig._repr_html_()


def open_recording(path: str | Path) -> Recording:
    """Open a recording, a folder with dataset.yaml; images are read when they are needed.

    Raises
    ------
    ConfigError
        Not a recording, or a wrong key in dataset.yaml.
    """
    return recordings.open_recording(Path(path))


def load_rig(path: str | Path) -> CalibratedRig:
    """Read a rig file, and the residuals beside it where there are some.

    Raises
    ------
    ConfigError
        Not a rig file.
    """
    path = Path(path)
    rig, boards = read_rig_and_boards(path)
    return CalibratedRig(rig.reference, rig.cameras, rig.quality, rig.provenance, boards, read_residuals_of(path, rig))


def calibrate(
    recording: Recording | str | Path,
    *,
    intrinsics: str | Path | None = None,
    depth_bias: str | Path | None = None,
    method: Method | None = None,
    reference: str | None = None,
    world: str | None = None,
    corners: str | Path | None = None,
    config: Config | str | Path | None = None,
    seed: int | None = None,
    max_views: int | None = None,
    workers: Workers | int | None = None,
    progress: Progress | bool = False,
    **settings: Any,
) -> Result:
    """Calibrate a rig from a recording of a board.

    Parameters
    ----------
    intrinsics, depth_bias : a file, or a recording to make it from; None: from `recording`.
    world : "board:FRAME", "floor", or a camera; None: the reference camera.
    corners : corners.csv of `rgbd-calib detect`, instead of detecting again.
    config : settings, or a YAML file of them; the other arguments win over it.
    workers : how many processes look at images; None: as many as there are cores. Detections are cached.
    progress : True: progress bars on stderr, where that is a terminal; or a function as :data:`Progress`.
    settings : single settings, as `refinement__sigma_2d_px=0.3`.

    Raises
    ------
    ConfigError
        A file or setting is wrong.
    CalibrationError
        The data do not determine the rig.
    """
    opened = _opened(recording)
    for remark in opened.remarks:
        log.warning("Warning: %s", remark)
    if world in opened.cameras:
        reference, world = world, None
    over = {"method": method, "reference": reference, "seed": seed, "max_views": max_views, **settings}
    resolved = _config(config, over)
    shown = bar if progress is True else progress or silent
    lens, bias = _path(intrinsics), _path(depth_bias)
    reference_of(resolved, list(opened.cameras))
    apart = split(opened)
    if apart.synchronous:
        check_together(apart)
    else:
        check_possible(apart, resolved)
    check_sources(apart, lens, bias)
    pool = _workers(workers)
    found = detections_from(apart, _path(corners), resolved.detect, pool, shown)
    run = run_calibration if apart.synchronous else calibrate_carried
    made = run(
        apart,
        resolved,
        intrinsics=lens,
        depth_bias=bias,
        detections=found,
        workers=pool,
        progress=shown,
    )
    if world is not None:
        made = in_world(made, world, opened, resolved.seed)
    own = made.rig
    rig = CalibratedRig(own.reference, own.cameras, own.quality, own.provenance, made.boards, made.residuals)
    return Result(rig, opened, made)


def verify(
    rig: Rig | str | Path,
    recording: Recording | str | Path,
    *,
    max_mm: float | None = None,
    corners: str | Path | None = None,
    config: Config | str | Path | None = None,
    workers: Workers | int | None = None,
    progress: Progress | bool = False,
) -> Verification:
    """Check a rig against new frames of the board; `holds` of the result is True where every pair is within `max_mm`.

    Raises
    ------
    ConfigError
        A file is wrong, the recording is not of this rig, or the rig was calibrated from all of its frames.
    CalibrationError
        No two cameras see the board in the same frame.
    """
    opened, resolved = split(_opened(recording)), _config(config, {})
    known = rig if isinstance(rig, Rig) else read_rig(Path(rig))
    pool = _workers(workers)
    shown = bar if progress is True else progress or silent
    used = frames_of_calibration(known, opened)
    refuse_nothing_new(known, opened, used)
    if used:
        log.info("Held out: %d of %d frames, which the rig was calibrated from", len(used), len(opened.frames))
    found = detections_from(opened, _path(corners), resolved.detect, pool, shown)
    new = [view for view in found.views if view.frame not in used]
    params = VerdictParams() if max_mm is None else VerdictParams(max_m=max_mm / 1e3)
    return run_verify(known, opened, new, resolved, params)


def _opened(recording: Recording | str | Path) -> Recording:
    return recording if isinstance(recording, Recording) else open_recording(recording)


def _path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)


def _workers(given: Workers | int | None) -> Workers:
    return given if isinstance(given, Workers) else Workers(given, cache=default_folder(), say=log.warning)


def _config(config: Config | str | Path | None, over: Mapping[str, Any]) -> Config:
    if isinstance(config, Config):
        return with_settings(config, over)
    return load_config(_path(config), **over)
