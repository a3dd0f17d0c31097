"""How good a calibration is, and how it came about: what a rig file has under `quality`, as records.

The names of the fields are the keys of the file. None: this method, or an older program, does not state it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Literal

from rgbd_calib.geometry.board import Board, BoardShape
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.so3 import FloatArray

Level = Literal["caution", "distrust"]


@dataclass(frozen=True, slots=True)
class Record:
    """A part of a rig file: fields that equal their default are not written."""

    other: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    """Keys that this program does not know; written back as they are."""


class Counted(Enum):
    """The errors that an expected alignment counts."""

    ALL = "poses, intrinsics, depth bias"
    POSES = "poses alone; intrinsics and depth taken as exact"


@dataclass(frozen=True, slots=True)
class ExpectedPair(Record):
    """Expected alignment of two cameras."""

    points: int
    mean_mm: float
    worst_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedGrid(Record):
    """Expected alignment over the working volume."""

    points_in_reference_m: FloatArray
    """(n, 3), in the reference camera's frame, so that they hold in any world."""
    error_mm: FloatArray
    """(n,), mean over the pairs of cameras that see the point."""


@dataclass(frozen=True, slots=True)
class ExpectedAlignment(Record):
    """How far apart two cameras are expected to put the same point, by the covariance of all parameters."""

    of: Counted
    mean_mm: float
    p95_mm: float
    worst_mm: float
    pairs: Mapping[str, ExpectedPair]
    grid: ExpectedGrid | None = None

    @property
    def lower_bound(self) -> bool:
        """Not all errors are counted."""
        return self.of is Counted.POSES


@dataclass(frozen=True, slots=True)
class AlignmentNumbers(Record):
    """Distances between where two cameras put the same points, and errors of boards that one locates and the other sees."""

    points: int
    mean_mm: float | None = None
    median_mm: float | None = None
    p95_mm: float | None = None
    median_px: float | None = None
    mean_px: float | None = None
    median_board_mm: float | None = None
    """Of the errors in px, at the board, across the line of sight."""


@dataclass(frozen=True, slots=True)
class PoseNumbers(Record):
    """Error of a camera's pose against the truth."""

    rotation_deg: float
    translation_mm: float
    relative_translation: float


@dataclass(frozen=True, slots=True)
class MeasuredAlignment(Record):
    """Alignment by a recording, or against the truth; by pair of cameras and by distance."""

    all: AlignmentNumbers
    pairs: Mapping[str, AlignmentNumbers]
    by_distance: Mapping[str, AlignmentNumbers]
    poses: Mapping[str, PoseNumbers] | None = None


@dataclass(frozen=True, slots=True)
class WeightRound(Record):
    """Weights after one round; a noise is by camera, or one for all."""

    cost: float | None = None
    w: float | None = None
    sigma_2d_px: float | Mapping[str, float] | None = None
    sigma_3d_m: float | None = None
    depth_k_per_m: Mapping[str, float] | None = None
    depth_cell_exponent: float | None = None
    pose_part_pixel: float | None = None
    pose_part_depth: float | None = None
    dropped_views: int | None = None


@dataclass(frozen=True, slots=True)
class InitialStep(Record):
    """How a camera's first pose was found."""

    camera: str
    from_: str
    points: int
    method: str


@dataclass(frozen=True, slots=True)
class PairViews(Record):
    """Frames that two cameras share."""

    cameras: tuple[str, str]
    common_frames: int
    agreeing: int
    """Frames that agree on the relative pose."""
    rival: int | None = None
    """Frames that agree on the next other one."""


@dataclass(frozen=True, slots=True)
class PlaneFilterCounts(Record):
    """What does not lie on its board's plane."""

    dropped_corners: int
    dropped_depth: tuple[str, ...]
    """Views, as `CAMERA FRAME`, whose depth is left out."""


@dataclass(frozen=True, slots=True)
class LensChoice(Record):
    """A kind of lens, and why."""

    kind: LensKind
    held_out_px: Mapping[LensKind, float | None]
    """RMS of views held out, in the median, None of a lens that cannot be inverted in its image; empty where no other kind had
    to be tried."""

    @property
    def sentence(self) -> str:
        """Why, for people; empty where nothing was to choose."""
        if not self.held_out_px:
            return ""
        each = (f"{kind} {'not invertible' if px is None else f'{px:.3f} px'}" for kind, px in self.held_out_px.items())
        return f"lens {self.kind}; RMS of views held out: {', '.join(each)}"


class PropertyKind(Enum):
    """What a bundle finds out about board and sensors, and corrects."""

    PRINT = "print"
    BEND = "bend"
    REGISTRATION = "registration"
    DEPTH_FIELD = "depth field"

    @property
    def of_board(self) -> bool:
        return self in (PropertyKind.PRINT, PropertyKind.BEND)


