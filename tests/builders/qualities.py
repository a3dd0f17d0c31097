"""Parts of a rig's quality, as short as a test needs them."""

from __future__ import annotations

import numpy as np

from rgbd_calib.quality import (
    AlignmentNumbers,
    Counted,
    ExpectedAlignment,
    ExpectedGrid,
    ExpectedPair,
    MeasuredAlignment,
    Quality,
)


def expected(mean_mm: float, of: Counted = Counted.ALL, grid: ExpectedGrid | None = None) -> ExpectedAlignment:
    """Of C1 and C2."""
    pairs = {"C1 - C2": ExpectedPair(8, mean_mm, 3 * mean_mm)}
    return ExpectedAlignment(of, mean_mm, 2 * mean_mm, 3 * mean_mm, pairs, grid)


def grid_of(points_m: np.ndarray, error_mm: np.ndarray) -> ExpectedGrid:
    return ExpectedGrid(np.array(points_m, float), np.array(error_mm, float))


def measured(**numbers: float) -> MeasuredAlignment:
    return MeasuredAlignment(AlignmentNumbers(9, **numbers), {}, {})


def quality(expected_mm: float | None, measured_mm: float | None, of: Counted = Counted.ALL) -> Quality:
    """Expected and, in the median, measured."""
    return Quality(
        expected_alignment=None if expected_mm is None else expected(expected_mm, of),
        alignment_on_recording=None if measured_mm is None else measured(median_mm=measured_mm),
    )
