"""A trial of study_hazards.py: commands on a spoiled copy of a simulation, and what they said in a line."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

SECONDS = 60
"""A command that takes longer hangs: the slowest of these takes 10 s."""


class Trial:
    """A scratch folder, and commands that run in it."""

    def __init__(self, base: Path, folder: Path, code: Path) -> None:
        self.base, self.folder = base, folder
        self.env = {**os.environ, "PYTHONPATH": str(code), "RGBD_CALIB_CACHE": str(folder / "cache")}
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            self.env[name] = "1"

    def copy(self, name: str = "extrinsic") -> Path:
        """A recording of the simulation, to be spoiled."""
        for extra in ("truth.yaml", "true_corners.csv"):
            shutil.copy(self.base / extra, self.folder)
        return Path(shutil.copytree(self.base / name, self.folder / name, dirs_exist_ok=True))

    def images(self, change: Callable[[np.ndarray], np.ndarray], kind: str, *cameras: str) -> None:
        """Change images of the copy."""
        for camera in cameras or ("C1", "C2"):
            for path in sorted((self.folder / "extrinsic" / camera / kind).glob("*.png")):
                cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    def edit(self, file: str, old: str, new: str) -> None:
        path = self.folder / file
        path.write_text(re.sub(old, new, path.read_text(), count=1))

    def run(self, *args: str, stdin: int | None = None) -> str:
        """Status, and the sentence that counts."""
        command = [sys.executable, "-m", "rgbd_calib", *args]
        process = subprocess.Popen(
            command, cwd=self.folder, env=self.env, stdin=stdin or subprocess.DEVNULL, stdout=-1, stderr=-2, text=True,
            errors="backslashreplace", start_new_session=True,
        )  # fmt: skip
        try:
            text, _ = process.communicate(timeout=SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return f"**hangs** (killed after {SECONDS} s)"
        return f"{process.returncode}: {told(text)}"

    def calibrate(self, *more: str, bias: bool = True, close: bool = True) -> str:
        sources = ["--intrinsics", str(self.base / "intrinsic")] if close else []
        sources += ["--depth-bias", str(self.base / "depth_bias")] if bias else []
        return self.run("calibrate", "extrinsic", *sources, "-o", "rig.yaml", "--jobs", "1", "--overwrite", *more)


def told(text: str) -> str:
    """Of what a command prints: the error, or the true and the expected error and the verdict."""
    lines = text.strip().splitlines() or ["(nothing)"]
    if any(line.startswith("Traceback") for line in lines):
        return f"**traceback** {lines[-1][:160]}"
    errors = [line for line in lines if line.startswith(("Error:", "rgbd-calib: error"))]
    if errors:
        return " ".join(lines[lines.index(errors[0]) :])[:420]
    out = [
        f"{a} {m[1]}"
        for a, w in (("true", "Error against the truth"), ("stated", "Expected error"))
        if (m := re.search(rf"{w}: ([\d.]+ mm)", text))
    ]
    out += [line[:260] for line in lines if line.startswith("Verdict")]
    return "; ".join(out) or " / ".join(lines[-2:])[:420]
