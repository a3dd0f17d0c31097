"""Where a device hangs on the USB, by Linux's sysfs: its port outlives replugging, its address does not."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

SYSFS = Path("/sys/bus/usb/devices")
_ADDRESS = re.compile(r"@(\d+)/(\d+)$")


@dataclass(frozen=True)
class UsbDevice:
    """A device as the kernel lists it; nothing is opened, and no permission is needed."""

    serial: str
    address: str
    """BUS/NUMBER, as at the end of uris."""


@dataclass(frozen=True)
class UsbPlace:
    """A port and the host controller behind it."""

    path: str
    """The kernel's name of the port, such as 1-1.2: bus 1, port 1, port 2 of the hub there."""
    controller: str | None
    """The host controller, such as 0000:00:14.0; None where it is not known."""


def usb_devices(vendor: str, product: str | None = None, sysfs: Path = SYSFS) -> list[UsbDevice]:
    """Attached devices of a vendor (four hexadecimal digits), of one product or of all."""
    found = []
    for folder in sorted(sysfs.iterdir()) if sysfs.is_dir() else []:
        try:
            seen = [(folder / name).read_text().strip() for name in ("idVendor", "idProduct", "busnum", "devnum")]
        except OSError:  # an interface, or gone by now
            continue
        if seen[0] == vendor and product in (None, seen[1]):
            serial = folder / "serial"
            found.append(UsbDevice(serial.read_text().strip() if serial.exists() else "", f"{seen[2]}/{seen[3]}"))
    return found


def usb_place(uri: str, sysfs: Path = SYSFS) -> UsbPlace | None:
    """The place of a device with an uri such as 1d27/0601@1/6 (bus 1, address 6); None where it is not known."""
    address = _ADDRESS.search(uri)
    if address is None or not sysfs.is_dir():
        return None
    for folder in sorted(sysfs.iterdir()):
        try:
            seen = ((folder / "busnum").read_text().strip(), (folder / "devnum").read_text().strip())
        except OSError:
            continue
        if seen == (str(int(address[1])), str(int(address[2]))):
            return UsbPlace(folder.name, (sysfs / f"usb{seen[0]}").resolve().parent.name)
    return None


def forbidden_node(uri: str, root: Path = Path("/dev/bus/usb")) -> Path | None:
    """The device node of a uri such as 1d27/0601@1/6 where this user may not write to it."""
    address = _ADDRESS.search(uri)
    if address is None:
        return None
    node = root / f"{int(address[1]):03d}" / f"{int(address[2]):03d}"
    return node if node.exists() and not os.access(node, os.W_OK) else None


def crowded_controllers(places: Mapping[str, UsbPlace | None]) -> dict[str, list[str]]:
    """Host controllers with more than one of the devices: {controller: names of the devices}."""
    found = defaultdict(list)
    for name, place in places.items():
        if place is not None and place.controller is not None:
            found[place.controller].append(name)
    return {controller: names for controller, names in found.items() if len(names) > 1}
