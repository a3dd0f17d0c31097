"""Is a spoiled recording ever calibrated wrongly without a word? Each way to spoil one in turn, against the truth.

    python scripts/study_silent_failures.py [--json] [--seeds 2] [--only PATTERN] [--ideal]
    python scripts/study_silent_failures.py --false-alarms 100
    python scripts/study_silent_failures.py --recording REALSENSE3

A row is right where both errors, two cameras' places of one point against each other and against the truth, are at most 1 mm
or at most twice what the result states (for places against the truth with the uncertainty of the scale in it, which is stated
apart); else it must have ended in an error, or in a verdict that says not to trust it or by how much the stated error is too
small. What is left is SILENT. What is said must name the cause: :mod:`spoiling_causes`. A real recording's spoiled files
(:mod:`real_spoilings`) are compared with what it gives unspoiled, in place of the truth.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import click
import numpy as np
from real_spoilings import SPOILINGS, Files, Spoiling, with_unspoiled
from spoiling_causes import CAUSES

from rgbd_calib.cameras.depth_bias import fit_with_data
from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.geometry import align, se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import write_depth_bias, write_intrinsics
from rgbd_calib.pipeline.calibrate import Calibration, calibrate
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import board_of, detections_from, silent
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.simulation.faults import FAULTS, RINGS
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.rig import Layout
from rgbd_calib.simulation.session import VIEW_SPREAD, Session, draw_scene, film, write_session
from rgbd_calib.simulation.views import ViewNoise
from rgbd_calib.trust import uncertainty
from rgbd_calib.trust.verdict import judge
from rgbd_calib.types import Board, Rig
from rgbd_calib.views.detect import DetectParams

STATED_FACTOR, FLOOR_MM = 2.0, 1.0
REALISTIC = Realism()


@dataclass(frozen=True)
class Row:
    """What came of one spoiled session."""

    fault: str
    seed: int
    alignment_mm: float | None
    """Two cameras' places of one point, mean over the volume where the board was."""
    place_mm: float | None
    """Cameras' places of points against the truth, the world laid on the true one: what distances are off by."""
    stated_mm: float | None
    """Expected distance of two cameras' places of one point."""
    scale_mm: float
    """One sigma of distances as such, from the board's size by the depth, at the usual distance."""
    level: str
    says: str
    seconds: float
    cause: str = ""
    """Words that name the cause."""

    @property
    def right(self) -> bool:
        """Whether the errors are as stated."""
        if self.alignment_mm is None or self.place_mm is None:
            return False
        stated = self.stated_mm or 0.0
        allowed = STATED_FACTOR * stated, STATED_FACTOR * float(np.hypot(stated, self.scale_mm))
        return all(e <= max(a, FLOOR_MM) for e, a in zip((self.alignment_mm, self.place_mm), allowed, strict=True))

    @property
    def judged(self) -> str:
        """right, clear error, warned or SILENT."""
        if self.level == "error":
            return "clear error"
        if self.level in ("untrusted", "poor") or "Self-check (" in self.says:
            return "right, warned" if self.right else "warned"
        return "right" if self.right else "SILENT"

    @property
    def named(self) -> bool | None:
        """Does what is said name the cause? None: nothing is said, or the cause is not in the table."""
        if self.judged == "right" or not self.cause:
            return None
        return re.search(self.cause, self.says) is not None


def try_fault(
    fault: str, seed: int, cameras: int = 3, frames: int = 24, close: int = 14, realism: Realism = REALISTIC
) -> Row:
    """Spoil a drawn session in one way, and calibrate it."""
    layout, n = ("ring", max(cameras, 4)) if fault in RINGS else ("arc", cameras)
    rng = np.random.default_rng([seed, zlib.crc32(fault.encode())])
    scene = draw_scene(n, layout, frames, close, np.random.default_rng(seed), realism=realism)  # type: ignore[arg-type]
    session, cause = FAULTS[fault](scene, rng), CAUSES.get(fault, "")
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            result = calibrate_session(session, Path(folder))
        except RgbdCalibError as error:
            said = str(error).replace(folder, "DIR")
            return Row(fault, seed, None, None, None, 0.0, "error", said, time.perf_counter() - start, cause)
    rig = with_true_depth(result.rig, session)
    seconds = time.perf_counter() - start
    row = row_of(fault, seed, result, rig, session.truth, session.boards, session.board, seconds)
    return replace(row, cause=cause)


