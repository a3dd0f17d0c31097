"""Refinement by whole clouds where no features match: nearest neighbours stand in for the 3D correspondences.

The paper (end of its section 5) lets the ICP term use all 3D points "with the help of nearest neighbor correspondence".
For each pair of cameras the points of either cloud take their nearest neighbour in the other, both ways; pairs further
apart than a bound are out, and of the rest only the best `overlap` share stays (trimming: what one camera alone sees has
no partner). Each pair of neighbours is one point that two cameras see, so that the refinement itself is the same, with
pixels or without; then neighbours are sought again, until the poses rest.

Limits: point to point, as in the paper. Neighbours slide along smooth surfaces, so that convergence is slow and the
start must be good to about the bound; sigma_3D is then the distance of neighbours (sampling and all), the pairs are not
independent, and the covariance is too small. It is for rigs where no board was seen, or to polish one that is known.

It is the paper's term, for comparison with the paper, and called from Python alone. The command `refine RIG --clouds` is
another estimator, point to plane with a covariance that holds (:mod:`rgbd_calib.trust.snapshot.cloud_fusion`).

References
----------
P. Besl, N. McKay, PAMI 14(2), 1992 (ICP); D. Chetverikov, D. Stepanov, P. Krsek, IVC 23(3), 2005 (trimming).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.estimate import refine
from rgbd_calib.rig.biobjective.params import RefinementParams, RefinementResult
from rgbd_calib.types import Correspondences, IntArray

_MIN_PAIRS = 20
"""Fewer neighbours than this between two clouds are chance."""


@dataclass(frozen=True)
class CloudParams:
    """How neighbours are chosen, and when to stop."""

    max_distance_m: float = 0.1
    """Neighbours further apart do not match; halved, down to `min_distance_m`, whenever the poses rest."""
    min_distance_m: float = 0.02
    overlap: float = 0.7
    """Share of the neighbours within the bound, the nearest, that stays."""
    max_points: int = 5000
    """Of each cloud, drawn at random with `seed`; the neighbours come from the whole of the other cloud."""
    max_matchings: int = 200
    step_tolerance_m: float = 1e-4
    """A matching that moves no point of the clouds further than this has come to rest."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.overlap <= 1:
            raise ConfigError(f"clouds.overlap: {self.overlap} given, a share between 0 and 1 needed")
        if not 0 < self.min_distance_m <= self.max_distance_m:
            raise ConfigError("clouds.max_distance_m: needs 0 < min_distance_m <= max_distance_m")


@dataclass(frozen=True)
class CloudResult:
    """The last refinement, and how its neighbours were found."""

    refinement: RefinementResult
    matchings: int
    settled: bool
    n_pairs: dict[tuple[str, str], int]
    """Neighbours used, by pair of cameras."""
    rms_m: float
    """Of the distances of the neighbours used."""


def refine_clouds(
    clouds: dict[str, FloatArray],
    T_world_color: dict[str, FloatArray],
    reference: str,
    params: RefinementParams = RefinementParams(method="icp"),  # noqa: B008  (frozen)
    matching: CloudParams = CloudParams(),
    pixels: Correspondences | None = None,
    intrinsics: dict[str, Intrinsics] | None = None,
) -> CloudResult:
    """Poses refined by clouds (n, 3), metres, in each colour camera's frame.

    With method biobjective, `pixels` brings the 2D features (its own 3D points are left out) and `intrinsics` the
    cameras.

    Raises
    ------
    CalibrationError
        Clouds that are not finite, overlap too little at the start, or do not fix the poses.
    """
    cameras = _check(clouds, T_world_color, params, pixels)
    rng = np.random.default_rng(matching.seed)
    trees = {c: cKDTree(clouds[c]) for c in cameras}
    samples = {c: rng.permutation(len(clouds[c]))[: matching.max_points] for c in cameras}
    ideal = intrinsics or {
        c: Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5) for c in cameras
    }  # without pixels unused
    poses, bound_m, settled = dict(T_world_color), matching.max_distance_m, False
    for count in range(1, matching.max_matchings + 1):  # noqa: B007  (told in the result)
        pairs = {
            (a, b): _neighbours(clouds, trees, samples, poses, (a, b), bound_m, matching.overlap)
            for a, b in combinations(cameras, 2)
        }
        data = _correspondences(cameras, clouds, pairs, pixels)
        result = refine(data, ideal, poses, reference, params)
        moved = max(_motion(clouds[c], poses[c], result.T_world_color[c]) for c in cameras)
        poses = result.T_world_color
        settled = moved < matching.step_tolerance_m
        if settled and bound_m <= matching.min_distance_m:
            break
        if settled:
            bound_m = max(bound_m / 2, matching.min_distance_m)
    distances = [
        se3.transform(poses[a], clouds[a][i]) - se3.transform(poses[b], clouds[b][j])
        for (a, b), (i, j) in pairs.items()
    ]
    rms_m = float(np.sqrt(np.mean(np.sum(np.concatenate(distances) ** 2, axis=1))))
    return CloudResult(result, count, settled, {pair: len(i) for pair, (i, _) in pairs.items()}, rms_m)


