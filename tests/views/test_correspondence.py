"""Views become correspondences: the same physical corner, carried through the board's thickness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import (
    BOARD,
    EVEN_BOARD,
    EXACT,
    arc,
    around,
    board_poses,
    half_turned,
    placed_truly,
    ring,
    without_depth,
)

from rgbd_calib.geometry import camera, se3
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, Rig
from rgbd_calib.views.correspondence import correspond

THICK = Board(9, 6, 0.06, True, 0.02)


def noise_free(rig: Rig, board: Board, frames: int = 8, seed: int = 0):
    rng = np.random.default_rng(seed)
    boards = board_poses(rig, board, frames, rng)
    return boards, placed_truly(rig, boards, true_views(rig, boards, board, EXACT, rng), board)


def check_exact(rig: Rig, boards, data, board: Board) -> None:
    """Pixels and points are those of the front's corners, whoever saw them from which side."""
    front = board.corners_m()
    world = np.array([se3.transform(boards[frame], front[[int(k)]])[0] for frame, k in data.labels])
    names = list(rig.cameras)
    for c, p, px in zip(data.pixel_camera, data.pixel_point, data.pixels_px, strict=True):
        own = rig.cameras[names[c]]
        x = se3.transform(se3.inverse(own.T_world_color), world[[p]])
        np.testing.assert_allclose(camera.project(own.intrinsics.vector, x)[0], px, atol=1e-8)
    for c, p, xyz in zip(data.xyz_camera, data.xyz_point, data.xyz_m, strict=True):
        seen = se3.transform(rig.cameras[names[c]].T_world_color, xyz[None])[0]
        np.testing.assert_allclose(seen, world[p], atol=1e-9)


@pytest.mark.parametrize("rig", [ring(4), around([0.0, 180.0]), around([-50.0, 50.0], biased=True)])
def test_thickness_is_carried(rig):
    boards, placed = noise_free(rig, THICK)
    assert {p.back for p in placed} == {False, True}
    data = correspond(placed, THICK, rig.cameras)
    assert len(data.pixels_px) == len(data.xyz_m) > 200
    check_exact(rig, boards, data, THICK)


def test_without_the_thickness_opposed_cameras_disagree_by_it():
    """Negative control."""
    rig = around([0.0, 180.0])
    _, placed = noise_free(rig, THICK, 1)
    data = correspond(placed, replace(THICK, thickness_m=0.0), rig.cameras)
    own = [rig.cameras[n].T_world_color for n in rig.cameras]
    seen = [
        {
            int(q): se3.transform(T, x[None])[0]
            for q, x in zip(data.xyz_point[data.xyz_camera == i], data.xyz_m[data.xyz_camera == i], strict=True)
        }
        for i, T in enumerate(own)
    ]
    gaps = [np.linalg.norm(seen[0][k] - seen[1][k]) for k in seen[0]]
    np.testing.assert_allclose(gaps, 0.02, atol=1e-9)


def test_half_turned_views_give_the_same_points():
    rig = arc(3)
    boards, placed = noise_free(rig, EVEN_BOARD)
    some = [
        replace(p, view=half_turned(p.view, EVEN_BOARD), turned=True) if i % 3 == 1 else p for i, p in enumerate(placed)
    ]
    check_exact(rig, boards, correspond(some, EVEN_BOARD, rig.cameras), EVEN_BOARD)


def test_frames_of_one_camera_and_corners_of_one_camera_are_left_out():
    rig = arc(2)
    _, placed = noise_free(rig, BOARD, 3)
    frames = sorted({p.view.frame for p in placed})
    alone = [p for p in placed if p.view.frame != frames[0] or p.view.camera == "C1"]
    data = correspond(alone, BOARD, rig.cameras)
    assert {frame for frame, _ in data.labels} == set(frames[1:])
    # halves of the board that have 18 corners in common
    part = []
    for p in placed:
        ids = np.arange(36) if p.view.camera == "C1" else np.arange(18, 54)
        view = replace(p.view, ids=ids, corners_px=p.view.corners_px[ids], depth_m=p.view.depth_m[ids])
        part.append(replace(p, view=view))
    data = correspond(part, BOARD, rig.cameras)
    assert len(data.pixels_px) == 3 * 2 * 18


def test_missing_depth_is_a_pixel_alone():
    rig = arc(3)
    boards, placed = noise_free(rig, BOARD, 4)
    placed = [replace(p, view=without_depth(p.view)) if p.view.camera == "C2" else p for p in placed]
    data = correspond(placed, BOARD, rig.cameras)
    assert set(data.xyz_camera.tolist()) == {0, 2}
    assert set(data.pixel_camera.tolist()) == {0, 1, 2}
    check_exact(rig, boards, data, BOARD)


def test_nothing_in_common_is_no_correspondence():
    rig = arc(2)
    _, placed = noise_free(rig, BOARD, 2)
    data = correspond([p for p in placed if p.view.camera == "C1"], BOARD, rig.cameras)
    assert data.pixels_px.shape == (0, 2)
    assert data.xyz_m.shape == (0, 3)
    assert data.labels == ()
