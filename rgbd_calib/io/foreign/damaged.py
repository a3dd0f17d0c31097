"""What libraries raise on damaged files becomes an error for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rgbd_calib.errors import ConfigError, RgbdCalibError


@contextmanager
def faults(where: str, what: str) -> Iterator[None]:
    """Any exception of a library (struct.error, KeyError, AssertionError, ...) as a ConfigError: `where` cannot be read as `what`."""
    try:
        yield
    except RgbdCalibError:
        raise
    except Exception as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"{where}: cannot be read as {what} ({why}). Is it complete? Copy it again") from error