@dataclass(frozen=True, slots=True)
class CorrectedProperty(Record):
    """One of them in words."""

    text: str
    kind: PropertyKind | None = None
    """None: an older program does not state it."""


@dataclass(frozen=True, slots=True)
class CommonErrorSigmas(Record):
    """What neighbouring corners share, in sigmas of one of them."""

    pixel: float
    depth: float
    depth_over_image: FloatArray | None = None
    """(C,), camera by camera."""


@dataclass(frozen=True, slots=True, eq=False)
class StartingCamera(Record):
    """A camera before the calibration."""

    T_world_color: FloatArray
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True)
class StartingRig(Record):
    """The rig before the calibration: first poses from depth as measured, intrinsics as given."""

    poses_from: str
    cameras: Mapping[str, StartingCamera]


@dataclass(frozen=True, slots=True)
class SelectedFrames(Record):
    """The frames that are used, where not all are, and what they cost."""

    frames: int
    used: int
    left_out: tuple[str, ...]
    error_over_that_of_all: float | None = None
    expected_mm: float | None = None
    expected_mm_with_all: float | None = None


@dataclass(frozen=True, slots=True)
class Finding(Record):
    """Something is not as the model says."""

    check: str
    level: Level
    cameras: tuple[str, ...]
    text: str
    """What is seen, and what that means."""
    advice: str
    effect_mm: float | None = None
    p: float | None = None
    """Chance of it where all is well, in one test."""


@dataclass(frozen=True, slots=True)
class BoardScale(Record):
    """How much longer the board's squares are by the depth than stated: distances as such are known no better."""

    percent: float
    sd_percent: float
    distance_m: float
    """Usual distance of the boards."""


@dataclass(frozen=True, slots=True)
class ScoreOutcome(Record):
    """The test of one hypothesis, of one camera where it is about one."""

    test: str
    camera: str | None
    chi2: float | None = None
    dof: int | None = None
    p: float | None = None
    effect_mm: float | None = None


@dataclass(frozen=True, slots=True)
class HeldOutPart(Record):
    """The test of a part of the recording against the rest."""

    frames: str
    chi2: float | None = None
    dof: int | None = None
    others: float | None = None
    p: float | None = None
    moves_mm: float | None = None


@dataclass(frozen=True, slots=True)
class SelfCheck(Record):
    """The outcome of all checks of a result."""

    trusted: bool
    findings: tuple[Finding, ...]
    """Those that matter most first."""
    scale: BoardScale | None = None
    tests: tuple[ScoreOutcome, ...] | None = None
    tested: int | None = None
    held_out: tuple[HeldOutPart, ...] | None = None
    noise_of_parts: Mapping[str, float] | None = None
    """Of each part of a camera's residuals, over that of the whole."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasSamples(Record):
    """What a depth bias was fitted to; (n,) each."""

    z_m: FloatArray
    z_true_m: FloatArray
    dropped: tuple[bool, ...] | None = None


@dataclass(frozen=True, slots=True)
class CarriedBoard(Record):
    """What is known of the clocks beyond their values."""

    views: int
    left_out: Mapping[str, str]
    remarks: tuple[str, ...]
    jerk_rad_per_s3: float | None
    jerk_m_per_s3: float | None
    reference: str


@dataclass(frozen=True, slots=True)
class FloorFit(Record):
    """The floor that is the world."""

    frames: tuple[str, ...]
    points: int
    rms_m: float
    reference_height_m: float


@dataclass(frozen=True, slots=True)
class CameraUpdate(Record):
    """A camera of a finished rig that was posed anew, or added, by a board or by a snapshot."""

    camera: str
    by: str | None = None
    was_in_rig: bool | None = None
    recording: str | None = None
    recording_sha256: str | None = None
    snapshot: str | None = None
    snapshot_sha256: str | None = None
    intrinsics: str | None = None
    views: int | None = None
    common_frames: Mapping[str, int] | None = None
    left_out: Mapping[str, str] | None = None
    alignment: Mapping[str, AlignmentNumbers] | None = None
    moved_mm: float | None = None
    turned_deg: float | None = None
    unchanged_share: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrueWall(Record):
    """The plane normal . p = normal_z distance_m in the colour camera's frame, of a simulation."""

    distance_m: float
    normal: FloatArray


@dataclass(frozen=True, slots=True)
class TrueChange(Record):
    """What changed between two simulated snapshots."""

    T_old_new: Mapping[str, FloatArray]
    moved: tuple[str, ...]
    changed_share: Mapping[str, float]
    light: float
    depth_scale: float
    depth_offset_m: float


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
