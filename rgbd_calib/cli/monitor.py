"""`rgbd-calib monitor`: watch a rig over days."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import OUTPUT, Number, driver_option, redist_option, refuse_existing, say, show
from rgbd_calib.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from rgbd_calib.io.recording import Recording
    from rgbd_calib.pipeline.monitor import MonitorRound
    from rgbd_calib.types import CameraSnapshot, Rig


@click.command()
@click.argument("rig_path", metavar="RIG", type=click.Path(path_type=Path))
@click.argument("folder", metavar="[FOLDER]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--snapshot",
    type=click.Path(path_type=Path),
    help="The recording of the empty scene that is as old as RIG.  [default: RIG.snapshot]",
)
@click.option("--every", type=Number(0), default=60.0, show_default=True, help="Seconds from round to round.")
@click.option("--rounds", type=click.IntRange(1), help="End after so many rounds.  [default: never]")
@click.option(
    "--confirm",
    type=click.IntRange(1),
    default=3,
    show_default=True,
    help="Rounds in a row that must find a camera moved before it is drift.",
)
@click.option(
    "--max-mm", type=Number(0, 1000, min_open=True), default=3.0, show_default=True, help="Displacement allowed."
)
@click.option(
    "--distance",
    type=Number(0.3, 20),
    default=2.0,
    show_default=True,
    metavar="M",
    help="Working distance at which displacements are stated.",
)
@click.option(
    "--frames", type=click.IntRange(1, 100), default=10, show_default=True, help="Depth is the mean of so many."
)
@click.option(
    "--on-drift",
    metavar="COMMAND",
    help="Run this program, without a shell, when drift begins, and go on; it gets the line of JSON on standard input.  "
    "[default: exit with status 1]",
)
@click.option("--metrics", type=OUTPUT, help="Write this file in Prometheus' text format after each round.")
@click.option("--json", "as_json", is_flag=True, help="A line of JSON for each round.")
@click.option(
    "--device", "devices", multiple=True, metavar="ID=SERIAL", help="Use this camera (repeat).  [default: all]"
)
@driver_option
@redist_option
def command(
    rig_path: Path,
    folder: Path | None,
    snapshot: Path | None,
    every: float,
    rounds: int | None,
    confirm: int,
    max_mm: float,
    distance: float,
    frames: int,
    on_drift: str | None,
    metrics: Path | None,
    as_json: bool,
    devices: tuple[str, ...],
    drivers: tuple[str, ...],
    redist: Path | None,
) -> int:
    """Compare the cameras of RIG with their old snapshot again and again, and tell when one drifts.

    The new images are the newest of FOLDER, a recording that another program fills; without FOLDER they are taken from
    the cameras, which are opened for each round and closed again, so that other programs can use them in between.

    A line for each round on standard output. A round without a comparison (a camera in use, no new images) is reported and
    counted, and the next one follows. Ctrl-C stops cleanly.

    \b
    Exit status:
      0  stopped, or --rounds done, without drift
      1  drift, or no round gave a comparison

    \b
    Examples:
      rgbd-calib monitor rig.yaml --snapshot friday --every 60
      rgbd-calib monitor rig.yaml /data/live --json --metrics /var/lib/node_exporter/rig.prom
      rgbd-calib monitor rig.yaml --on-drift "systemctl stop fusion"
    """
    if folder is not None and (drivers or devices or redist):
        raise click.UsageError("FOLDER goes without --driver, --device and --redist: one source of images")
    import shlex
    import threading

    from rgbd_calib.capture.signals import stopping_on_signals
    from rgbd_calib.io.files import write_text
    from rgbd_calib.io.plain import to_json
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.io.snapshot import kept_beside
    from rgbd_calib.pipeline import monitor
    from rgbd_calib.pipeline.snapshot import prepare
    from rgbd_calib.trust.displacement import VerdictParams
    from rgbd_calib.trust.snapshot import SnapshotParams

    program = shlex.split(on_drift) if on_drift else []
    if on_drift is not None and not program:
        raise click.UsageError("--on-drift: a command expected, nothing found")
    if metrics is not None:
        refuse_existing(metrics, overwrite=True)
        monitor.refuse_foreign(metrics)
    rig, old = read_rig(rig_path), open_recording(snapshot or kept_beside(rig_path))
    if folder is not None and folder.exists() and os.path.samefile(folder, old.path):
        say(f"{folder}: is the old snapshot itself, which any rig passes")
    before = prepare(rig, old)
    if not before:
        raise ConfigError(f"{old.path}: no camera has colour and depth images; a snapshot needs both. Record it again")
    source = _from_cameras(rig, old, drivers, redist, devices, frames)
    if folder is not None:
        source = monitor.FolderSource(folder, tuple(before), frames)
    params = monitor.MonitorParams(
        every, confirm, rounds, SnapshotParams(distance, VerdictParams(max_m=max_mm / 1e3))
    )  # fmt: skip
    stop, failures, drifting, each = threading.Event(), 0, False, None
    with stopping_on_signals(stop):
        for each in monitor.watch(rig, before, source, params, stop.wait):
            failures += each.verdict is None
            line = to_json(each.line())
            show(line if as_json else _told(each))
            if metrics is not None:
                write_text(metrics, monitor.metrics(each, failures))
            if each.drift and not drifting:
                if not program:
                    return 1
                _run(program, line)
            drifting = each.drift
    if each is not None and failures == each.number:
        raise CalibrationError(
            f"none of {failures} round(s) gave a comparison; the last: {each.problem}. Fix this and run again"
        )
    return int(drifting)


def _told(each: MonitorRound) -> str:
    from rgbd_calib.pipeline.snapshot import sentence

    if each.verdict is None:
        return f"{each.time} failed: {each.problem}"
    cameras = ", ".join(
        f"{name} {1e3 * own.displacement_m:.2f} ± {1e3 * own.displacement_sd_m:.2f} mm"
        for name, own in each.verdict.cameras.items()
    )
    return f"{each.time} {'DRIFT' if each.drift else each.status}: {cameras or sentence(each.verdict)}"


def _run(program: list[str], line: str) -> None:
    """Run the command of --on-drift to its end; what it prints goes to standard error."""
    import subprocess

    try:
        ended = subprocess.run(program, input=line.encode(), stdout=2, timeout=600, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        say(f"--on-drift: {error}")
        return
    if ended.returncode:
        say(f"--on-drift: {program[0]} ended with status {ended.returncode}")


def _from_cameras(
    rig: Rig, old: Recording, drivers: tuple[str, ...], redist: Path | None, devices: tuple[str, ...], frames: int
) -> Callable[[], Mapping[str, CameraSnapshot] | None]:
    from rgbd_calib.sensors.identity import parse_devices

    known = {name: info.serial for name, info in old.cameras.items() if info.serial and name in rig.cameras}
    wanted = parse_devices(devices)

    def take() -> Mapping[str, CameraSnapshot]:
        from rgbd_calib.capture.still_scene import take_snapshots

        return take_snapshots(drivers, redist, wanted, known, frames)

    return take
