"""Calibration of rigs of RGB-D cameras: poses, intrinsics and depth bias, to a millimetre or two.

>>> import rgbd_calib as rc
>>> recording = rc.open_recording("rig1/extrinsic")
>>> result = rc.calibrate(recording, intrinsics="rig1/intrinsic", depth_bias="rig1/depth_bias")
>>> result.rig.save("rig.yaml")

The names in `__all__` are stable; all others are private. Importing the package loads nothing else: each name is loaded when it
is first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rgbd_calib.api import CalibratedRig as CalibratedRig
    from rgbd_calib.api import Result as Result
    from rgbd_calib.api import calibrate as calibrate
    from rgbd_calib.api import load_rig as load_rig
    from rgbd_calib.api import open_recording as open_recording
    from rgbd_calib.api import verify as verify
    from rgbd_calib.errors import CalibrationError as CalibrationError
    from rgbd_calib.errors import ConfigError as ConfigError
    from rgbd_calib.errors import RgbdCalibError as RgbdCalibError

__version__ = "0.1.0"
"""Read by pyproject.toml; looking the version up among the installed packages takes longer than all of `--help`."""

_HOMES = {
    "open_recording": "api",
    "calibrate": "api",
    "load_rig": "api",
    "verify": "api",
    "CalibratedRig": "api",
    "Result": "api",
    "RgbdCalibError": "errors",
    "ConfigError": "errors",
    "CalibrationError": "errors",
}
__all__ = [
    "CalibratedRig",
    "CalibrationError",
    "ConfigError",
    "Result",
    "RgbdCalibError",
    "__version__",
    "calibrate",
    "load_rig",
    "open_recording",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'rgbd_calib' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"rgbd_calib.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
