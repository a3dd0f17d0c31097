"""Which camera is which: ids by serial number, with the USB port where a device reports none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rgbd_calib.errors import ConfigError


@dataclass(frozen=True)
class Identity:
    """How a device can be known again."""

    uri: str
    serial: str | None
    usb_path: str

    @property
    def key(self) -> str:
        """What identifies the camera over replugging: its serial number, else its port."""
        return self.serial or self.usb_path

    def answers_to(self, key: str) -> bool:
        return key in (self.serial, self.usb_path, self.uri)


def parse_devices(texts: Sequence[str]) -> dict[str, str]:
    """{camera id: serial number, USB path or uri} of options `ID=SERIAL`.

    Raises
    ------
    ConfigError
        Not of that form, or an id or a device twice.
    """
    wanted: dict[str, str] = {}
    for text in texts:
        camera, equals, key = text.partition("=")
        if not equals or not camera or not key or "/" in camera or camera.startswith("."):
            raise ConfigError(
                f"--device {text}: ID=SERIAL needed, such as C1=1404230035. `rgbd-calib devices` lists them"
            )
        if camera in wanted or key in wanted.values():
            raise ConfigError(f"--device {text}: {camera if camera in wanted else key} is named twice. Name each once")
        wanted[camera] = key
    return wanted


def assign_cameras(
    found: Sequence[Identity], wanted: Mapping[str, str], known: Mapping[str, str] | None = None
) -> dict[str, Identity]:
    """{camera id: device}: those of `wanted`, or all that were found.

    Parameters
    ----------
    found
        What is attached.
    wanted
        {camera id: serial number, USB path or uri} as asked for; empty for all.
    known
        The same from an earlier session of this recording: devices keep their ids, new ones get new ids.

    Raises
    ------
    ConfigError
        A wanted device is not attached.
    """
    if wanted:
        return {camera: _find(camera, key, found) for camera, key in wanted.items()}
    names = {key: camera for camera, key in (known or {}).items()}
    cameras: dict[str, Identity] = {}
    free = (f"C{i}" for i in range(1, 1000) if f"C{i}" not in names.values())
    for identity in sorted(found, key=lambda i: (i.serial is None, i.key)):
        earlier = names.get(identity.serial or "") or names.get(identity.usb_path)
        cameras[earlier or next(free)] = identity
    return dict(sorted(cameras.items()))


def _find(camera: str, key: str, found: Sequence[Identity]) -> Identity:
    for identity in found:
        if identity.answers_to(key):
            return identity
    seen = ", ".join(f"{i.serial or 'no serial'} at {i.usb_path}" for i in found) or "none"
    raise ConfigError(
        f"{camera}: no device {key} is attached; attached: {seen}. Plug it in, or correct --device {camera}={key}"
    )
