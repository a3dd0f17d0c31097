"""How good a calibration is, and how it came about: what a rig file has under `quality`, as records.

The names of the fields are the keys of the file. None: this method, or an older program, does not state it.
"""

from rgbd_calib.quality.alignment import (
    AlignmentNumbers,
    Counted,
    ExpectedAlignment,
    ExpectedGrid,
    ExpectedPair,
    MeasuredAlignment,
    PoseNumbers,
)
from rgbd_calib.quality.camera import CameraStatistics
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
    PropertyKind,
    SelectedFrames,
    StartingCamera,
    StartingRig,
    WeightRound,
)
from rgbd_calib.quality.joint import JointErrors
from rgbd_calib.quality.record import Record, overlaid
from rgbd_calib.quality.self_check import BoardScaleEstimate, Finding, HeldOutPart, Level, ScoreOutcome, SelfCheck
from rgbd_calib.quality.truth import TrueChange, TrueWall
from rgbd_calib.quality.whole import Quality

__all__ = [
    "AlignmentNumbers",
    "BiasSamples",
    "BoardScaleEstimate",
    "CameraStatistics",
    "CameraUpdate",
    "CarriedBoard",
    "CommonErrorSigmas",
    "CorrectedProperty",
    "Counted",
    "ExpectedAlignment",
    "ExpectedGrid",
    "ExpectedPair",
    "Finding",
    "FloorFit",
    "HeldOutPart",
    "InitialStep",
    "JointErrors",
    "LensChoice",
    "Level",
    "MeasuredAlignment",
    "PairViews",
    "PlaneFilterCounts",
    "PoseNumbers",
    "PropertyKind",
    "Quality",
    "Record",
    "ScoreOutcome",
    "SelectedFrames",
    "SelfCheck",
    "StartingCamera",
    "StartingRig",
    "TrueChange",
    "TrueWall",
    "WeightRound",
    "overlaid",
]
