"""What the recording cannot determine: said in words, from the covariance with and without the priors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, Covariance, symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import BlockPrior
from rgbd_calib.rig.problem import Problem

PRIOR_SHARE = 0.7
"""A parameter whose standard deviation is more than this share of its prior's was hardly determined by the data."""
MAX_CORRELATION = 0.99

ADVICE = {
    "focal": "film the board nearer and farther, and tilted",
    "principal": "film the board tilted both ways, also turned by a quarter",
    "lens": "film the board close, into the corners of the image",
    "depth": "record a wall at known distances, or film the board over a longer range of distances",
}


@dataclass(frozen=True)
class Observability:
    sentences: tuple[str, ...]
    """One for each parameter, or pair of parameters, that the recording does not determine."""
    reciprocal_condition: float
    """Of the correlation matrix of the global parameters: smallest over largest eigenvalue."""
    undetermined: BoolArray
    """(P,) bool: the recording adds next to nothing to the prior."""


def examine(problem: Problem, cov: Covariance) -> Observability:
    """Compare the posterior with the prior, and look for correlations of nearly one."""
    prior, cameras = problem.prior, problem.setup.cameras
    sd = np.sqrt(np.maximum(np.diag(cov.of_globals), 0))
    undetermined = prior.free & (sd > PRIOR_SHARE * _prior_sd(prior))
    lens, bias = problem.block("intrinsics"), problem.block("depth bias")
    sentences = []
    for i, camera in enumerate(cameras):
        names: dict[str, list[str]] = {}
        for block in (lens, bias):
            for k, name in zip(problem.index(block.name, i), block.parameters, strict=True):
                if undetermined[k] and prior.assumed[k]:
                    names.setdefault(_kind(name), []).append(name)
        sentences += [
            f"{camera}'s {' and '.join(found)} {'is' if len(found) == 1 else 'are'} fixed by what was assumed, not by the "
            f"recording: {ADVICE[kind]}"
            for kind, found in names.items()
        ]
    free = np.flatnonzero(prior.free & (sd > 0))
    correlation = cov.of_globals[np.ix_(free, free)] / np.outer(sd[free], sd[free])
    place = {int(k): n for n, k in enumerate(free)}
    for i, camera in enumerate(cameras):
        of_lens = list(zip(problem.index(lens.name, i), lens.parameters, strict=True))
        others = of_lens + list(zip(problem.index(bias.name, i), bias.parameters, strict=True))
        for a, (j, name_a) in enumerate(of_lens):  # a polynomial's coefficients go together by nature
            for k, name_b in others[a + 1 :]:
                if j in place and k in place and abs(c := correlation[place[j], place[k]]) > MAX_CORRELATION:
                    sentences.append(
                        f"{camera}'s {name_a} and {name_b} cannot be distinguished (correlation {c:+.3f}): {ADVICE[_kind(name_a)]}"
                    )
    eigenvalues = np.linalg.eigvalsh(correlation) if len(free) else np.ones(1)
    return Observability(tuple(sentences), float(max(eigenvalues[0], 0) / eigenvalues[-1]), undetermined)


def _prior_sd(prior: BlockPrior) -> FloatArray:
    variance = np.diag(symmetric_inverse(prior.information))
    return np.where(np.diag(prior.information) > 0, np.sqrt(variance), np.inf)


def _kind(name: str) -> str:
    """The kind of advice for a parameter."""
    first = name.split()[0]
    return first if first in ADVICE else "lens"
