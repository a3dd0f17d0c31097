"""Rows of a rig's parameters from patches of surface that two of its cameras see from the same side.

Cameras a and b put a patch at P_a and P_b, in the world, with the mean normal n. With the parameters theta = L u off by
L L' = Sigma, the rig's joint covariance, and u ~ N(0, I),

    n . (P_b - P_a) + n . (J_b - J_a) L u + s . q = e           J the derivatives of places, :mod:`..uncertainty`

q ~ N(0, I) is what the depth errs by beyond the parameters, alike for all patches in one cell of a camera's image: the fine
pattern of its depth; and where the bias is held outside its range, alike for all patches of the camera. e is the noise of a
patch, with its deviation up to one factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import sparse

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.common_errors import DEPTH_GRID
from rgbd_calib.trust import uncertainty
from rgbd_calib.trust.snapshot.clouds import SharedPatches, shared_patches
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.trust.uncertainty import JointCovariance, Observed
from rgbd_calib.types import Rig, RigCamera

LEAST_PATCHES = 50
"""Fewer in common are chance."""
_CELLS = (8, 6)
"""Of an image, across and down: what the residuals in one of them share counts as noise in common."""
_MOST_PATCHES = 6000
"""Of all pairs together, evenly over each: what they share bounds the result, not their number."""
_SHARED = DEPTH_GRID[0] * DEPTH_GRID[1] + 1
"""Of q, by camera: of the cells in which depths err alike, and of all together."""
_ROUNDING_M = 0.2e-3


@dataclass(frozen=True)
class CloudRows:
    """Of all pairs of cameras, n rows."""

    pairs: tuple[tuple[str, str], ...]
    """One entry for each instant that a pair has patches of."""
    pair: np.ndarray
    """(n,), number of the pair."""
    distance_m: FloatArray
    """(n,), n . (P_b - P_a)."""
    J: FloatArray
    """(n, P), derivatives by the parameters of the joint covariance."""
    shared: sparse.csr_array
    """(n, M), s."""
    sigma_m: FloatArray
    """(n,), noise expected."""
    cell: np.ndarray
    """(n,), number of the pair's cell of the image that the patch is in."""


def cloud_rows(rig: Rig, joint: JointCovariance, instants: Sequence[Mapping[str, Surface]]) -> CloudRows | None:
    """Rows of what the cameras saw at some instants, of the pairs of cameras that have `LEAST_PATCHES` in common at one of
    them; None where there are none."""
    pairs, found = [], []
    for surfaces in instants:
        for pair in combinations(surfaces, 2):
            order, patches = _coarser(rig, surfaces, pair)
            if np.count_nonzero(patches.wide) >= LEAST_PATCHES:
                found.append((surfaces, order, patches))
                pairs.append(pair)
    if not pairs:
        return None
    total = sum(int(np.count_nonzero(patches.wide)) for _, _, patches in found)
    step = -(-total // _MOST_PATCHES)
    parts = [_of_pair(rig, joint, surfaces, order, patches, step) for surfaces, order, patches in found]
    number = np.repeat(np.arange(len(pairs)), [len(part.distance_m) for part in parts])
    return CloudRows(
        tuple(pairs),
        number,
        np.concatenate([part.distance_m for part in parts]),
        np.concatenate([part.J for part in parts]),
        sparse.csr_array(sparse.vstack([part.shared for part in parts])),
        np.concatenate([part.sigma_m for part in parts]),
        np.concatenate([part.cell for part in parts]) + number * _CELLS[0] * _CELLS[1],
    )


def _coarser(rig: Rig, surfaces: Mapping[str, Surface], pair: tuple[str, str]) -> tuple[tuple[str, str], SharedPatches]:
    """Patches of the camera that has fewer of the common surface, so that none of the other's is used twice."""
    found = []
    for a, b in (pair, pair[::-1]):
        T_a_b = se3.inverse(rig.cameras[a].T_world_color) @ rig.cameras[b].T_world_color
        found.append(((a, b), shared_patches(surfaces[a], surfaces[b], T_a_b)))
    return min(found, key=lambda one: np.count_nonzero(one[1].wide))


def _of_pair(
    rig: Rig,
    joint: JointCovariance,
    surfaces: Mapping[str, Surface],
    pair: tuple[str, str],
    patches: SharedPatches,
    step: int,
) -> CloudRows:
    T = rig.cameras[pair[0]].T_world_color
    points = [se3.transform(T, p) for p in (patches.points_a_m, patches.points_b_m)]
    looks = [
        uncertainty.observe(rig, name, p, _reach_m(rig.cameras[name])) for name, p in zip(pair, points, strict=True)
    ]
    used = np.flatnonzero(patches.wide & looks[0].seen & looks[1].seen)[::step]
    normals, n = patches.normals[used] @ T[:3, :3].T, len(used)
    J, variance = np.zeros((n, len(joint.matrix))), np.full(n, _ROUNDING_M**2)
    shared = sparse.csr_array((n, len(rig.cameras) * _SHARED))
    for sign, name, look in zip((-1.0, 1.0), pair, looks, strict=True):
        mine = look.only(used)
        at, by = uncertainty.by_parameters(rig, name, mine, joint)
        J[:, at] += sign * np.einsum("ni,nik->nk", normals, by)
        along = np.einsum("ni,ni->n", normals, uncertainty.rays_of(rig, name, mine))
        variance += (surfaces[name].k_per_m * mine.z_m**2 * along) ** 2
        column, value = _beyond(rig, name, mine, normals, along)
        column += list(rig.cameras).index(name) * _SHARED
        shared = shared + sign * sparse.csr_array((value, (np.tile(np.arange(n), 2), column)), shape=shared.shape)
    cell = _cells(patches.grid[used], surfaces[pair[0]].shape, _CELLS)
    distance = patches.distance_m[used]
    return CloudRows((pair,), np.zeros(n, int), distance, J, sparse.csr_array(shared), np.sqrt(variance), cell)


def _reach_m(camera: RigCamera) -> float:
    """Up to which the error of a camera's depth is known."""
    return max(uncertainty.FARTHEST_M, camera.depth_bias.max_m if camera.depth_bias is not None else 0.0)


def _beyond(
    rig: Rig, name: str, look: Observed, normals: FloatArray, along: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Columns and values (2 n,) of one sigma of a camera's depth beyond its parameters: in each cell, and in all of them;
    `along` (n,) is by how much a metre of depth moves a patch along its normal."""
    field, lens = rig.cameras[name].depth_field, rig.cameras[name].depth_sensor.camera.intrinsics
    fine_m = np.zeros(len(look.z_m))
    if isinstance(field, PolynomialField):
        fine_m = np.sqrt(field.pattern_variance_m2(look.raw_m))
    held = np.einsum("ni,ni->n", normals, uncertainty.by_held_depth(rig, name, look))
    cell = _cells(look.depth_pixels_px, (lens.height, lens.width), DEPTH_GRID)
    return np.concatenate([cell, np.full(len(cell), _SHARED - 1)]), np.concatenate([fine_m * along, held])


def _cells(pixels_px: FloatArray, shape: tuple[int, int], grid: tuple[int, int]) -> np.ndarray:
    """Number (n,) of the cell of the image (h, w) that pixels (n, 2) are in."""
    at = np.floor((pixels_px + 0.5) / [shape[1], shape[0]] * grid).astype(int)
    across, down = np.clip(at, 0, np.array(grid) - 1).T
    return np.asarray(down * grid[0] + across)