def _neighbours(
    clouds: dict[str, FloatArray],
    trees: Mapping[str, cKDTree],
    samples: dict[str, IntArray],
    poses: dict[str, FloatArray],
    pair: tuple[str, str],
    bound_m: float,
    overlap: float,
) -> tuple[IntArray, IntArray]:
    """Numbers of neighbouring points in the two clouds of a pair, found both ways, each pair once."""
    found = []
    for a, b in (pair, pair[::-1]):
        T_b_a = se3.inverse(poses[b]) @ poses[a]
        own = samples[a]
        distance, other = map(
            np.asarray, trees[b].query(se3.transform(T_b_a, clouds[a][own]), distance_upper_bound=bound_m)
        )
        near = np.flatnonzero(np.isfinite(distance))
        near = near[np.argsort(distance[near], kind="stable")][: int(np.ceil(overlap * len(near)))]
        columns = (own[near], other[near]) if a == pair[0] else (other[near], own[near])
        found.append(np.stack(columns, axis=1))
    first, second = np.unique(np.concatenate(found), axis=0).T
    empty = np.empty(0, int)
    return (first, second) if len(first) >= _MIN_PAIRS else (empty, empty)


def _correspondences(
    cameras: tuple[str, ...],
    clouds: dict[str, FloatArray],
    pairs: dict[tuple[str, str], tuple[IntArray, IntArray]],
    pixels: Correspondences | None,
) -> Correspondences:
    """Each pair of neighbours as one point that two cameras measure, behind the points of `pixels`."""
    base = len(pixels.labels) if pixels else 0
    number, point, xyz = [], [], []
    labels: list[tuple[str, str]] = []
    for (a, b), (i, j) in pairs.items():
        new = base + len(labels) + np.arange(len(i))
        labels += [("cloud", f"{a}-{b}-{n}") for n in range(len(i))]
        for camera, rows in ((a, i), (b, j)):
            number.append(np.full(len(rows), cameras.index(camera)))
            point.append(new)
            xyz.append(clouds[camera][rows])
    none = np.empty(0, int)
    return replace(
        pixels or Correspondences(cameras, (), none, none, np.empty((0, 2)), none, none, np.empty((0, 3))),
        labels=(*(pixels.labels if pixels else ()), *labels),
        xyz_camera=np.concatenate(number),
        xyz_point=np.concatenate(point),
        xyz_m=np.concatenate(xyz),
        xyz_covariance=None,
    )


def _motion(cloud: FloatArray, T_before: FloatArray, T_after: FloatArray) -> float:
    """Furthest way, metres, of a corner of the cloud's bounding box."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)
    return float(np.max(np.linalg.norm(se3.transform(T_after, corners) - se3.transform(T_before, corners), axis=1)))


def _check(
    clouds: dict[str, FloatArray],
    T_world_color: dict[str, FloatArray],
    params: RefinementParams,
    pixels: Correspondences | None,
) -> tuple[str, ...]:
    if (pixels is None) != (params.method == "icp"):
        raise ConfigError(
            f"refine_clouds: method {params.method} {'needs' if pixels is None else 'takes no'} pixel features"
        )
    cameras = pixels.cameras if pixels else tuple(clouds)
    for camera in cameras:
        if camera not in clouds or len(clouds[camera]) < _MIN_PAIRS:
            raise CalibrationError(
                f"{camera}: cloud of {len(clouds.get(camera, ()))} points, {_MIN_PAIRS} or more needed. Record its depth"
            )
        if not np.all(np.isfinite(clouds[camera])):
            raise CalibrationError(f"{camera}: cloud with NaN or infinite points. Leave out what was not measured")
        if camera not in T_world_color:
            raise CalibrationError(
                f"{camera}: no starting pose given, needed to find neighbours. Place the camera first"
            )
    return cameras
