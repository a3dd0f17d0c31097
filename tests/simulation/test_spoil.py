"""Spoiled views: the chosen ones change in the way asked for, the others stay as they were."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.spoil import Kind, spoil, true_corners

PARAMS = SimulationParams(cameras=2, frames=5, intrinsic_views=0, distances_m=(), width=320, height=240, seed=7)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    simulate(folder, PARAMS, 1, progress)
    return folder


@pytest.mark.parametrize("kind", get_args(Kind))
def test_spoils_the_chosen_views_and_no_other(kind, demo, tmp_path):
    corners = true_corners(demo / "true_corners.csv")
    chosen = spoil(demo / "extrinsic", tmp_path / "out", kind, corners, 0.2, np.random.default_rng(1))
    again = spoil(demo / "extrinsic", tmp_path / "again", kind, corners, 0.2, np.random.default_rng(1))
    assert chosen == again and len(chosen) == max(1, round(0.2 * len(corners)))
    before, after, twice = (open_recording(p) for p in (demo / "extrinsic", tmp_path / "out", tmp_path / "again"))
    assert after.digest() == twice.digest()
    for c, frames in before.color_files.items():
        for f in frames:
            color = np.array_equal(before.color(c, f), after.color(c, f))
            depth = np.array_equal(before.depth_m(c, f), after.depth_m(c, f), equal_nan=True)
            if (c, f) not in chosen:
                assert color and depth
            else:
                assert color == (kind in ("hand", "late_depth"))
                assert depth == (kind in ("clutter", "turned", "blurred"))


def test_hand_is_5_to_15_cm_nearer(demo, tmp_path):
    corners = true_corners(demo / "true_corners.csv")
    (c, f), *_ = spoil(demo / "extrinsic", tmp_path / "out", "hand", corners, 0.1, np.random.default_rng(2))
    difference_m = open_recording(demo / "extrinsic").depth_m(c, f) - open_recording(tmp_path / "out").depth_m(c, f)
    changed = difference_m[np.abs(np.nan_to_num(difference_m)) > 1e-9]
    assert changed.min() > 0.048 and changed.max() < 0.152
    assert changed.size > 20


def test_refuses_an_unknown_kind(demo, tmp_path):
    with pytest.raises(ConfigError, match="'rain' seen"):
        spoil(demo / "extrinsic", tmp_path / "out", "rain", {}, 0.1, np.random.default_rng(0))
