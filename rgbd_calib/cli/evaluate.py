"""`rgbd-calib evaluate`: how good a rig is, in millimetres."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import config_option, corners_option, progress, show, workers_options

if TYPE_CHECKING:
    from rgbd_calib.pipeline.clouds import CloudAlignment
    from rgbd_calib.pipeline.workers import Workers
    from rgbd_calib.quality import AlignmentNumbers


@click.command()
@click.argument("rig", type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), help="truth.yaml of a simulated recording.")
@click.option(
    "--recording", type=click.Path(path_type=Path), help="A recording of the board that the rig was not made from."
)
@click.option(
    "--clouds",
    type=click.Path(path_type=Path),
    help="A recording with depth: compare the clouds of the cameras on surfaces that two of them see.",
)
@corners_option
@click.option("--json", "as_json", is_flag=True, help="Print all numbers as JSON.")
@config_option
@workers_options
def command(
    rig: Path,
    truth: Path | None,
    recording: Path | None,
    clouds: Path | None,
    corners: Path | None,
    as_json: bool,
    config: Path | None,
    workers: Workers,
) -> None:
    """Evaluate RIG against the truth of a simulation, or against a recording of the board or of any scene.

    Alignment is the distance between the places where two cameras put the same point, each by its own pixel and depth.
    Against the truth it is measured without noise on a grid over the volume where the board was; against a recording, on
    the corners that two cameras saw, by the depth they measured, with its noise.

    --clouds needs no board: the distance between the clouds of two cameras, point to plane, on surfaces that face both, with
    and without the share that the noise of depth has in it. Errors along a surface do not show in it.

    \b
    Examples:
      rgbd-calib evaluate rig.yaml --truth demo/truth.yaml
      rgbd-calib evaluate rig.yaml --recording demo/extrinsic
      rgbd-calib evaluate rig.yaml --truth demo/truth.yaml --json
      rgbd-calib evaluate rig.yaml --clouds empty
    """
    if sum(source is not None for source in (truth, recording, clouds)) != 1:
        raise click.UsageError("give one of --truth FILE, --recording RECORDING and --clouds RECORDING")
    from rgbd_calib.io.plain import to_json
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.evaluate import evaluate_recording, evaluate_truth

    if clouds is not None:
        from rgbd_calib.pipeline.clouds import evaluate_clouds

        _tell_clouds(evaluate_clouds(rig, clouds), as_json)
        return
    if truth is not None:
        summary = evaluate_truth(rig, truth)
    else:
        assert recording is not None
        summary = evaluate_recording(rig, recording, corners, load_config(config), workers, progress)
    if as_json:
        show(to_json(summary, indent=2))
        return
    for name, error in (summary.poses or {}).items():
        show(
            f"{name}: rotation {error.rotation_deg:.4f}°, translation {error.translation_mm:.3f} mm "
            f"({100 * error.relative_translation:.3f} %)"
        )
    for name, numbers in (*summary.by_distance.items(), *summary.pairs.items(), ("alignment", summary.all)):
        show(f"{name}: {_line(numbers)}")


def _tell_clouds(summary: CloudAlignment, as_json: bool) -> None:
    from rgbd_calib.io.plain import to_json

    if as_json:
        show(to_json(summary, indent=2))
        return
    for name, own in (*summary.pairs.items(), ("all pairs", summary.all)):
        error = f"{own.error_mm:.2f} mm RMS without noise, " if own.error_mm is not None else ""
        show(
            f"{name}: {error}{own.rms_mm:.2f} mm RMS and {own.median_mm:.2f} mm in the median with it; {own.patches} patches, "
            f"{100 * own.overlap_share:.0f} % of the surfaces in common"
        )
    if summary.without_overlap:
        show(f"no surfaces in common: {', '.join(summary.without_overlap)}")


def _line(own: AlignmentNumbers) -> str:
    parts = []
    if own.mean_mm is not None:
        stated = f" ({own.expected_mm:.3f} mm as stated)" if own.expected_mm is not None else ""
        parts.append(
            f"mean {own.mean_mm:.3f} mm{stated}, median {own.median_mm:.3f} mm, 95 % below {own.p95_mm:.3f} mm"
        )
    if own.median_px is not None:
        parts.append(f"transfer {own.median_px:.3f} px in the median")
    return "; ".join([*parts, f"{own.points} points"])
