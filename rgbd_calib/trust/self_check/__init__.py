"""Is the result what it says it is? Tests of a calibration's residuals against what its own covariance allows.

Weights are estimated from the residuals, so that the sum of squares as a whole fits by construction. What the estimate
does not absorb is tested: :mod:`.hypotheses` has the errors that happen to rigs (a camera that moved, another lens, a board
of another size, depth beside its colour, smooth fields over image and range), :mod:`.equations` the score test that weighs
each (:mod:`.hypothesis`), :mod:`.outcomes` the best explanation of what failed, :mod:`.held_out` parts of the recording held
out, :mod:`.checks` what needs no equations, :mod:`.findings` from when on something is said.
"""

from rgbd_calib.trust.self_check.checks import (
    ResidualNoise,
    check_clipped,
    check_copies,
    check_dropped,
    check_factors,
    check_groups,
    check_noise,
    check_steps,
    check_votes,
    group_ratios,
)
from rgbd_calib.trust.self_check.equations import (
    ALONE,
    Equations,
    Score,
    score_test,
)
from rgbd_calib.trust.self_check.findings import Finding, SelfCheck, SelfCheckParams
from rgbd_calib.trust.self_check.held_out import Deletion, HeldOut, delete, held_out_findings, hold_out
from rgbd_calib.trust.self_check.hypotheses import usual_distance_m
from rgbd_calib.trust.self_check.outcomes import Outcome, findings_of, outcomes_of

__all__ = [
    "ALONE",
    "Deletion",
    "Equations",
    "Finding",
    "HeldOut",
    "Outcome",
    "ResidualNoise",
    "Score",
    "SelfCheck",
    "SelfCheckParams",
    "check_clipped",
    "check_copies",
    "check_dropped",
    "check_factors",
    "check_groups",
    "check_noise",
    "check_steps",
    "check_votes",
    "delete",
    "findings_of",
    "group_ratios",
    "held_out_findings",
    "hold_out",
    "outcomes_of",
    "score_test",
    "usual_distance_m",
]