def row_of(
    fault: str,
    seed: int,
    result: Calibration,
    rig: Rig,
    truth: Rig,
    boards: Mapping[str, FloatArray],
    board: Board,
    seconds: float,
) -> Row:
    """What a result says, and the errors of `rig` against the truth over the volume of its boards."""
    quality = result.rig.quality
    verdict, scale = judge(quality, ()), quality.self_check.scale
    return Row(
        fault,
        seed,
        1e3 * float(against_truth(rig, truth, boards, board).distance_m.mean()),
        place_error_mm(rig, truth, boards, board),
        quality.expected_mm,
        0.0 if scale is None else 10 * scale.sd_percent * scale.distance_m,
        verdict.level,
        " | ".join([verdict.headline, *verdict.reasons]),
        seconds,
    )


def try_files(name: str, spoiling: Spoiling, recording: Path, base: Calibration) -> Row:
    """Spoil the files of a recording in one way, calibrate it, and compare with the unspoiled result."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        files = Files(recording, Path(folder) / "recording")
        spoiling.apply(files)
        try:
            result = calibrate(open_recording(files.folder), Config())
        except RgbdCalibError as error:
            said = str(error).replace(folder, "DIR")
            return Row(name, 0, None, None, None, 0.0, "error", said, time.perf_counter() - start, spoiling.says)
    board = board_of(open_recording(recording))
    rig = with_unspoiled(result.rig, base.rig, spoiling)
    row = row_of(name, 0, result, rig, base.rig, base.boards, board, time.perf_counter() - start)
    return replace(row, cause=spoiling.says)


def calibrate_session(session: Session, folder: Path) -> Calibration:
    """The whole calibration of a session, from its corners."""
    write_session(session, folder)
    for dataset in folder.glob(
        "*trinsic/dataset.yaml"
    ):  # as written by hand: the program itself refuses to write such sizes
        if session.board.square_m > 1:
            dataset.write_text(dataset.read_text().replace("square: 1.0", f"square: {session.board.square_m}"))
    recording = open_recording(folder / "extrinsic")
    found = detections_from(recording, folder / "extrinsic.csv", DetectParams(), None, silent)
    lenses, bias, close = None, None, None
    if session.lenses:
        lenses = folder / "intrinsics.yaml"
        write_intrinsics(lenses, session.lenses, {}, {}, {})
    elif session.close is not None:
        lenses = folder / "intrinsic"
        close = detections_from(open_recording(lenses), folder / "intrinsic.csv", DetectParams(), None, silent)
    if session.walls is not None and session.wall_cells is not None:
        bias = folder / "depth_bias"
    elif session.walls is not None:
        bias = folder / "depth_bias.yaml"
        fits = {
            c: fit_with_data(rows[:, 0], rows[:, 1], camera=c, sigma_m=rows[:, 2]) for c, rows in session.walls.items()
        }
        write_depth_bias(bias, {c: fit.bias for c, fit in fits.items()}, {}, {}, {})
    return calibrate(
        recording, Config(), intrinsics=lenses, depth_bias=bias, detections=found, intrinsic_detections=close
    )


def with_true_depth(rig: Rig, session: Session) -> Rig:
    """Cameras that had no depth are judged by their pose and lens alone."""
    blind = {c for c in rig.cameras if not any(np.isfinite(v.depth_m).any() for v in session.views if v.camera == c)}
    true = session.truth.cameras
    cameras = {
        c: replace(
            own, depth_bias=true[c].depth_bias, depth_field=true[c].depth_field, depth_camera=true[c].depth_camera
        )
        if c in blind
        else own
        for c, own in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def place_error_mm(rig: Rig, truth: Rig, boards: Mapping[str, FloatArray], board: Board) -> float:
    """Mean distance of where each camera puts points of the boards' box from where they are.

    The world is laid on the true one: where the reference camera's axis is within it is nobody's concern.
    """
    corners = np.concatenate([se3.transform(T, board.corners_m()) for T in boards.values()])
    points = uncertainty.volume(corners, 8)
    places, true = [], []
    for name in rig.cameras:
        seen = uncertainty.observe(truth, name, points)
        at = uncertainty.place(rig, name, seen)
        kept = seen.seen & np.isfinite(at).all(axis=1)
        places.append(at[kept])
        true.append(points[kept])
    put, meant = np.concatenate(places), np.concatenate(true)
    return 1e3 * float(np.linalg.norm(se3.transform(align.rigid(meant, put), put) - meant, axis=1).mean())


@dataclass(frozen=True)
class Clean:
    """What came of one unspoiled session."""

    seed: int
    rig: str
    alignment_mm: float
    stated_mm: float
    bound_95_mm: float
    """What 95 of 100 draws from the result's covariance are below, of the mean distance over the volume."""
    level: str
    trusted: bool
    findings: tuple[str, ...]
    """Texts of those that tell the user to do something."""
    seconds: float


