"""`rgbd-calib devices`: what is attached, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import driver_option, redist_option, say, show


@click.command()
@driver_option
@redist_option
@click.option("--json", "as_json", is_flag=True, help="As JSON, for programs.")
def command(drivers: tuple[str, ...], redist: Path | None, as_json: bool) -> None:
    """List the cameras that are attached: OpenNI2 (Xtion, Kinect), RealSense, Azure Kinect, Orbbec.

    For each: its id in `capture`, uri, serial number, USB port, firmware and video modes. Problems, and what to do
    about them, go to stderr; the exit status is 1 where a camera cannot be used, and 2 where there is no runtime or
    no camera.
    """
    from rgbd_calib.errors import CalibrationError, ConfigError
    from rgbd_calib.sensors.discover import find_cameras
    from rgbd_calib.sensors.driver import load_drivers
    from rgbd_calib.sensors.identity import assign_cameras

    runtime = load_drivers(drivers, redist)
    try:
        found = find_cameras(runtime)
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
        raise ConfigError(f"{runtime.label}: {found.advice}")
    if problems:
        raise CalibrationError("\n".join(problems))
