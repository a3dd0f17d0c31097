"""`rgbd-calib verify`: does a rig still hold?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli.options import Number, config_option, corners_option, progress, say, show, workers_options

if TYPE_CHECKING:
    from rgbd_calib.io.recording import Recording
    from rgbd_calib.pipeline.workers import Workers
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
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.held_out_frames import frames_of_calibration, refuse_nothing_new
    from rgbd_calib.pipeline.rig_inputs import left_out
    from rgbd_calib.pipeline.verify import summary, verify
    from rgbd_calib.trust.displacement import VerdictParams

    rig, opened, settings = read_rig(rig_path), split(open_recording(recording)), load_config(config)
    if left_out(opened, rig):
        say(left_out(opened, rig))
    kept = kept_beside(rig_path)
    if snapshot is None and opened.board is None and kept.is_dir():
        snapshot = kept
    numbers: dict[str, Any] = {}
    if snapshot is not None:
        numbers = _against_snapshot(rig, opened, snapshot, max_mm, distance, as_json)
    if snapshot is None or opened.board is not None:
        used = frames_of_calibration(rig, opened)
        refuse_nothing_new(rig, opened, used)
        if used:
            say(f"Held out: {len(used)} of {len(opened.frames)} frames, which the rig was calibrated from")
        found = detections_from(opened, corners, settings.detect, workers, progress)
        new = [view for view in found.views if view.frame not in used]
        by_board = summary(verify(rig, opened, new, settings, VerdictParams(max_m=max_mm / 1e3)))
        if not as_json:
            _tell(by_board)
        numbers = by_board if snapshot is None else numbers | {"by_board": by_board}
    if as_json:
        show(to_json(numbers, indent=2))
    return 0 if numbers["holds"] and numbers.get("by_board", {"holds": True})["holds"] else 1


def _against_snapshot(
    rig: Rig, opened: Recording, snapshot: Path, max_mm: float, distance_m: float, quiet: bool
) -> dict[str, Any]:
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.snapshot import summary, verify_snapshot
    from rgbd_calib.trust.displacement import VerdictParams
    from rgbd_calib.trust.snapshot import SnapshotParams

    if opened.path.samefile(snapshot):
        say(f"{opened.path}: is the old snapshot itself, which any rig passes")
    params = SnapshotParams(distance_m, VerdictParams(max_m=max_mm / 1e3))
    numbers = summary(verify_snapshot(rig, opened, open_recording(snapshot), params))
    if not quiet:
        for line in snapshot_table(numbers):
            show(line)
        show(numbers["verdict"])
    return numbers


def snapshot_table(numbers: dict[str, Any]) -> list[str]:
    """A line for each camera."""
    at = f"at {numbers['distance_m']:g} m"
    lines = []
    for name, own in numbers["cameras"].items():
        mark = "  MOVED" if own["moved"] else ""
        lines.append(
            f"{name}: {own['displacement_mm']:.2f} ± {own['displacement_sd_mm']:.2f} mm {at} "
            f"({own['shift_mm']:.2f} ± {own['shift_sd_mm']:.2f} mm, {own['turn_deg']:.3f} ± {own['turn_sd_deg']:.3f}°); "
            f"{100 * own['unchanged_share']:.0f} % of the scene unchanged{mark}"
        )
        if own["depth_drift"]:
            lines.append(f"{name}: {own['depth_drift']}")
    lines += [f"{name}: undetermined: {why}" for name, why in numbers["undetermined"].items()]
    lines += [f"{name}: not checked: no colour and depth in both snapshots" for name in numbers["not_checked"]]
    return lines


def _tell(numbers: dict[str, Any]) -> None:
    for name, pair in numbers["pairs"].items():
        mark = "  OFF" if pair["off"] else ""
        show(f"{name}: {pair['error_mm']:.2f} ± {pair['noise_mm']:.2f} mm{mark}")
    for name in numbers["moved"]:
        own = numbers["cameras"][name]
        show(
            f"{name} moved: {own['shift_mm']:.2f} ± {own['shift_sd_mm']:.2f} mm, "
            f"{own['turn_deg']:.3f} ± {own['turn_sd_deg']:.3f}° against the others"
        )
    for text in numbers["views_left_out"]:
        say(text)
    show(numbers["verdict"])
