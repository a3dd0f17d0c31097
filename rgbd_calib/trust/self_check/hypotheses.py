"""The errors that a bundle's solution is tested against: what the blocks of unknowns say can be wrong, in which views."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.rig.blocks import Block, Fault, Scope
from rgbd_calib.rig.problem import Problem
from rgbd_calib.trust.self_check.equations import ALONE, Equations
from rgbd_calib.trust.self_check.findings import SelfCheckParams
from rgbd_calib.trust.self_check.hypothesis import Hypothesis


def hypotheses_of(
    eq: Equations, problem: Problem, held: tuple[Block, ...], params: SelfCheckParams
) -> list[Hypothesis]:
    """All that are tested: `held` are blocks that the problem holds at zero."""
    out: list[Hypothesis] = []
    for block in held:
        out += _held(eq, block)
        if block.scope is Scope.RIG:
            out += _between_recordings(eq, block, None, params)
    for block in problem.blocks:
        if block.scope is Scope.CAMERA:
            for c in range(len(eq.cameras)):
                out += [*_over_time(eq, block, c, params), *_between_recordings(eq, block, c, params)]
                out += _known(eq, problem, block, c)
    return out


def _columns(eq: Equations, block: Block, fault: Fault) -> IntArray:
    part = eq.columns[block.name]
    return np.arange(part.start, part.stop if fault.parameters is None else part.start + fault.parameters)


def _seen(eq: Equations, block: Block, where: BoolArray) -> bool:
    """Do these views have what the first parameter of a block is of?"""
    at = eq.columns[block.name].start
    return bool(np.any(eq.rows.gram[where][:, at, at]))


def usual_distance_m(eq: Equations, where: BoolArray | None = None) -> float:
    """RMS distance of the boards."""
    some = np.ones(len(eq.camera), bool) if where is None else where
    return float(np.sqrt(np.average(eq.distance_m[some] ** 2, weights=eq.corners[some])))


def _lateral_m(eq: Equations, where: BoolArray) -> float:
    """What a pixel is at the board, RMS, by what the centre of the lens moves."""
    at = eq.columns["intrinsics"].start + 2
    return float(np.sqrt(eq.rows.size[where][:, at, at].sum() / max(int(eq.corners[where].sum()), 1)))


def _held(eq: Equations, block: Block) -> Iterator[Hypothesis]:
    """Errors that the model holds at zero: of the board, of each camera, and of all cameras alike."""
    fault = block.held
    if fault is None:
        return
    if block.scope is Scope.RIG:
        everywhere = np.ones(len(eq.camera), bool)
        if _seen(eq, block, everywhere):
            effect = block.effect(usual_distance_m(eq), 0.0)
            yield Hypothesis(fault, (), _columns(eq, block, fault), everywhere, "", effect, block.least_seen)
        return
    mine = [eq.camera == c for c in range(len(eq.cameras))]
    some = [c for c in range(len(eq.cameras)) if mine[c].any() and _seen(eq, block, mine[c])]
    groups = [(fault, [c]) for c in some]
    if block.of_all is not None and len(some) > 1:
        groups.append((block.of_all, some))
    for own, cameras in groups:
        where = np.isin(eq.camera, cameras)
        effect = block.effect(usual_distance_m(eq, where), _lateral_m(eq, where))
        names = tuple(eq.cameras[c] for c in cameras)
        yield Hypothesis(own, names, _columns(eq, block, own), where, "", effect, block.least_seen)


def _over_time(eq: Equations, block: Block, c: int, params: SelfCheckParams) -> Iterator[Hypothesis]:
    """Parameters that are others from some frame on; of two cameras, nothing tells which of them moved against the other."""
    fault, n = block.over_time, len(eq.frames)
    either = fault is not None and fault.shared and len(eq.cameras) == 2
    if fault is None or (either and c > 0):
        return
    where = (eq.camera == c) & (eq.time_index != ALONE) & (eq.shared if fault.shared else True)
    for split in dict.fromkeys(round(k * n / params.splits) for k in range(1, params.splits)):
        late = where & (eq.time_index >= split)
        sides = len(np.unique(eq.time_index[late])), len(np.unique(eq.time_index[where & ~late]))
        if min(sides) >= params.min_side and _seen(eq, block, late):
            # frames of carried boards begin with the camera's name
            frame = eq.frames[eq.time_index[late].min()].removeprefix(f"{eq.cameras[c]} ")
            names = tuple(eq.cameras) if either else (eq.cameras[c],)
            yield Hypothesis(fault, names, _columns(eq, block, fault), late, frame)


def _between_recordings(eq: Equations, block: Block, c: int | None, params: SelfCheckParams) -> Iterator[Hypothesis]:
    """Parameters that are others in the recording of each camera alone; `c` None: of the whole rig."""
    fault, mine = block.between_recordings, np.full(len(eq.camera), True) if c is None else eq.camera == c
    alone = mine & (eq.time_index == ALONE)
    if fault is None or min(alone.sum(), (mine & ~alone).sum()) < params.min_side or not _seen(eq, block, alone):
        return
    columns = _columns(eq, block, fault)
    if c is None:
        yield Hypothesis(
            fault, (), columns, alone, "", block.effect(usual_distance_m(eq, alone), 0.0), block.least_seen
        )
    else:
        yield Hypothesis(fault, (eq.cameras[c],), columns, alone)


def _known(eq: Equations, problem: Problem, block: Block, c: int) -> Iterator[Hypothesis]:
    """Parameters that are not what was known of them before."""
    fault, mine = block.known, eq.camera == c
    if fault is not None and mine.any() and _seen(eq, block, mine):
        parameters = problem.index(block.name, c)
        yield Hypothesis(fault, (eq.cameras[c],), _columns(eq, block, fault), mine, parameters=parameters)
