"""What is attached, what each device can do, and what stands in the way of recording with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.sensors.driver import Drivers
from rgbd_calib.sensors.identity import Identity, assign_cameras
from rgbd_calib.sensors.usb import crowded_controllers, forbidden_node, usb_place

ADVICE_NO_DEVICE = (
    "no camera is attached, or none may be opened. Look at `lsusb` for 1d27 (Xtion), 8086 (RealSense), 045e:097d (Azure "
    "Kinect), 2bc5 (Orbbec). Not there: cable, power, another port. There: udev rules need a replug, and USB 3 ports refuse "
    "Xtions with old firmware"
)


@dataclass(frozen=True)
class FoundDevice:
    """One attached device; `problem` says why it cannot be used."""

    identity: Identity
    name: str = ""
    vendor: str = ""
    firmware: str | None = None
    controller: str | None = None
    modes: tuple[str, ...] = ()
    problem: str | None = None


@dataclass(frozen=True)
class AttachedDevices:
    """All attached devices and what is wrong with how they are attached."""

    devices: tuple[FoundDevice, ...]
    warnings: tuple[str, ...]
    missing: tuple[str, ...] = ()
    """Why drivers could not be loaded."""

    @property
    def advice(self) -> str:
        """What to do where there is no device."""
        return "\n".join([ADVICE_NO_DEVICE, *self.missing])

    def assign(self, wanted: Mapping[str, str], known: Mapping[str, str] | None = None) -> dict[str, Identity]:
        """{camera id: device} to record with; see :func:`assign_cameras`.

        Raises
        ------
        ConfigError
            Nothing is attached, or a wanted device is not.
        CalibrationError
            A device that is to be used does not open.
        """
        if not self.devices:
            raise ConfigError(self.advice)
        cameras = assign_cameras([d.identity for d in self.devices], wanted, known)
        for device in self.devices:
            if device.problem and device.identity in cameras.values():
                others = "" if wanted else ". To record without it, name the others with --device"
                raise CalibrationError(device.problem + others)
        return cameras


def find_cameras(runtime: Drivers) -> AttachedDevices:
    """Open each attached device once, ask it who it is, and close it."""
    devices = tuple(_ask(runtime, uri) for uri in runtime.uris())
    warnings = [
        f"{device.identity.uri}: reports no serial number; it is known by its USB port {device.identity.usb_path}, so keep it "
        "in that port"
        for device in devices
        if device.identity.serial is None and not device.problem
    ]
    places = {device.identity.key: usb_place(device.identity.uri) for device in devices}
    for controller, names in crowded_controllers(places).items():
        warnings.append(
            f"{', '.join(names)} share the USB controller {controller}; one camera fills most of it. Move all but one to "
            "other controllers (`lsusb -t`), or expect missing frames"
        )
    return AttachedDevices(devices, tuple(warnings), runtime.missing)


def _ask(runtime: Drivers, uri: str) -> FoundDevice:
    place = usb_place(uri)
    port = place.path if place else uri
    try:
        device = runtime.open(uri)
    except CalibrationError as error:
        node = forbidden_node(uri)
        problem = f"{uri}: no permission for {node}. {runtime.permission(uri)}, then replug it" if node else str(error)
        return FoundDevice(Identity(uri, None, port), problem=problem)
    try:
        return FoundDevice(
            Identity(uri, device.serial, device.usb_path),
            device.name,
            device.vendor,
            device.firmware,
            place.controller if place else None,
            tuple(device.modes()),
        )
    finally:
        device.close()
