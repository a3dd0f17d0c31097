"""Which frames of the board tell most: so many of a long recording that the rest adds little.

What a frame says of cameras, lenses and depth biases is its information with the board's pose eliminated (the Schur
complement of the bundle's equations, at the start and with its first weights). Frames are taken by greedy log det of the sum
(:mod:`rgbd_calib.geometry.selection`), after the few that keep a frame for each pair of cameras that has one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.selection import most_informative
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import model, solve, variance
from rgbd_calib.rig.bundle.params import BundleParams, CameraPrior
from rgbd_calib.rig.bundle.start import bias_terms, depth_ranges, depth_units, prior_of, start
from rgbd_calib.types import Board, IntArray, PlacedView

POSE_SD = 1.0
"""Of what is known of a camera's pose before, rad and m: nothing; it keeps the matrix from being singular."""


@dataclass(frozen=True)
class FrameChoice:
    """The frames that tell most, and how sure they and all of them make the rig, by the equations at the start."""

    chosen: tuple[str, ...]
    left_out: tuple[str, ...]
    covariance: FloatArray
    """(P, P), of all cameras' parameters and the bow, with the chosen frames; P as in the bundle."""
    covariance_of_all: FloatArray
    """(P, P), with all frames."""
    parameters: dict[str, slice]
    """Where each camera's parameters stand."""


def choose_frames(
    views: Sequence[PlacedView],
    alone: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    n: int,
    params: BundleParams | None = None,
) -> FrameChoice:
    """`n` frames of `views`; `alone` are views of an intrinsic recording, which stay. The rest as for the bundle.

    Raises
    ------
    CalibrationError
        More frames are needed to keep every pair of cameras that has common views.
    """
    equations = _Equations(views, alone, board, priors, T_world_color, reference, params or BundleParams())
    frames = sorted({placed.view.frame for placed in views})
    index = {frame: i for i, frame in enumerate(equations.frames)}
    items = [index[frame] for frame in frames]
    extra = sorted(set(range(len(equations.frames))) - set(items))
    known = sum((equations.reduced(i) for i in extra), equations.known)
    first = _one_for_each_pair(views, frames)
    if len(first) > n:
        raise CalibrationError(
            f"--max-views {n}: {len(first)} frames are needed for one of each pair of cameras that has common views. "
            f"Allow {len(first)} or more"
        )
    chosen = most_informative(known, lambda k: equations.reduced(items[k]), len(frames), n, first)
    few = sum((equations.reduced(items[k]) for k in chosen), known)
    whole = sum((equations.reduced(i) for i in items), known)
    taken = tuple(frames[k] for k in chosen)
    return FrameChoice(
        taken,
        tuple(frame for frame in frames if frame not in set(taken)),
        equations.covariance(few),
        equations.covariance(whole),
        equations.parameters,
    )


def _one_for_each_pair(views: Sequence[PlacedView], frames: Sequence[str]) -> list[int]:
    """Few frames that together have every pair of cameras that any frame has (greedy set cover, V. Chvatal, 1979)."""
    cameras: dict[str, list[str]] = {frame: [] for frame in frames}
    for placed in views:
        cameras[placed.view.frame].append(placed.view.camera)
    pairs = [set(combinations(sorted(cameras[frame]), 2)) for frame in frames]
    missing, out = set().union(*pairs), list[int]()
    while missing:
        best = max(range(len(frames)), key=lambda k: (len(pairs[k] & missing), -k))
        missing -= pairs[best]
        out.append(best)
    return out


class _Equations:
    """The information of every view at the start, kept by view; put together by frame when it is asked for."""

    def __init__(
        self,
        views: Sequence[PlacedView],
        alone: Sequence[PlacedView],
        board: Board,
        priors: Mapping[str, CameraPrior],
        T_world_color: Mapping[str, FloatArray],
        reference: str,
        params: BundleParams,
    ) -> None:
        every = [*views, *alone]
        n_bias = bias_terms(priors)
        obs, self.frames = model.observe(every, board, depth_units(priors), depth_ranges(every, priors), n_bias)
        state = start(every, self.frames, obs, priors, T_world_color, n_bias)
        prior = prior_of(state, obs, priors, reference, params)
        weights = variance.initial(obs, len(priors), params.sigma_2d_px, params.k_depth_per_m)
        self._free, self._P = prior.free, state.n_global
        D = state.n_structure
        self._views: list[list[tuple[IntArray, FloatArray]]] = [[] for _ in self.frames]
        V = np.zeros((len(self.frames), D, D))
        for part in solve.blocks(state, obs, board, weights):
            J = part.J.reshape(len(part.J), -1, part.J.shape[-1])
            H = J.transpose(0, 2, 1) @ J
            for frame, columns, own in zip(part.frame, part.columns, H, strict=True):
                self._views[frame].append((columns, own[:-D]))
                V[frame] += own[-D:, -D:]
        values, vectors = np.linalg.eigh(V)
        seen = values > 1e-12 * values[:, -1:]
        # V^-1 = R R'
        self._roots = vectors * np.where(seen, 1 / np.sqrt(np.where(seen, values, 1.0)), 0.0)[:, None]
        n = state.n_camera
        self.parameters = {name: slice(i * n, (i + 1) * n) for i, name in enumerate(priors)}
        pose = np.zeros(self._P, bool)
        for own_slice in self.parameters.values():
            pose[own_slice.start : own_slice.start + 6] = True
        before = prior.information + np.diag(pose / POSE_SD**2)
        self.known: FloatArray = before[np.ix_(self._free, self._free)]
        """What is known without any frame, of the free parameters."""

    def reduced(self, frame: int) -> FloatArray:
        """What a frame says of the free parameters, whatever its board's pose."""
        D = self._roots.shape[1]
        U, W = np.zeros((self._P, self._P)), np.zeros((self._P, D))
        for columns, H in self._views[frame]:
            U[columns[:, None], columns] += H[:, :-D]
            W[columns] += H[:, -D:]
        W = (W @ self._roots[frame])[self._free]
        out: FloatArray = U[self._free][:, self._free] - W @ W.T
        return out

    def covariance(self, information: FloatArray) -> FloatArray:
        """(P, P), rows and columns of held parameters zero."""
        out = np.zeros((self._P, self._P))
        out[np.ix_(self._free, self._free)] = np.linalg.inv(information)
        return out
