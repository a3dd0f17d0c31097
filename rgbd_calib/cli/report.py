"""`rgbd-calib report`: a rig as a page for people."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import OUTPUT, overwrite_option, refuse_existing, say


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
@click.option("-o", "--output", type=OUTPUT, required=True, help="Folder for index.html.")
@overwrite_option
def command(rig: Path, recording: Path | None, depth_bias: Path | None, output: Path, overwrite: bool) -> None:
    """Write one HTML file that says whether to trust RIG, and why.

    The file needs no network and no other file. Residuals are read from RIG.residuals.csv, which `calibrate` writes
    beside RIG.yaml; what is missing is named in the report, with how to get it.

    \b
    Examples:
      rgbd-calib report rig.yaml -o report
      rgbd-calib report rig.yaml --recording demo/extrinsic -o report_with_clouds
    """
    refuse_existing(output / "index.html", overwrite)
    from rgbd_calib.pipeline.report import report_of_file

    say(f"Wrote {report_of_file(rig, recording, depth_bias, output)}")
