"""What the recording cannot determine: said in words, from the covariance with and without the priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.inverse import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle.model import INTRINSICS, State
from rgbd_calib.rig.bundle.solve import BoolArray, Covariance, Prior

PRIOR_SHARE = 0.7
"""A parameter whose standard deviation is more than this share of its prior's was hardly determined by the data."""
MAX_CORRELATION = 0.99

NAMES = ("focal length fx", "focal length fy", "principal point cx", "principal point cy", "k1", "k2", "p1", "p2", "k3")
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
    """(P,) bool: the recording adds next to nothing to the prior; these are held at it."""


def examine(cameras: Sequence[str], state: State, cov: Covariance, prior: Prior) -> Observability:
    """Compare the posterior with the prior, and look for correlations of nearly one."""
    n = state.n_camera
    sd = np.sqrt(np.maximum(np.diag(cov.cameras), 0))
    prior_sd = _prior_sd(prior)
    undetermined = prior.free & (sd > PRIOR_SHARE * prior_sd)
    sentences = []
    for i, camera in enumerate(cameras):
        names: dict[str, list[str]] = {}
        for k in range(INTRINSICS.start, n):
            if undetermined[i * n + k] and prior.assumed[i * n + k]:
                name, kind = _name(k)
                names.setdefault(kind, []).append(name)
        sentences += [
            f"{camera}'s {' and '.join(found)} {'is' if len(found) == 1 else 'are'} fixed by what was assumed, not by the "
            f"recording: {ADVICE[kind]}"
            for kind, found in names.items()
        ]
    free = np.flatnonzero(prior.free & (sd > 0))
    correlation = cov.cameras[np.ix_(free, free)] / np.outer(sd[free], sd[free])
    for a, b in np.argwhere(np.triu(np.abs(correlation), 1) > MAX_CORRELATION):
        i, j = free[a], free[b]
        of_a_lens = INTRINSICS.start <= i % n < INTRINSICS.stop  # a polynomial's coefficients go together by nature
        if i // n == j // n and i // n < len(cameras) and of_a_lens and j % n >= INTRINSICS.start:
            (name_a, kind), (name_b, _) = _name(i % n), _name(j % n)
            sentences.append(
                f"{cameras[i // n]}'s {name_a} and {name_b} cannot be told apart (correlation {correlation[a, b]:+.3f}): "
                f"{ADVICE[kind]}"
            )
    eigenvalues = np.linalg.eigvalsh(correlation) if len(free) else np.ones(1)
    return Observability(tuple(sentences), float(max(eigenvalues[0], 0) / eigenvalues[-1]), undetermined)


def _prior_sd(prior: Prior) -> FloatArray:
    variance = np.diag(symmetric_inverse(prior.information))
    return np.where(np.diag(prior.information) > 0, np.sqrt(variance), np.inf)


def _name(k: int) -> tuple[str, str]:
    """Name of a camera's local parameter, and the kind of advice for it."""
    if k >= INTRINSICS.stop:
        return f"depth bias c{k - INTRINSICS.stop}", "depth"
    name = NAMES[k - INTRINSICS.start]
    return name, name.split()[0] if " " in name else "lens"
