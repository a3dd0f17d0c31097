"""What the program says when it cannot go on.

A message has four parts: which camera, file or key; what was seen; what is needed; what to do.
The command line catches :class:`RgbdCalibError` in one place and exits with its `exit_status`.
"""


class RgbdCalibError(Exception):
    """Base of every error that is meant for the user."""

    exit_status = 1


class CalibrationError(RgbdCalibError):
    """The data cannot carry the result that was asked for."""

    exit_status = 1


class ConfigError(RgbdCalibError):
    """A file, a key or an option is wrong."""

    exit_status = 2
