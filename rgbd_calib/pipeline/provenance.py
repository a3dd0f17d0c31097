"""Which program made a result, and how it was run."""

from __future__ import annotations

import platform
import shlex
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy

import rgbd_calib
from rgbd_calib.io.files import plain
from rgbd_calib.pipeline.config import Config, as_plain


def provenance_of(config: Config) -> dict[str, Any]:
    """Which program, run how."""
    return {
        "program": f"rgbd-calib {rgbd_calib.__version__}",
        "versions": versions(),
        "command": _command(),
        "seed": config.seed,
        "config": plain(as_plain(config)),
    }


def _command() -> str:
    """As it was typed; the name of the script where a Python program called."""
    script = Path(sys.argv[0]).name
    return shlex.join(["rgbd-calib" if script in ("__main__.py", "rgbd-calib.exe") else script, *sys.argv[1:]])


def versions() -> dict[str, str]:
    """Of what the numbers depend on."""
    numeric = {"numpy": np.__version__, "scipy": scipy.__version__, "opencv": cv2.__version__}
    return {"python": platform.python_version(), **numeric}