def false_alarm(seed: int) -> Clean:
    """An unspoiled session of a drawn rig: arcs and rings of two to eight cameras, with and without walls."""
    rng = np.random.default_rng([seed, 7])
    ring = seed % 3 == 2
    n = int(rng.integers(4 if ring else 2, 9))
    size = ((640, 480), (1280, 720), (320, 240))[int(rng.integers(3))]
    cols, rows, square_m = ((9, 6, 0.06), (11, 8, 0.045), (8, 5, 0.07))[int(rng.integers(3))]
    board = Board(cols, rows, square_m, two_sided=ring, thickness_m=0.006 if ring else 0.0)
    noise = ViewNoise(*(a * float(rng.uniform(0.5, 2)) for a in (0.08, 0.7e-3, 0.3e-3)), spread=VIEW_SPREAD)
    shared_m = ((1.0, 2.4), (1.3, 2.9), (1.6, 3.4))[int(rng.integers(3))]
    frames, walls = int(rng.integers(5, 10)) * n, seed % 4 != 3
    layout: Layout = "ring" if ring else "arc"
    scene = draw_scene(n, layout, frames, 14, rng, board, noise, Realism(), size=size, shared_m=shared_m)
    session = film(scene, rng)
    if not walls:
        session = replace(session, walls=None)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        result = calibrate_session(session, Path(folder))
    own = result.rig.quality.self_check
    rig = f"{layout} of {n}, {size[0]}x{size[1]}, board {cols}x{rows}, {noise.sigma_2d_px:.2f} px, {frames} frames"
    return Clean(
        seed,
        rig + ("" if walls else ", no walls"),
        1e3 * float(against_truth(result.rig, session.truth, session.boards, session.board).distance_m.mean()),
        result.rig.quality.expected_mm,
        bound_95_mm(result, session, np.random.default_rng(seed)),
        judge(result.rig.quality, ()).level,
        own.trusted,
        tuple(f.text for f in own.findings),
        time.process_time() - start,
    )


