"""`rgbd-calib devices`: what is attached, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import redist_option, say, show


@click.command()
@redist_option
@click.option("--json", "as_json", is_flag=True, help="As JSON, for programs.")
def command(redist: Path | None, as_json: bool) -> None:
    """List the cameras that OpenNI2 sees.

    For each: its id in `capture`, uri, serial number, USB port, firmware and video modes. Problems, and what to do
    about them, go to stderr; the exit status is 1 where a camera cannot be used, and 2 where there is no runtime or
    no camera.
    """
    from rgbd_calib.errors import CalibrationError, ConfigError
    from rgbd_calib.sensors.discover import ADVICE_NO_DEVICE, find_cameras
    from rgbd_calib.sensors.identity import assign_cameras
    from rgbd_calib.sensors.openni2 import load_runtime

    runtime = load_runtime(redist)
    try:
        found = find_cameras(runtime)
        runtime_version = runtime.version
    finally:
        runtime.close()
    names = {identity: camera for camera, identity in assign_cameras([d.identity for d in found.devices], {}).items()}
    rows = sorted(((names[device.identity], device) for device in found.devices), key=lambda row: row[0])
    if as_json:
        from dataclasses import asdict

        from rgbd_calib.io.plain import to_json

        show(to_json([{"camera": camera, **asdict(device)} for camera, device in rows], indent=1))
    else:
        for camera, device in rows:
            identity = device.identity
            show(f"{camera}  {identity.uri}  {device.vendor} {device.name}".rstrip())
            if not device.problem:
                show(
                    f"    serial {identity.serial or 'none'}, USB {identity.usb_path}, firmware {device.firmware or '?'}"
                )
                show(f"    {', '.join(device.modes)}")
    for warning in found.warnings:
        say(f"Warning: {warning}")
    problems = [device.problem for device in found.devices if device.problem]
    if not found.devices:
        raise ConfigError(f"OpenNI2 {runtime_version} in {runtime.folder}: {ADVICE_NO_DEVICE}")
    if problems:
        raise CalibrationError("\n".join(problems))
