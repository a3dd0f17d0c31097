"""All hypotheses tested, and from what failed the best explanation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.tails import chi2_sf
from rgbd_calib.rig.blocks import Block
from rgbd_calib.rig.blocks.board_scale import BoardScale
from rgbd_calib.rig.problem import Problem
from rgbd_calib.trust.self_check.equations import Equations, Score
from rgbd_calib.trust.self_check.findings import Finding, SelfCheckParams
from rgbd_calib.trust.self_check.hypotheses import hypotheses_of
from rgbd_calib.trust.self_check.hypothesis import Hypothesis

MAX_TOLD = 5
"""Sentences; who has five such errors films again."""
SUSPECT_P, MAX_SUSPECTS = 0.05, 16
"""What is tested once more: a few by chance, and where something is wrong, the best explanations among many."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """A hypothesis and its outcome."""

    hypothesis: Hypothesis
    score: Score

    @property
    def gain(self) -> float:
        """By how much the hypothesis fits better, its degrees of freedom counted (Akaike): orders those that tell of one thing."""
        return self.score.statistic - 2 * self.score.dof

    @property
    def plain_gain(self) -> float:
        """The same, had views no errors of their own."""
        return self.score.plain - 2 * self.score.dof


def outcomes_of(eq: Equations, problem: Problem, held: tuple[Block, ...], params: SelfCheckParams) -> list[Outcome]:
    """All of them.

    Raises
    ------
    numpy.linalg.LinAlgError
        The equations are numerically singular.
    """
    outcomes = [Outcome(hypothesis, hypothesis.test(eq)) for hypothesis in hypotheses_of(eq, problem, held, params)]
    if not all(np.isfinite(o.score.statistic) for o in outcomes):
        raise np.linalg.LinAlgError("a statistic is not finite")
    return _retested(eq, outcomes)


SMALL_SHARE = 1 / 3
"""Of the stated error: a smaller one beside it adds a twentieth, and is no news."""
MOST = 0.5
"""Share of the board's size that is left beside the errors that were told, where they do not explain it."""
SEPARABLE = 3.0
"""Times as uncertain beside the errors that were told: what is more, the data do not tell from them (a board's size and the bias
of a depth that no wall has measured), and the estimate leaves the range in which the model is linear."""


def _retested(eq: Equations, outcomes: list[Outcome]) -> list[Outcome]:
    """Those that would look suspicious if views erred in their corners alone, once more and exactly."""
    best: dict[tuple[str, tuple[str, ...]], Outcome] = {}
    for o in outcomes:
        key = o.hypothesis.name, o.hypothesis.cameras
        likely = o.score.dof and chi2_sf(o.score.plain, o.score.dof) < SUSPECT_P
        if likely and (key not in best or o.plain_gain > best[key].plain_gain):
            best[key] = o
    suspects = sorted(best.values(), key=lambda o: -o.plain_gain)[:MAX_SUSPECTS]
    return [Outcome(o.hypothesis, o.hypothesis.retest(eq)) if o in suspects else o for o in outcomes]


def findings_of(
    eq: Equations, tests: list[Outcome], params: SelfCheckParams, stated_mm: float
) -> tuple[list[Finding], Equations]:
    """The tests that failed and matter, the best explanation first, and the equations with these errors in the model.

    One error shows in many tests: where one camera moved, others seem to, or to have another lens. So what fits best is
    said, taken into the model, and the others are tested again, until nothing fails that matters (forward selection).
    """
    limit, least_m = params.significance / max(len(tests), 1), 1e-3 * max(params.caution_mm, SMALL_SHARE * stated_mm)
    limits = {BoardScale.name: params.scale_significance}
    told: list[Outcome] = []
    left, alone = tests, {t.hypothesis: np.trace(t.score.covariance) for t in tests}
    while len(told) < MAX_TOLD:
        left = [t for t in left if t.score.p < limits.get(t.hypothesis.name, limit) and t.score.effect_m > least_m]
        if not left:
            break
        best = max(left, key=lambda t: t.gain)
        told.append(best)
        eq = best.hypothesis.accepted(eq)
        beside = [Outcome(t.hypothesis, t.hypothesis.test(eq)) for t in left if t is not best]
        left = _retested(eq, [t for t in beside if np.trace(t.score.covariance) < SEPARABLE**2 * alone[t.hypothesis]])
    told += [t for t in _scale_left(eq, tests, told, params) if t.score.effect_m > least_m]
    distrust_mm = max(params.distrust_mm, stated_mm)
    findings = [
        Finding(
            t.hypothesis.name,
            "distrust" if t.score.p < limit and 1e3 * t.score.effect_m > distrust_mm else "caution",
            t.hypothesis.cameras,
            t.hypothesis.say(eq, t.score),
            t.hypothesis.fault.advice,
            round(1e3 * t.score.effect_m, 2),
            t.score.p,
        )
        for t in told
    ]
    return findings, eq


def _scale_left(
    eq: Equations, tests: Sequence[Outcome], told: Sequence[Outcome], params: SelfCheckParams
) -> list[Outcome]:
    """The board's size, where it is off by itself, and errors that were told can be told from it, and explain less than half."""
    out = []
    for own in tests:
        if own.hypothesis.name != BoardScale.name or own.score.p >= params.scale_significance:
            continue
        if any(t.hypothesis is own.hypothesis for t in told):
            continue
        beside, alone = own.hypothesis.test(eq), own.score
        separable = np.trace(beside.covariance) < SEPARABLE**2 * np.trace(alone.covariance)
        if separable and abs(beside.estimate[0]) > MOST * abs(alone.estimate[0]):
            out.append(own)
    return out
