"""All that is said of a rig beside its cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rgbd_calib.geometry.board import Board, BoardShape
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality.alignment import AlignmentNumbers, ExpectedAlignment, MeasuredAlignment
from rgbd_calib.quality.changes import CameraUpdate, FloorFit
from rgbd_calib.quality.course import (
    BiasSamples,
    CarriedBoard,
    CommonErrorSigmas,
    CorrectedProperty,
    InitialStep,
    LensChoice,
    PairViews,
    PlaneFilterCounts,
    SelectedFrames,
    StartingRig,
    WeightRound,
)
from rgbd_calib.quality.record import Record
from rgbd_calib.quality.self_check import SelfCheck
from rgbd_calib.quality.truth import TrueChange, TrueWall


@dataclass(frozen=True, slots=True)
class Quality(Record):
    """All that is said of a rig beside its cameras; `other` also has what is not as expected, and `faults` why."""

    method: str | None = None
    initialization: tuple[InitialStep, ...] | None = None
    status: str | None = None
    message: str | None = None
    sigma_2d_px: float | None = None
    sigma_3d_m: float | None = None
    w: float | None = None
    redundancy_2d: float | None = None
    redundancy_3d: float | None = None
    cost: float | None = None
    iterations: int | None = None
    rounds: tuple[WeightRound, ...] | None = None
    dropped_rows: Mapping[str, int] | None = None
    """How many observations, by the reason."""
    dropped: Mapping[str, Mapping[str, str]] | None = None
    """Why, by camera and frame: the view, or its depth, was left out of the solution."""
    dropped_depth_corners: int | None = None
    not_observable: tuple[str, ...] | None = None
    """Sentences on what the recording does not determine."""
    reciprocal_condition: float | None = None
    corrected: tuple[CorrectedProperty, ...] | None = None
    board_bow_m: FloatArray | None = None
    common_error_sigmas: CommonErrorSigmas | None = None
    images: Mapping[str, int] | None = None
    views_found: Mapping[str, int] | None = None
    views_used: Mapping[str, int] | None = None
    views_not_associated: Mapping[str, Mapping[str, str]] | None = None
    """Why, by camera and frame."""
    turned_views: Mapping[str, Mapping[str, str]] | None = None
    back_views: int | None = None
    plane_filter: PlaneFilterCounts | None = None
    pairs: tuple[PairViews, ...] | None = None
    working_distance_m: float | None = None
    """Median distance of the boards from the cameras."""
    lenses: Mapping[str, LensChoice] | None = None
    alignment_on_recording: MeasuredAlignment | None = None
    start: StartingRig | None = None
    carried: CarriedBoard | None = None
    expected_alignment: ExpectedAlignment | None = None
    frame_selection: SelectedFrames | None = None
    self_check: SelfCheck | None = None
    board: Board | None = None
    board_shape: BoardShape | None = None
    """Of a simulation's truth; under `board` in its file."""
    walls: Mapping[str, Mapping[str, TrueWall]] | None = None
    """Of a simulation's truth, by camera and frame."""
    depth_drift: Mapping[str, Mapping[str, float]] | None = None
    """Of a simulation's truth, metres along the ray, by camera and frame."""
    snapshot: TrueChange | None = None
    depth_bias_samples: Mapping[str, BiasSamples] | None = None
    left_out: Mapping[str, str] | None = None
    """Why, by `CAMERA FRAME`, of views that clocks were not estimated from."""
    world: str | None = None
    floor: FloorFit | None = None
    residuals_sha256: str | None = ""
    """Of the residuals that were written with the rig; empty: not stated, None: the rig was updated without them."""
    updates: tuple[CameraUpdate, ...] | None = None
    faults: Mapping[str, str] = field(default_factory=dict)
    """By key, what is wrong with it in the file."""

    @property
    def expected_mm(self) -> float | None:
        """Mean expected alignment."""
        return None if self.expected_alignment is None else self.expected_alignment.mean_mm

    @property
    def measured(self) -> AlignmentNumbers | None:
        """Alignment on the recording, of all pairs."""
        return None if self.alignment_on_recording is None else self.alignment_on_recording.all
