"""Several depth images of a still scene made into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbd_calib.io.snapshot import averaged


def median_depth(images: Sequence[np.ndarray]) -> np.ndarray:
    """Median over raw depth images (h, w) uint16, where 0 is no measurement; one image comes back as it is.

    A pixel that fewer than half of the images measured stays 0. Between two middle values the smaller one is taken:
    the result is a value that the device sent.
    """
    if len(images) == 1:
        return images[0]
    stack = np.sort(np.stack(images), axis=0)
    measured = np.count_nonzero(stack, axis=0)
    middle = len(images) - measured + (measured - 1) // 2  # zeros sort to the front
    picked = np.take_along_axis(stack, np.minimum(middle, len(images) - 1)[None], axis=0)[0]
    return np.where(2 * measured >= len(images), picked, 0).astype(np.uint16)


def mean_depth(images: Sequence[np.ndarray]) -> np.ndarray:
    """Mean over raw depth images (h, w) uint16 without outliers, in whole units, 0 where half of them measured nothing."""
    stack = np.stack(images).astype(np.float32)
    stack[stack == 0] = np.nan
    return np.rint(np.nan_to_num(averaged(stack))).astype(np.uint16)
