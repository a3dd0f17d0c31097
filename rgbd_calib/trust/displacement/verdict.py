"""Does a rig still hold, and which camera moved?

For a pair (a, b) and a place X where the new frames had the board, the rig and the new poses disagree by

    d_ab(X) = T_rig_a T_new_a^-1 X - T_rig_b T_new_b^-1 X,

which no choice of the world changes. Its mean square over X, less the noise's share, is the pair's error squared, from
all frames together: the noise of single depths has no part in it. Where the rig is right the mean square is a sum of
lambda_i chi_1^2, with lambda the eigenvalues of M C, C the covariance of the two poses, M the mean of J'J and
J = [-hat(X), I]; its tail is that of a chi squared of the same mean and variance (F. Satterthwaite, 1946).

A pair is broken where it is off by more than the limit and by more than noise makes of it once in 1/`false_alarm`. The cameras that
moved are the smallest set such that no pair without them is broken (a vertex cover of the broken pairs); of sets of one
size the one that leaves the least disagreement. So the reference has no privilege: where it moved, it is named. Of two
cameras nobody can say which.

The rig's own covariance is no part of the test: it is full of lens and pose trading places, which cancels wherever the
board was. An error of the calibration itself shows as a displacement, and the limit is there to allow it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_isf
from rgbd_calib.trust.displacement.cameras import LocatedCameras


@dataclass(frozen=True)
class VerdictParams:
    max_m: float = 0.003
    """A pair may be off by this much at the board."""
    false_alarm: float = 1e-4
    """Chance that noise alone calls a right pair off."""
    clear_ratio: float = 2.0
    """Another set of moved cameras is named too where it leaves less than this many times the disagreement."""


@dataclass(frozen=True)
class PairError:
    """How far two cameras put the same place apart."""

    cameras: tuple[str, str]
    error_m: float
    noise_m: float
    """RMS of what noise makes of a right pair."""
    detectable_m: float
    """Noise alone stays below this but for one time in 1 / `false_alarm`."""
    broken: bool


@dataclass(frozen=True)
class Moved:
    """A camera against those that did not move."""

    camera: str
    shift_m: float
    """Of its optical centre."""
    turn_rad: float
    shift_sd_m: float
    turn_sd_rad: float


@dataclass(frozen=True)
class DisplacementVerdict:
    pairs: tuple[PairError, ...]
    moved: tuple[str, ...]
    """The most likely set; empty where no pair is broken."""
    rivals: tuple[tuple[str, ...], ...]
    """Other sets that explain the broken pairs about as well."""
    displacements: tuple[Moved, ...]
    """Of every camera against those that did not move (all, where none did)."""
    blind: tuple[tuple[str, str], ...]
    """Pairs whose noise hides an error at the limit."""
    max_m: float
    unjoined: tuple[str, ...]
    """Cameras that no common frame joins to the others."""

    @property
    def holds(self) -> bool:
        return not self.moved and not self.blind and not self.unjoined


def judge(poses: LocatedCameras, cameras: Sequence[str], params: VerdictParams | None = None) -> DisplacementVerdict:
    """Judge the cameras of a recording by their poses before and now."""
    params = params or VerdictParams()
    seen = [name for name in poses.cameras if any(camera == name for camera, _ in poses.corners_m)]
    pairs = tuple(_pair(poses, a, b, params) for a, b in combinations(seen, 2))
    covers = _smallest_covers(seen, pairs)
    moved, rivals = (covers[0][1], _rivals(covers, params)) if covers and covers[0][1] else ((), ())
    still = [name for name in seen if name not in moved]
    blind = tuple(p.cameras for p in pairs if p.detectable_m > params.max_m and not set(p.cameras) & set(moved))
    unjoined = tuple(name for name in cameras if name not in seen)
    return DisplacementVerdict(pairs, moved, rivals, _displacements(poses, seen, still), blind, params.max_m, unjoined)


def _pair(poses: LocatedCameras, a: str, b: str, params: VerdictParams) -> PairError:
    X = _places(poses, a, b)
    places = [se3.transform(poses.before[name] @ se3.inverse(poses.T_world_color[name]), X) for name in (a, b)]
    square = float(np.mean(np.sum((places[0] - places[1]) ** 2, axis=1)))
    J = se3.by_motion(X)
    M = np.einsum("nij,nik->jk", J, J) / len(X)
    i, j = (6 * poses.cameras.index(name) for name in (a, b))
    C = poses.covariance
    relative = C[i : i + 6, i : i + 6] + C[j : j + 6, j : j + 6] - C[i : i + 6, j : j + 6] - C[j : j + 6, i : i + 6]
    MC = M @ relative
    noise, variance = float(np.trace(MC)), 2 * float(np.trace(MC @ MC))
    detectable = np.sqrt(variance / (2 * noise) * chi2_isf(params.false_alarm, 2 * noise**2 / variance))
    error = float(np.sqrt(max(square - noise, 0.0)))
    broken = error > params.max_m and square > detectable**2
    return PairError((a, b), error, float(np.sqrt(noise)), float(detectable), bool(broken))


def _places(poses: LocatedCameras, a: str, b: str) -> FloatArray:
    """Corners (n, 3), metres, in the world, of the frames that both saw; of all that either saw where there are none."""
    frames = [{frame for camera, frame in poses.corners_m if camera == name} for name in (a, b)]
    used = frames[0] & frames[1] or frames[0] | frames[1]
    return np.concatenate([X for (camera, frame), X in poses.corners_m.items() if camera in (a, b) and frame in used])


def _smallest_covers(cameras: Sequence[str], pairs: Sequence[PairError]) -> list[tuple[float, tuple[str, ...]]]:
    """Smallest sets of cameras that every broken pair has a part of, with the mean square that the others leave."""
    for size in range(len(cameras)):
        covers = []
        for chosen in combinations(cameras, size):
            left = [p for p in pairs if not set(p.cameras) & set(chosen)]
            if not any(p.broken for p in left):
                covers.append((float(np.mean([p.error_m**2 for p in left])) if left else 0.0, chosen))
        if covers:
            return sorted(covers)
    return []


def _rivals(covers: list[tuple[float, tuple[str, ...]]], params: VerdictParams) -> tuple[tuple[str, ...], ...]:
    best = covers[0][0]
    return tuple(chosen for left, chosen in covers[1:] if left <= params.clear_ratio**2 * best)


def _displacements(poses: LocatedCameras, seen: Sequence[str], still: Sequence[str]) -> tuple[Moved, ...]:
    """Every camera against the mean of those that stood still."""
    if not still:
        return ()
    n = 6
    at = [n * poses.cameras.index(name) for name in still]
    delta = np.stack([se3.difference(poses.T_world_color[name], poses.before[name]) for name in still])
    common = se3.retract(np.eye(4), delta.mean(axis=0))
    mean = np.zeros((n, len(poses.covariance)))
    for i in at:
        mean[:, i : i + n] = np.eye(n) / len(still)
    out = []
    for name in seen:
        T_before = common @ poses.before[name]
        local = se3.inverse(T_before) @ poses.T_world_color[name]
        i = n * poses.cameras.index(name)
        select = -mean.copy()
        select[:, i : i + n] += np.eye(n)
        Ad = se3.adjoint(se3.inverse(T_before))
        C = Ad @ select @ poses.covariance @ select.T @ Ad.T
        out.append(
            Moved(
                name,
                float(np.linalg.norm(local[:3, 3])),
                float(so3.angle_rad(local[:3, :3])),
                float(np.sqrt(np.trace(C[3:, 3:]))),
                float(np.sqrt(np.trace(C[:3, :3]))),
            )
        )
    return tuple(out)
