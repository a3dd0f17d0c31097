"""The covariance of all cameras of a rig together, as its file has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rgbd_calib.quality.record import Record


@dataclass(frozen=True, slots=True)
class JointErrors(Record):
    """Covariance S R R' S of P parameters: S their standard deviations, R lower triangular with rows of length 1.

    The parameters stand in the order of `sizes`. R is kept in half precision: what is off by 1e-3 of a standard deviation does
    not matter, and a covariance stays one.
    """

    sizes: Mapping[str, Mapping[str, int]]
    """How many parameters, by camera and block."""
    sd: tuple[float, ...]
    """(P,); zero where a parameter is held."""
    factor: str
    """R by rows, up to the diagonal, of the parameters that are not held: little-endian IEEE half floats in base64."""