def bound_95_mm(result: Calibration, session: Session, rng: np.random.Generator, draws: int = 400) -> float:
    """What 95 % of draws from the result's covariance are below: mean distance of two cameras' places of one point.

    The depth's fine pattern, which is no parameter of the rig, is drawn at each point by itself.
    """
    rig, joint = result.rig, result.joint
    assert joint is not None
    corners = np.concatenate([se3.transform(T, session.board.corners_m()) for T in session.boards.values()])
    points = uncertainty.volume(corners, 6)
    values, vectors = np.linalg.eigh(joint.matrix)
    theta = (vectors * np.sqrt(np.maximum(values, 0))) @ rng.standard_normal((len(values), draws))
    seen, moved = {}, {}
    for name in rig.cameras:
        observed = uncertainty.observe(rig, name, points)
        seen[name] = observed.seen
        at, J = uncertainty.by_parameters(rig, name, observed, joint)
        pattern = np.linalg.cholesky(uncertainty.pattern_covariance(rig, name, observed) + 1e-18 * np.eye(3))
        held = uncertainty.by_held_depth(rig, name, observed)[..., None] * rng.standard_normal(draws)
        moved[name] = J @ theta[at] + pattern @ rng.standard_normal((len(points), 3, draws)) + held
    apart = [np.linalg.norm(moved[a] - moved[b], axis=1)[seen[a] & seen[b]] for a, b in combinations(rig.cameras, 2)]
    return 1e3 * float(np.quantile(np.concatenate(apart).mean(axis=0), 0.95))


@click.command()
@click.option("--false-alarms", "clean", type=int, help="Try this many unspoiled sessions instead.")
@click.option("--first", default=0, show_default=True, help="Seed to begin with.")
@click.option("--seeds", default=1, show_default=True)
@click.option("--only", default="", help="Spoilings whose name matches this regular expression.")
@click.option("--recording", type=click.Path(exists=True, path_type=Path), help="Spoil this one's files instead.")
@click.option("--ideal", is_flag=True, help="Prints, sensors and walls without the errors of real ones.")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(
    clean: int | None, first: int, seeds: int, only: str, recording: Path | None, ideal: bool, as_json: bool
) -> None:
    rows: list[dict[str, Any]] = []

    def add(row: Row) -> None:
        rows.append({**asdict(row), "judged": row.judged, "named": row.named})
        click.echo(json.dumps(rows[-1]), err=True)

    if recording:
        base = calibrate(open_recording(recording), Config())
        for name, spoiling in SPOILINGS.items():
            if re.search(only, name):
                add(try_files(name, spoiling, recording, base))
    if clean:
        for seed in range(first, first + clean):
            rows.append(asdict(false_alarm(seed)))
            click.echo(json.dumps(rows[-1]), err=True)
    for fault in [] if clean or recording else [f for f in FAULTS if re.search(only, f)]:
        for seed in range(first, first + seeds):
            add(try_fault(fault, seed, realism=IDEAL if ideal else Realism()))
    if as_json:
        click.echo(json.dumps(rows, indent=1))
    else:
        click.echo(summary_of_clean(rows) if clean else table(rows))


def summary_of_clean(rows: Sequence[dict[str, Any]]) -> str:
    said = [r for r in rows if r["findings"]]
    inside = sum(r["alignment_mm"] <= r["bound_95_mm"] for r in rows)
    ratio = float(np.median([r["alignment_mm"] / r["stated_mm"] for r in rows]))
    lines = [f"  seed {r['seed']}: {r['rig']}: {'; '.join(r['findings'])}" for r in said]
    return "\n".join(
        [
            f"{len(rows)} unspoiled sessions: {len(said)} with a finding, {sum(not r['trusted'] for r in rows)} not trusted; alignment "
            f"within its 95 % bound in {inside}; median of alignment over stated {ratio:.2f}",
            *lines,
        ]
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| spoiling | alignment / place error, mm | stated, mm | outcome | what is said | cause named |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        errors = "" if r["alignment_mm"] is None else f"{r['alignment_mm']:.2f} / {r['place_mm']:.2f}"
        stated = "" if r["stated_mm"] is None else f"{r['stated_mm']:.2f}"
        named = {None: "", True: "yes", False: "no"}[r["named"]]
        said = r["says"].split(" | ")[0][:160]
        lines.append(f"| {r['fault']} | {errors} | {stated} | {r['judged']}, {r['level']} | {said} | {named} |")
    silent_ones = sum(r["judged"] == "SILENT" for r in rows)
    told = [r for r in rows if r["named"] is not None]
    lines.append(
        f"\n{len(rows)} sessions, {silent_ones} silent; cause named in {sum(r['named'] for r in told)} of {len(told)}."
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
