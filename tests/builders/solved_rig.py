"""Bundles of drawn views, for what judges them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import synthetic_views as sv

from rgbd_calib.rig.bundle import bundle
from rgbd_calib.rig.setup import CameraPrior
from rgbd_calib.rig.solution import Solution
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.types import DepthBias, Rig

NOISE = ViewNoise(0.1, 0.7e-3, 0.0)
BIAS_SD = np.diag([1e-3, 1e-3, 5e-4]) ** 2


def solved(
    rig: Rig, seed: int, frames: int = 14, change=lambda views, rng: views, time_of_flight: bool = False
) -> tuple[Solution, list[str]]:
    """A bundle of drawn views, those of each camera alone among them, with priors drawn about the truth; time of flight has none
    of its depth."""
    rng = np.random.default_rng(seed)
    boards = sv.board_poses(rig, sv.BOARD, frames, rng)
    views = change(list(true_views(rig, boards, sv.BOARD, NOISE, rng)), rng)
    placed = list(sv.placed_truly(rig, boards, views, sv.BOARD))
    close = sv.board_poses(rig, sv.BOARD, 10, rng)
    single = sv.placed_truly(rig, close, true_views(rig, close, sv.BOARD, NOISE, rng), sv.BOARD)
    placed += [replace(p, view=p.view.as_alone()) for p in single]
    priors = {}
    for name, own in rig.cameras.items():
        lens = own.intrinsics.vector + rng.normal(0, 1, 9) * [2, 2, 2, 2, 0.01, 0.01, 1e-4, 1e-4, 0]
        drawn = rng.multivariate_normal(own.depth_bias.coefficients, BIAS_SD)
        bias = DepthBias(tuple(drawn), own.depth_bias.min_m, own.depth_bias.max_m, 0.0, BIAS_SD)
        depth = None if time_of_flight else bias
        priors[name] = CameraPrior(own.intrinsics.with_vector(lens), None, True, depth, time_of_flight=time_of_flight)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    return bundle(placed, sv.BOARD, priors, T, "C1"), sorted(boards)


def moved_from(views, frame: str, camera: str, change):
    """The views, those of a camera from a frame on changed."""
    return [change(v) if v.camera == camera and v.frame >= frame else v for v in views]
