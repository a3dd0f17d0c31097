"""Which checkerboard is in some images: the number of its inner corners, by growing what is found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

_LARGEST_SIDE_PX = 1400
"""Larger images are halved: the finder looks for squares of some 10 px, and boards are larger there."""
_STARTS = ((3, 3), (5, 4), (8, 5))
"""Boards from which the finder grows: from a small one it may grow along a wrong line, and miss the rest."""


@dataclass(frozen=True)
class BoardGuess:
    """A checkerboard's inner corners, the larger number first."""

    cols: int
    rows: int
    images: int
    """Images in which exactly this board was found."""
    looked_at: int


def guess_board(images: Iterable[np.ndarray]) -> BoardGuess | None:
    """The largest board that at least two of the images (h, w) or (h, w, 3), uint8, agree on; None where none do.

    A board that is partly covered or turned far gives part of its corners: the whole is the one that comes most often, the
    larger one where two come as often.
    """
    seen: Counter[tuple[int, int]] = Counter()
    looked_at = 0
    for image in images:
        looked_at += 1
        size = _inner_corners(image)
        if size is not None:
            seen[size] += 1
    often = [(n, cols * rows, cols, rows) for (cols, rows), n in seen.items() if n >= 2]
    if not often:
        return None
    n, _, cols, rows = max(often)
    return BoardGuess(cols, rows, n, looked_at)


def _inner_corners(image: np.ndarray) -> tuple[int, int] | None:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    while max(grey.shape) > _LARGEST_SIDE_PX:
        grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    sizes = []
    for start in _STARTS:
        found, _, kinds = cv2.findChessboardCornersSBWithMeta(grey, start, flags)
        if found and kinds is not None:
            rows, cols = sorted(kinds.shape[:2])
            sizes.append((int(cols), int(rows)))
    return max(sizes, key=lambda size: size[0] * size[1], default=None)
