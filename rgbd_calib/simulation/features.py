"""The paper's synthetic study: cameras in a furnished room and random points that all of them see.

Section 6 of the paper takes V-REP scenes with chairs, a table and sofas, two or four cameras with overlapping fields
of view and the world in camera C1, and extracts points visible to all cameras, without the floor.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.rig import look_at
from rgbd_calib.simulation.room import CEILING, FLOOR, RUG, furnished_room
from rgbd_calib.simulation.scene import Caster, Scene

_DISCARDED = (FLOOR.name, RUG.name, CEILING.name)
_BATCH = 4096
_ROUNDS = 400
_SAME_M = 1e-3
"""A camera sees a point if its ray ends this near: single precision leaves 1e-6 m."""

# places in the room, metres, about 1.3 m apart, on a line that bends around the furniture along the back wall
_PLACES_M = {
    2: ((-0.7, -1.0, 1.5), (0.6, -1.05, 1.6)),
    4: ((-1.85, -0.5, 1.55), (-0.75, -1.05, 1.65), (0.55, -1.1, 1.55), (1.6, -0.6, 1.6)),
}
_TARGET_M = (-0.2, 1.75, 0.6)


def paper_scene(n_cameras: int) -> tuple[Scene, dict[str, Intrinsics], dict[str, FloatArray]]:
    """Scene in the world's frame, intrinsics, and T_world_color (4, 4) by camera, for 2 or 4 cameras.

    The cameras stand about 1.3 m apart and look at furniture 2-4 m away. Ideal lenses, 640 x 480, f = 525 px, as the
    paper takes intrinsics for known.
    """
    if n_cameras not in _PLACES_M:
        raise ValueError(f"{n_cameras} cameras asked for; the paper's study has 2 or 4")
    intrinsics, T_room_color = {}, {}
    for i, place in enumerate(_PLACES_M[n_cameras]):
        intrinsics[f"C{i + 1}"] = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
        T_room_color[f"C{i + 1}"] = look_at(np.array(place), np.array(_TARGET_M))
    T_world_room = se3.inverse(T_room_color["C1"])
    T_world_color = {c: T_world_room @ T for c, T in T_room_color.items()}
    T_world_color["C1"] = np.eye(4)
    return furnished_room().moved(T_world_room), intrinsics, T_world_color


def visible_points(
    scene: Scene | Caster,
    intrinsics: Mapping[str, Intrinsics],
    T_world_color: Mapping[str, FloatArray],
    n: int,
    rng: np.random.Generator,
    max_depth_m: float = 6.0,
) -> FloatArray:
    """Random points (n, 3), metres, in the world's frame, on surfaces that every camera sees; floor and ceiling do not
    count.

    They are drawn evenly over the image of a random camera each, the way feature detectors find them. For many calls
    pass a :class:`Caster`, which is built once.

    Raises
    ------
    CalibrationError
        The cameras see too little in common.
    """
    caster = scene if isinstance(scene, Caster) else Caster(scene)
    discarded = np.concatenate([caster.scene.quads_of(name) for name in _DISCARDED])
    names = list(intrinsics)
    found: list[FloatArray] = []
    for _ in range(_ROUNDS):
        candidates = []
        for name in names:
            K, T = intrinsics[name], T_world_color[name]
            size = np.array([K.width, K.height])
            rays = K.rays(rng.random((_BATCH // len(names), 2)) * size - 0.5)
            hits = caster.cast(T[:3, 3], rays @ T[:3, :3].T)
            good = (hits.quad >= 0) & (hits.t < max_depth_m) & ~np.isin(hits.quad, discarded)
            candidates.append(se3.transform(T, rays[good] * hits.t[good, None]))
        points = rng.permutation(np.concatenate(candidates))
        seen = np.all([_sees(caster, intrinsics[c], T_world_color[c], points, max_depth_m) for c in names], axis=0)
        found.append(points[seen])
        if sum(map(len, found)) >= n:
            return np.concatenate(found)[:n]
    raise CalibrationError(
        f"scene: {sum(map(len, found))} points seen by all of {', '.join(names)}, {n} needed. "
        "Turn the cameras towards the same place"
    )


def _sees(caster: Caster, K: Intrinsics, T_world_color: FloatArray, p_world: FloatArray, max_m: float) -> np.ndarray:
    """Which points (n, 3) one camera sees, (n,) bool."""
    p_color = se3.transform(se3.inverse(T_world_color), p_world)
    ahead = (p_color[:, 2] > 0.1) & (p_color[:, 2] < max_m)
    px = K.project(np.where(ahead[:, None], p_color, [0.0, 0.0, 1.0]))
    inside = ahead & np.all((px > -0.5) & (px < np.array([K.width, K.height]) - 0.5), axis=1)
    hits = caster.cast(T_world_color[:3, 3], p_world - T_world_color[:3, 3])
    distance = np.linalg.norm(p_world - T_world_color[:3, 3], axis=1)
    same: np.ndarray = np.abs(hits.t - 1) * distance < _SAME_M
    return inside & same
