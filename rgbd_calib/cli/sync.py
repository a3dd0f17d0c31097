"""`rgbd-calib sync`: the clocks of free-running cameras, and recordings on one clock."""

from __future__ import annotations

from dataclasses import asdict
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
    from rgbd_calib.types import Clock


@click.command()
@recording_argument
@output_option("timing.yaml, or with --apply the folder of the new recording")
@click.option(
    "--rig", type=click.Path(path_type=Path), help="The rig that recorded: its poses and intrinsics are kept."
)
@click.option(
    "--apply",
    "timing",
    type=click.Path(path_type=Path),
    metavar="TIMING",
    help="Put RECORDING on one clock by this timing.yaml, or by a rig file with clocks.",
)
@corners_option
@config_option
@workers_options
@overwrite_option
@json_option
def command(
    recording: Path,
    output: Path,
    rig: Path | None,
    timing: Path | None,
    corners: Path | None,
    config: Path | None,
    workers: Workers,
    overwrite: bool,
) -> None:
    """Estimate the clock of each camera of RECORDING, in which a board is carried, from a rig that is known.

    A few seconds of a board that turns before two cameras at a time are enough. The clocks' offsets may be minutes. Where the
    board stands still or moves along one axis without turning, no offset can be determined, and the command says so.

    With --apply, write a recording whose timestamps are on the reference's clock, and whose frame sets are the nearest in time.
    Its images are links, not copies. Column apart_us of its timestamps.csv is the remaining time difference.

    \b
    Examples:
      rgbd-calib sync monday --rig rig.yaml -o timing.yaml
      rgbd-calib sync monday --apply timing.yaml -o monday_synchronous
    """
    if (rig is None) == (timing is None):
        raise click.UsageError("either --rig RIG, to estimate the clocks, or --apply TIMING, to use them")
    refuse_existing(output, overwrite, folder=timing is not None)
    from rgbd_calib.io.recording import open_recording

    opened = open_recording(recording)
    if timing is not None:
        import numpy as np

        from rgbd_calib.io.linked_recording import write_linked
        from rgbd_calib.io.rig import read_timing
        from rgbd_calib.pipeline.sync import nearest_sets

        reference, clocks = read_timing(timing)
        sets = nearest_sets(opened, clocks, reference)
        write_linked(output, opened, [(own.t_s, own.frames) for own in sets], overwrite)
        apart = np.array([t - own.t_s for own in sets for c, (_, t, _) in own.frames.items() if c != reference])
        worst = 1e3 * float(np.abs(apart).max())
        show(f"{len(sets)} sets; frames {1e3 * np.sqrt(np.mean(apart**2)):.1f} ms apart (RMS), {worst:.1f} ms at most")
        show(f"Motion of 1 m/s is off by up to {worst:.0f} mm in them")
        say(f"Wrote {output}")
        rms = 1e3 * float(np.sqrt(np.mean(apart**2)))
        give({"output": str(output), "sets": len(sets), "apart_rms_ms": rms, "apart_worst_ms": worst})
        return
    assert rig is not None
    from rgbd_calib.io.rig import read_rig, write_timing
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.provenance import provenance_of
    from rgbd_calib.pipeline.sync import sync
    from rgbd_calib.quality import Quality

    settings, known = load_config(config), read_rig(rig)
    found = detections_from(opened, corners, settings.detect, workers, progress)
    result = sync(opened, known, found, settings)
    left_out = {f"{camera} {frame}": why for (camera, frame), why in result.left_out.items()}
    quality = Quality(message=result.message, views_used=result.views, left_out=left_out)
    provenance = {**provenance_of(settings), "recording": str(recording), "rig": str(rig)}
    write_timing(output, result.reference, result.clocks, quality, provenance)
    for remark in result.remarks:
        say(f"Warning: {remark}")
    for name, clock in result.clocks.items():
        show(clock_line(name, clock, result.reference))
    say(f"Views used: {', '.join(f'{c} {n}' for c, n in result.views.items())}; {len(result.left_out)} left out")
    say(f"Wrote {output}")
    give(
        {
            "output": str(output),
            "reference": result.reference,
            "clocks": {name: asdict(clock) for name, clock in result.clocks.items()},
            "remarks": list(result.remarks),
            "message": result.message,
            "views_used": result.views,
            "left_out": left_out,
        }
    )


def clock_line(name: str, clock: Clock, reference: str) -> str:
    """A camera's clock in words."""
    offset = f"offset {clock.offset_s:+.6f} s ± {1e3 * clock.offset_sd_s:.3f} ms"
    drift = f"drift {clock.drift_ppm:+.1f} ± {clock.drift_sd_ppm:.1f} ppm"
    text = f"{name}: clock: " + ("reference" if name == reference else f"{offset}, {drift}")
    if clock.depth_delay_sd_s > 0:
        text += f", depth {1e3 * clock.depth_delay_s:+.3f} ± {1e3 * clock.depth_delay_sd_s:.3f} ms after colour"
    return text + (f", readout {1e3 * clock.readout_s:.1f} ms" if clock.readout_s else "")
