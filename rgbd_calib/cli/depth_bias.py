"""`rgbd-calib depth-bias`: the systematic error of each depth sensor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    config_option,
    corners_option,
    give,
    json_option,
    output_option,
    overwrite_option,
    progress,
    recording_argument,
    refuse_existing,
    say,
    show,
    workers_options,
)

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


@click.command()
@recording_argument
@output_option("depth_bias.yaml")
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    help="intrinsics.yaml, or any rig file. Needed where the true distances come from the board.",
)
@corners_option
@config_option
@workers_options
@overwrite_option
@json_option
def command(
    recording: Path,
    output: Path,
    intrinsics: Path | None,
    corners: Path | None,
    config: Path | None,
    workers: Workers,
    overwrite: bool,
) -> None:
    """Fit each camera's depth bias, z_true = z + c0 + c1 z + c2 z^2 ..., from RECORDING.

    The true distances are those of distances.csv (a wall square to the camera); without it, they come from the board's
    pose by pixels, for which --intrinsics is needed.

    \b
    Examples:
      rgbd-calib depth-bias demo/depth_bias -o depth_bias.yaml
      rgbd-calib depth-bias demo/extrinsic --intrinsics intrinsics.yaml -o by_board.yaml
    """
    refuse_existing(output, overwrite)
    import numpy as np

    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_intrinsics, write_depth_bias
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.prepare import depth_of_recording, samples_of
    from rgbd_calib.pipeline.provenance import provenance_of

    opened, settings = split(open_recording(recording)), load_config(config)
    lenses = read_intrinsics(intrinsics) if intrinsics else {}
    found = detections_from(opened, corners, settings.detect, workers, progress) if corners else None
    fits, _ = depth_of_recording(opened, lenses, settings, found, workers, progress)
    mounts = {name: info.mount.camera for name, info in opened.cameras.items() if info.mount is not None}
    fits = {mounts.get(name, name): fit for name, fit in fits.items()}
    statistics = {name: {"samples": samples_of(fit)} for name, fit in fits.items()}
    provenance = {**provenance_of(settings), "recording": str(recording), "recording_sha256": opened.digest()}
    write_depth_bias(output, {name: fit.bias for name, fit in fits.items()}, statistics, {}, provenance)
    for name, fit in fits.items():
        bias = fit.bias
        at = np.linspace(bias.min_m, bias.max_m, 3)
        curve = ", ".join(
            f"{1e3 * (bias.correct(z) - z):+.1f} ± {1e3 * bias.standard_error(z):.1f} mm at {z:.2f} m" for z in at
        )
        show(
            f"{name}: order {len(bias.coefficients) - 1}, correction {curve}; RMS {1e3 * bias.rms_m:.2f} mm over "
            f"{len(fit.z_m) - int(fit.dropped.sum())} distances"
        )
        if fit.dropped.any():
            say(f"{name}: {int(fit.dropped.sum())} distance(s) left out, too far from the curve")
    say(f"Wrote {output}")
    give(
        {
            "output": str(output),
            "cameras": {
                name: {
                    "coefficients": fit.bias.coefficients,
                    "min_m": fit.bias.min_m,
                    "max_m": fit.bias.max_m,
                    "rms_mm": 1e3 * fit.bias.rms_m,
                    "distances": len(fit.z_m) - int(fit.dropped.sum()),
                    "left_out": int(fit.dropped.sum()),
                }
                for name, fit in fits.items()
            },
        }
    )
