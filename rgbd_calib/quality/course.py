"""What a calibration started from, used, left out and found on its way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality.record import Record


@dataclass(frozen=True, slots=True)
class InitialStep(Record):
    """How a camera's first pose was found."""

    camera: str
    from_: str
    points: int
    method: str


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
