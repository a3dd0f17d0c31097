"""`rgbd-calib board-shape`: the board as a calibration found it, for the next recordings."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import output_option, overwrite_option, refuse_existing, say, show
from rgbd_calib.errors import ConfigError


@click.command
@click.argument("rig_path", metavar="RIG", type=click.Path(path_type=Path))
@output_option("the board, .yaml, for --board; else it goes to stdout", required=False)
@overwrite_option
def command(rig_path: Path, output: Path | None, overwrite: bool) -> None:
    """Give the board of RIG back as the bundle found it: `board:` with `shape:`.

    Printers stretch, paper creeps, plates bend. Where each corner truly is, front and back, is solved with the rig; a dataset
    that is given it starts from there. Put it in the place of `board:` in dataset.yaml, or give the file, or RIG itself, as
    --board.

    \b
    Examples:
      rgbd-calib board-shape rig1/rig.yaml -o board.yaml
      rgbd-calib capture rig2/extrinsic --board board.yaml --on-still
    """
    if output is not None:
        refuse_existing(output, overwrite, inputs=[rig_path])

    import numpy as np

    from rgbd_calib.io.board_files import read_board
    from rgbd_calib.io.files import dump_yaml, write_text
    from rgbd_calib.io.schema_parts import BoardModel

    board = read_board(rig_path)
    if board.shape is None:
        raise ConfigError(
            f"{rig_path}: no shape of the board is in it, which the bundle alone finds. Calibrate with --method bundle first"
        )
    text = dump_yaml({"board": BoardModel.of(board).model_dump(exclude_none=True)})
    for face, sd_m in (("front", board.shape.front_sd_m), ("back", board.shape.back_sd_m)):
        if sd_m is not None:
            say(f"{face}: corners known to {1e3 * float(np.sqrt(np.mean(sd_m**2))):.3f} mm (one sigma, each axis)")
    if output is None:
        show(text.rstrip())
    else:
        write_text(output, text)
        say(f"{output}: written")
