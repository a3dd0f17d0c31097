"""What can be set about detection."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DetectParams:
    escalate: bool = True
    """Search an enlarged part of the image too, where a grid of small squares was found in part."""
    min_corners: int = 6
    """A view with fewer corners is dropped."""
    min_share: float = 0.8
    """So is one of a checkerboard that loses more of the corners found to the checks of each corner."""
