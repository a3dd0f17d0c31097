"""Several depth images of a still scene made into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbd_calib.io.snapshot import averaged


def mean_depth(images: Sequence[np.ndarray]) -> np.ndarray:
    """Mean over raw depth images (h, w) uint16 without outliers, in whole units; 0, no measurement, where fewer than half of
    them measured. One image comes back as it is.

    Sensors quantise depth: a median stays at one of their steps, between which the mean of noisy readings lies.
    """
    if len(images) == 1:
        return images[0]
    stack = np.stack(images).astype(np.float32)
    stack[stack == 0] = np.nan
    return np.rint(np.nan_to_num(averaged(stack))).astype(np.uint16)
