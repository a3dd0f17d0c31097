"""`rgbd-calib verify`: does a rig still hold?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import Number, config_option, corners_option, progress, say, show, workers_options

if TYPE_CHECKING:
    from rgbd_calib.io.recording import Recording
    from rgbd_calib.pipeline.verify import Verification
    from rgbd_calib.pipeline.workers import Workers
    from rgbd_calib.trust.snapshot.rig import RigVerdict
    from rgbd_calib.types import Rig


@click.command
@click.argument("rig_path", metavar="RIG", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "--max-mm",
    type=Number(0, 1000, min_open=True),
    default=3.0,
    show_default=True,
    help="How far apart two cameras may put the board.",
)
@click.option(
    "--snapshot",
    type=click.Path(path_type=Path),
    help="An old recording of the same scene, made when RIG was calibrated: no board is needed.  [default: RIG.snapshot, if "
    "RECORDING has no board]",
)
@click.option(
    "--distance",
    type=Number(0.3, 20),
    default=2.0,
    show_default=True,
    metavar="M",
    help="With a snapshot: working distance at which displacements are stated.",
)
@corners_option
@click.option("--json", "as_json", is_flag=True, help="Print all numbers as JSON.")
@config_option
@workers_options
def command(
    rig_path: Path,
    recording: Path,
    max_mm: float,
    snapshot: Path | None,
    distance: float,
    corners: Path | None,
    as_json: bool,
    config: Path | None,
    workers: Workers,
) -> int:
    """Check from a few new frames whether RIG is still valid, and which camera moved: of the board, or of the empty scene.

    Lenses and depth biases are taken as they are; the cameras are posed anew by RECORDING and compared, pair by pair, at
    the places where the board was, noise taken off. Frames that the rig was calibrated from are held out. Five frames for
    each pair of neighbours are good. Where a camera moved, put it back by `calibrate --update --only`.

    With a snapshot no board is needed: each camera is compared with its own old images of the same scene, by tracked
    corners and depth; people and moved furniture are outliers. The table has each camera's displacement at --distance
    and its standard deviation. A motion of the whole rig is told from that of one camera. Where RECORDING has a board
    too, both checks are made.

    \b
    Exit status:
      0  every pair, or every camera, is within --max-mm
      1  a camera moved, or the frames cannot tell (which is said)

    \b
    Examples:
      rgbd-calib verify rig.yaml monday
      rgbd-calib verify rig.yaml monday --max-mm 2 --json
      rgbd-calib verify rig.yaml monday --snapshot friday
      rgbd-calib verify rig.yaml monday || rgbd-calib calibrate monday --update rig.yaml --only C3 -o rig2.yaml
    """
    from rgbd_calib.io.plain import to_json
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.io.snapshot import kept_beside
    from rgbd_calib.pipeline import snapshot as snapshots
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.rig_inputs import left_out

    settings = None
    if config is not None:
        from rgbd_calib.pipeline.config import load_config

        settings = load_config(config)
    rig, opened = read_rig(rig_path), split(open_recording(recording))
    if left_out(opened, rig):
        say(left_out(opened, rig))
    kept = kept_beside(rig_path)
    if snapshot is None and opened.board is None and kept.is_dir():
        snapshot = kept
    holds, numbers = True, {}
    if snapshot is not None:
        verdict = _against_snapshot(rig, opened, snapshot, max_mm, distance)
        holds, numbers = verdict.holds, snapshots.summary(verdict)
        if not as_json:
            for line in snapshot_table(verdict):
                show(line)
            show(snapshots.sentence(verdict))
    if snapshot is None or opened.board is not None:
        from rgbd_calib import api  # a second, which a snapshot does without
        from rgbd_calib.pipeline import verify as boards

        found = api.verify(
            rig, opened, max_mm=max_mm, corners=corners, config=settings, workers=workers, progress=progress
        )
        if not as_json:
            _tell(found)
        by_board = boards.summary(found)
        holds, numbers = holds and found.holds, by_board if snapshot is None else numbers | {"by_board": by_board}
    if as_json:
        show(to_json(numbers, indent=2))
    return 0 if holds else 1


def _against_snapshot(rig: Rig, opened: Recording, snapshot: Path, max_mm: float, distance_m: float) -> RigVerdict:
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.snapshot import verify_snapshot
    from rgbd_calib.trust.displacement import VerdictParams
    from rgbd_calib.trust.snapshot import SnapshotParams

    if opened.path.samefile(snapshot):
        say(f"{opened.path}: is the old snapshot itself, which any rig passes")
    params = SnapshotParams(distance_m, VerdictParams(max_m=max_mm / 1e3))
    return verify_snapshot(rig, opened, open_recording(snapshot), params)


def snapshot_table(verdict: RigVerdict) -> list[str]:
    """A line for each camera."""
    from math import degrees

    from rgbd_calib.trust.snapshot import drift_sentence

    lines = []
    for name, own in verdict.cameras.items():
        lines.append(
            f"{name}: {1e3 * own.displacement_m:.2f} ± {1e3 * own.displacement_sd_m:.2f} mm at {verdict.params.distance_m:g} m "
            f"({1e3 * own.shift_m:.2f} ± {1e3 * own.shift_sd_m:.2f} mm, {degrees(own.turn_rad):.3f} ± "
            f"{degrees(own.turn_sd_rad):.3f}°); {100 * own.motion.unchanged_share:.0f} % of the scene unchanged"
            + ("  MOVED" if own.moved else "")
        )
        if drift := drift_sentence(own.motion.motion):
            lines.append(f"{name}: {drift}")
    lines += [f"{name}: undetermined: {why}" for name, why in verdict.undetermined.items()]
    lines += [f"{name}: not checked: no colour and depth in both snapshots" for name in verdict.missing]
    return lines


def _tell(found: Verification) -> None:
    from math import degrees

    for pair in found.verdict.pairs:
        mark = "  OFF" if pair.broken else ""
        show(f"{' - '.join(pair.cameras)}: {1e3 * pair.error_m:.2f} ± {1e3 * pair.noise_m:.2f} mm{mark}")
    displacements = {own.camera: own for own in found.verdict.displacements}
    for name in found.verdict.moved:
        own = displacements[name]
        show(
            f"{name} moved: {1e3 * own.shift_m:.2f} ± {1e3 * own.shift_sd_m:.2f} mm, "
            f"{degrees(own.turn_rad):.3f} ± {degrees(own.turn_sd_rad):.3f}° against the others"
        )
    for (camera, frame), why in found.left_out.items():
        say(f"{camera}: frame {frame} left out: {why}")
    show(str(found))
