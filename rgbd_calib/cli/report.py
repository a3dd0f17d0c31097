"""`rgbd-calib report`: a rig as a page for people."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import OUTPUT, give, json_option, overwrite_option, refuse_existing, say, show


@click.command
@click.argument("rig", type=click.Path(path_type=Path))
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="Recording for the clouds before and after.  [default: the one that the rig file names]",
)
@click.option(
    "--depth-bias",
    type=click.Path(path_type=Path),
    help="depth_bias.yaml with the data behind the curves.  [default: those kept in the rig file]",
)
@click.option(
    "--compare",
    "other",
    type=click.Path(path_type=Path),
    help="Another rig of the same cameras: what moved since RIG, what changed, which is better.",
)
@click.option("-o", "--output", type=OUTPUT, required=True, help="Folder for index.html.")
@overwrite_option
@json_option
def command(
    rig: Path, recording: Path | None, depth_bias: Path | None, other: Path | None, output: Path, overwrite: bool
) -> None:
    """Write one HTML file that says whether to trust RIG, and why.

    The file needs no network and no other file. Residuals are read from RIG.residuals.csv, which `calibrate` writes
    beside RIG.yaml; what is missing is named in the report, with how to get it.

    With --compare the page shows RIG and OTHER side by side. Motions are relative to one camera, with the deviations of
    both rigs; they are not tested where the rigs share images, whose errors are correlated.

    \b
    Examples:
      rgbd-calib report rig.yaml -o report
      rgbd-calib report rig.yaml --recording demo/extrinsic -o report_with_clouds
      rgbd-calib report demo/rig.yaml --compare rig.yaml -o what_moved
    """
    refuse_existing(output / "index.html", overwrite)
    if other is not None and (recording is not None or depth_bias is not None):
        raise click.UsageError(
            "--compare shows rigs alone: --recording and --depth-bias do not go with it. Leave them out"
        )
    from rgbd_calib.pipeline.report import comparison_of_files, report_of_file, verdict_of_file
    from rgbd_calib.pipeline.summary import numbers_of
    from rgbd_calib.report import compare_page

    if other is None:
        say(f"Wrote {report_of_file(rig, recording, depth_bias, output)}")
        give(numbers_of(*verdict_of_file(rig), None))
        return
    page, found = comparison_of_files(rig, other, output)
    say(f"Wrote {page}")
    show(found.sentence)
    for own in found.motions:
        show(f"{own.camera}: {own}")
    if found.untested:
        say(found.untested)
    give(compare_page.numbers_of(found))
