"""A recording of a few pixels: two cameras with depth, two frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.io.dataset import CameraInfo, write_dataset
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.recording import save_color, save_depth

WIDTH, HEIGHT = 8, 6
DEPTH = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 100


def tiny_recording(path: Path) -> Path:
    """Of C1 and C2, 8 x 6 px, in which every depth differs."""
    for camera in ("C1", "C2"):
        for frame in ("000000", "000001"):
            save_color(path, camera, frame, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
            save_depth(path, camera, frame, DEPTH)
    write_dataset(path, {c: CameraInfo(WIDTH, HEIGHT) for c in ("C1", "C2")}, None)
    return path


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what dataset.yaml says."""
    data = load_yaml(folder / "dataset.yaml")
    change(data)
    (folder / "dataset.yaml").write_text(dump_yaml(data))
