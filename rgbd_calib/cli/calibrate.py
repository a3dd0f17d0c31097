"""`rgbd-calib calibrate`: from a recording to a rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    OUTPUT,
    config_option,
    corners_option,
    give,
    json_option,
    lens_option,
    method_options,
    output_option,
    overwrite_option,
    progress,
    recording_argument,
    refuse_existing,
    say,
    show,
    workers_options,
)
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers
    from rgbd_calib.types import Rig


@click.command()
@recording_argument
@output_option("rig.yaml (with --update: that file, if --overwrite is given)", required=False)
@click.option(
    "--start",
    type=click.Choice(("given", "bundle")),
    help="Of a method other than bundle: lenses, depth, board and first poses as given, or as the bundle finds them.  [default: given]",
)
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    help="intrinsics.yaml, or a recording of the board close to each camera.  [default: dataset.yaml's, else from RECORDING]",
)
@click.option(
    "--depth-bias",
    type=click.Path(path_type=Path),
    help="depth_bias.yaml, or a recording of a wall at known distances.  [default: none]",
)
@corners_option
@lens_option
@method_options(("init", "ba", "icp", "baicp+", "biobjective", "bundle"))
@click.option(
    "--correspondences",
    type=OUTPUT,
    help="Write the matched features too, for `rgbd-calib refine`.",
)
@click.option(
    "--world",
    metavar="WORLD",
    help="board:FRAME, floor, or a camera.  [default: the reference camera]",
)
@click.option("--update", type=OUTPUT, help="A rig file to change, with --only or --world.")
@click.option("--only", metavar="CAMERA", help="With --update: pose this camera anew, or add it; the others stay.")
@click.option(
    "--snapshot",
    type=click.Path(path_type=Path),
    help="A recording of the empty scene: what `verify` needs of it is kept in the folder RIG.snapshot. With --update: the one "
    "that is as old as that rig; cameras that moved since are corrected by RECORDING, without a board.",
)
@click.option("--report", type=OUTPUT, help="Folder for a report, index.html: whether to trust the rig.")
@click.option(
    "--strict",
    is_flag=True,
    help="Exit with status 1 if the self-checks fail. The rig is written all the same.",
)
@click.option(
    "--max-views",
    type=click.IntRange(3),
    metavar="N",
    help="Frames of the board to use at most (the most informative); what the others would add is said.  [default: all]",
)
@json_option
@config_option
@workers_options
@overwrite_option
def command(
    recording: Path,
    output: Path | None,
    intrinsics: Path | None,
    depth_bias: Path | None,
    corners: Path | None,
    lens: str | None,
    method: str | None,
    start: str | None,
    sigma_2d: float | None,
    sigma_3d: float | None,
    reference: str | None,
    seed: int | None,
    correspondences: Path | None,
    world: str | None,
    update: Path | None,
    only: str | None,
    snapshot: Path | None,
    report: Path | None,
    strict: bool,
    max_views: int | None,
    config: Path | None,
    workers: Workers,
    overwrite: bool,
) -> None:
    """Calibrate the rig of RECORDING: poses, and with the default method intrinsics and depth bias too.

    \b
    Methods:
      bundle       the default: poses, boards, intrinsics and depth bias together, on pixels and depth
      biobjective  the paper's: poses and free points, V_ICP + w V_BA, w estimated unless both sigmas are given
      ba, icp      pixels alone, measured 3D points alone
      baicp+       the heuristic weight of the paper's predecessor
      init         the first poses, without refinement

    All but bundle take lenses, depth and board as exact: as they are given, or, with --start bundle, as that finds them.

    \b
    Worlds (--world; covariances stay those of each camera against the reference, in the new axes):
      CAMERA       that camera's frame, as --reference: x right, y down, z forward
      board:FRAME  the board's frame in that frame: x along its columns, y along its rows, z into it
      floor        the largest plane below the cameras: z up, the origin on it below the reference camera,
                   x where that camera looks, seen from above

    Every result is tested against what its own covariance allows: the residuals over image, range, time and cameras, and the
    result without parts of the recording. Where they disagree the verdict is "Do not trust this", with the reason, on
    stderr, in the rig file (quality.self_check) and in the report. The rig is written nevertheless, to be looked at;
    --strict then exits with 1.

    A recording with `synchronous: false` in dataset.yaml is of cameras that run free, before which the board is carried: the
    clock of each camera is estimated with the rig, from the frames' timestamps, and is in the rig file (clock).

    With --update nothing else is calibrated: --only CAMERA poses one camera against the others of the rig, by views that it
    shares with them, with the lens and depth bias that the rig has (or --intrinsics, --depth-bias); a camera that the rig
    lacks is calibrated whole and added. All other entries stay as they are, byte for byte. --snapshot OLD corrects the cameras that moved since that snapshot of the empty
    scene, by another one, and is refused where the scene does not determine a motion. --world moves the whole rig.

    \b
    Examples:
      rgbd-calib calibrate demo/extrinsic -o rig.yaml
      rgbd-calib calibrate demo/extrinsic --intrinsics demo/intrinsic --depth-bias demo/depth_bias -o full.yaml
      rgbd-calib calibrate demo/extrinsic --intrinsics intrinsics.yaml --method biobjective -o paper.yaml
      rgbd-calib calibrate demo/extrinsic --method biobjective --start bundle -o paper2.yaml
      rgbd-calib calibrate demo/extrinsic --world floor -o on_floor.yaml
      rgbd-calib calibrate monday --update rig.yaml --only C3 -o rig2.yaml
      rgbd-calib calibrate monday --update rig.yaml --snapshot friday -o rig3.yaml
      rgbd-calib calibrate monday --update rig.yaml --world board:000004 -o rig4.yaml
    """
    output = output or update
    if output is None:
        raise click.UsageError("-o FILE is needed: where to write the rig")
    if update is not None:
        from rgbd_calib.cli import updating

        if strict:
            raise click.UsageError("--strict goes without --update; `rgbd-calib verify` tells whether a rig holds")
        if report is not None:
            raise click.UsageError(
                "--report goes without --update; afterwards `rgbd-calib report RIG -o DIR` writes it"
            )
        if lens is not None:
            raise click.UsageError("--lens goes without --update, which keeps the lenses of the rig or of --intrinsics")
        if max_views is not None:
            raise click.UsageError("--max-views goes without --update, which needs all views of one camera")
        refuse_existing(output, overwrite)
        updating.update(
            recording, update, output, only, world, snapshot, intrinsics, depth_bias, corners, config, seed, workers
        )
        return
    if only is not None:
        raise click.UsageError("--only CAMERA goes with --update RIG")
    from rgbd_calib.io.files import whole_folder
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.snapshot import keep_snapshot, kept_beside

    left = output.with_name(f"{output.stem}.residuals.csv")
    kept = kept_beside(output)
    if snapshot is not None:
        refuse_existing(kept, overwrite, folder=True)
        empty = open_recording(snapshot)
    page = report / "index.html" if report else None
    for path in filter(None, (output, left, correspondences, page)):
        refuse_existing(path, overwrite)
    from rgbd_calib import api
    from rgbd_calib.io.correspondences import write_correspondences
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.summary import block, course, numbers_of, truth_beside

    opened = open_recording(recording)
    if world in opened.cameras and reference not in (None, world):
        raise click.UsageError(f"--world {world} and --reference {reference}: one camera only can be the world")
    settings = load_config(config, method=method, start=start)
    if settings.method == "bundle" and not (sigma_2d is None and sigma_3d is None):
        raise ConfigError(
            "--sigma-2d, --sigma-3d: given with method bundle, which estimates the noise itself. "
            "Leave them out, or choose another --method"
        )
    if settings.method == "bundle" and settings.start == "bundle":
        raise ConfigError(
            "--start bundle: a method that starts from the bundle expected, bundle found. Leave it out, or choose another --method"
        )
    result = api.calibrate(
        opened,
        intrinsics=intrinsics,
        depth_bias=depth_bias,
        reference=reference,
        world=world,
        corners=corners,
        config=settings,
        seed=seed,
        max_views=max_views,
        workers=workers,
        progress=progress,
        intrinsics__lens=lens,
        refinement__sigma_2d_px=sigma_2d,
        refinement__sigma_3d_m=sigma_3d,
    )
    result.rig.save(output)
    if correspondences:
        write_correspondences(correspondences, result.calibration.correspondences)
    for line in course(result.rig.quality):
        say(line)
    for line in clock_lines(result.rig):
        show(line)
    verdict, truth = result.verdict, truth_beside(opened, result.rig)
    say(f"Wrote {output}, and the per-corner residuals to {left}")
    if snapshot is not None:
        with whole_folder(kept, overwrite) as folder:
            size = keep_snapshot(folder, empty)
        say(f"Kept the snapshot in {kept}, {size / 1e6:.1f} MB: `rgbd-calib verify {output} NEW` compares with it")
    if report is not None:
        say(f"Report: {result.report(report, title=output.name)}")
    rows, lines = block(result.rig, verdict, result.rig.residuals, truth)
    for row in rows:
        show(row)
    for line in lines:
        say(line, always=verdict.level in ("poor", "untrusted"))
    give(numbers_of(result.rig, verdict, truth))
    if strict and verdict.level == "untrusted":
        click.get_current_context().exit(1)


def clock_lines(rig: Rig) -> list[str]:
    """The clock of each camera that has one."""
    from rgbd_calib.cli.sync import clock_line

    return [clock_line(c, own.clock, rig.reference) for c, own in rig.cameras.items() if own.clock is not None]
