"""Which corner is which: faces, half turns, views in the wrong place, cameras that nothing joins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import (
    BOARD,
    CORNER_NOISE,
    EVEN_BOARD,
    TWO_SIDED,
    arc,
    around,
    board_poses,
    placed_truly,
    pose_errors,
    ring,
    turn_some,
)

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, BoardView, Rig
from rgbd_calib.views.association import associate
from rgbd_calib.views.board_pose import pose_view

MAX_ROTATION_RAD, MAX_SHIFT_M = np.radians(1.0), 0.04
"""Of rough poses from single views at 2 m: a board of 0.5 m with 0.1 px of noise is tilted by 0.2 degrees at most, which
moves the other camera by 7 mm; the mean over frames is better, a chain of three worse, the lenses are exact."""


def posed(views, rig: Rig, board: Board):
    return [pose_view(view, board, rig.cameras[view.camera].intrinsics, None) for view in views]


def drawn(rig: Rig, board: Board, frames: int, seed: int):
    rng = np.random.default_rng(seed)
    boards = board_poses(rig, board, frames, rng)
    return boards, true_views(rig, boards, board, CORNER_NOISE, rng), rng


def check_rough(result, rig: Rig) -> None:
    for name, (rotation_rad, shift_m) in pose_errors(result.T_world_color, rig).items():
        assert rotation_rad < MAX_ROTATION_RAD, name
        assert shift_m < MAX_SHIFT_M, name


def check_choices(result, truth, board: Board) -> None:
    """Every two views of a frame give the same number to the same corner of the board, or to no other point: a frame
    read from its other side or end as a whole is as right."""
    true_of = {(p.view.camera, p.view.frame): p for p in truth}
    by_frame: dict[str, list] = {}
    for placed in result.views:
        by_frame.setdefault(placed.view.frame, []).append(placed)
    for frame, views in by_frame.items():
        motions = set()
        for placed in views:
            true = true_of[placed.view.camera, frame]
            motions.add((placed.back ^ true.back, placed.turned ^ true.turned))
        assert len(motions) == 1, frame


def true_choices(rig, boards, views, board, turned=frozenset()):
    return [replace(p, turned=(p.view.camera, p.view.frame) in turned) for p in placed_truly(rig, boards, views, board)]


@pytest.mark.parametrize("seed", range(3))
def test_odd_board_on_an_arc(seed):
    rig = arc(4)
    _, views, _ = drawn(rig, BOARD, 10, seed)
    result = associate(posed(views, rig, BOARD), BOARD, "C1", list(rig.cameras))
    check_rough(result, rig)
    assert result.dropped == {}
    assert len(result.views) == len(views)
    assert not any(p.back or p.turned for p in result.views)
    assert all(p.rival_votes == 0 for p in result.pairs)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.4, 1.0])
def test_half_turns_of_an_even_board(share):
    rig = arc(3)
    boards, views, rng = drawn(rig, EVEN_BOARD, 12, 1)
    views, turned = turn_some(views, EVEN_BOARD, share, rng)
    result = associate(posed(views, rig, EVEN_BOARD), EVEN_BOARD, "C1", list(rig.cameras))
    check_rough(result, rig)
    assert result.dropped == {}
    assert len(result.views) == len(views)
    check_choices(result, true_choices(rig, boards, views, EVEN_BOARD, turned), EVEN_BOARD)


@pytest.mark.parametrize("seed", range(3))
def test_faces_of_a_two_sided_board_in_a_ring(seed):
    rig = ring(4)
    boards, views, _ = drawn(rig, TWO_SIDED, 16, seed)
    truth = true_choices(rig, boards, views, TWO_SIDED)
    result = associate(posed(views, rig, TWO_SIDED), TWO_SIDED, "C1", list(rig.cameras))
    check_rough(result, rig)
    assert result.dropped == {}
    check_choices(result, truth, TWO_SIDED)


def test_same_and_opposite_faces_for_the_same_pair():
    """Two cameras 100 degrees apart: a board between them shows one face to both, or one to each, in one recording."""
    rig = around([-50.0, 50.0])
    boards, views, _ = drawn(rig, TWO_SIDED, 40, 0)
    truth = true_choices(rig, boards, views, TWO_SIDED)
    faces = {f: {p.back for p in truth if p.view.frame == f} for f in boards}
    assert {len(kinds) for kinds in faces.values()} == {1, 2}  # both kinds occur
    result = associate(posed(views, rig, TWO_SIDED), TWO_SIDED, "C1", list(rig.cameras))
    check_rough(result, rig)
    check_choices(result, truth, TWO_SIDED)
    assert len(result.views) == len(views)


def test_half_turns_and_faces_together():
    board = replace(EVEN_BOARD, two_sided=True, thickness_m=0.01)
    rig = ring(5)
    boards, views, rng = drawn(rig, board, 24, 3)
    views, turned = turn_some(views, board, 0.3, rng)
    result = associate(posed(views, rig, board), board, "C1", list(rig.cameras))
    check_rough(result, rig)
    assert result.dropped == {}
    check_choices(result, true_choices(rig, boards, views, board, turned), board)


def test_reference_and_names_are_free():
    rig = arc(3, names=["left", "middle", "0"])
    _, views, _ = drawn(rig, BOARD, 8, 0)
    result = associate(posed(views, rig, BOARD), BOARD, "middle", list(rig.cameras))
    assert list(result.T_world_color) == ["left", "middle", "0"]
    np.testing.assert_array_equal(result.T_world_color["middle"], np.eye(4))
    back = se3.inverse(result.T_world_color["left"])
    check_rough(replace(result, T_world_color={n: back @ T for n, T in result.T_world_color.items()}), rig)


def test_a_view_in_the_wrong_place_is_dropped_and_named():
    rig = arc(3)
    boards, views, _ = drawn(rig, BOARD, 10, 2)
    frame = next(f for f in boards if len({v.camera for v in views if v.frame == f}) == 3)
    # the picture of another instant: the board is somewhere else
    other = next(v for v in views if v.camera == "C2" and v.frame != frame)
    wrong = [replace(other, frame=frame) if (v.camera, v.frame) == ("C2", frame) else v for v in views]
    result = associate(posed(wrong, rig, BOARD), BOARD, "C1", list(rig.cameras))
    assert list(result.dropped) == [("C2", frame)]
    assert "agrees in no reading with C1, C3" in result.dropped["C2", frame]
    check_rough(result, rig)


def only(views, frames_of: dict[str, set[str]]) -> list[BoardView]:
    return [v for v in views if v.frame in frames_of[v.camera]]


def test_two_groups_are_named_with_the_pair_to_film():
    rig = arc(4, 10.0)
    boards, views, _ = drawn(rig, BOARD, 12, 0)
    first, second = set(list(boards)[:6]), set(list(boards)[6:])
    views = only(views, {"C1": first, "C2": first, "C3": second, "C4": second})
    with pytest.raises(
        CalibrationError,
        match=r"not connected: .* groups \{C1, C2\} \| \{C3, C4\}; .* needed, .*\. Film C2 with C3 together",
    ):
        associate(posed(views, rig, BOARD), BOARD, "C1", list(rig.cameras))


def test_a_camera_that_never_saw_the_board_is_a_group():
    rig = arc(3)
    _, views, _ = drawn(rig, BOARD, 6, 0)
    views = [v for v in views if v.camera != "C2"]
    with pytest.raises(CalibrationError, match=r"groups \{C1, C3\} \| \{C2\}"):
        associate(posed(views, rig, BOARD), BOARD, "C1", list(rig.cameras))


@pytest.mark.parametrize("board", [EVEN_BOARD, TWO_SIDED], ids=["even", "two-sided"])
def test_one_common_view_of_a_board_that_can_be_read_twice(board):
    rig = arc(2)
    _, views, _ = drawn(rig, board, 1, 0)
    with pytest.raises(CalibrationError, match=r"^C1 and C2: 1 common view\(s\).* needed. Film this pair again"):
        associate(posed(views, rig, board), board, "C1", list(rig.cameras))


def test_one_common_view_of_an_odd_board_is_enough():
    rig = arc(2)
    _, views, _ = drawn(rig, BOARD, 1, 0)
    result = associate(posed(views, rig, BOARD), BOARD, "C1", list(rig.cameras))
    check_rough(result, rig)


def test_a_back_that_is_read_by_another_corner_is_named():
    """cols and rows exchanged, or the back glued upside down: cameras that see opposite faces agree in no frame."""
    rig = around([-50.0, 50.0])
    _, views, _ = drawn(rig, TWO_SIDED, 40, 0)
    truth = {(p.view.camera, p.view.frame): p for p in true_choices(rig, *drawn(rig, TWO_SIDED, 40, 0)[:2], TWO_SIDED)}
    upside = [replace(v, ids=TWO_SIDED.n_corners - 1 - v.ids) if truth[v.camera, v.frame].back else v for v in views]
    with pytest.raises(CalibrationError, match=r"back's corners are rotated by 180.*Exchange cols and rows"):
        associate(posed(upside, rig, TWO_SIDED), TWO_SIDED, "C1", list(rig.cameras))


def test_a_board_with_a_second_face_that_is_not_stated_is_named():
    rig = ring(4)
    _, views, _ = drawn(rig, TWO_SIDED, 16, 1)
    board = replace(TWO_SIDED, two_sided=False, thickness_m=0.0)
    found = associate(posed(views, rig, board), board, "C1", list(rig.cameras))
    causes = [p.cause for p in found.pairs if p.cause]
    assert causes and all("two_sided: true" in c.advice for c in causes)


@pytest.mark.parametrize("board", [BOARD, EVEN_BOARD, TWO_SIDED], ids=["odd", "even", "two-sided"])
def test_images_that_are_mirrored_are_named(board):
    """C2's images flipped left to right; the finder reads the mirrored print as the print, upside down."""
    rig = arc(2)
    _, views, _ = drawn(rig, board, 16, 1)
    flip, of_board = np.diag([-1.0, 1, 1, 1]), np.diag([1.0, -1, 1, 1])
    of_board[1, 3] = (board.rows - 1) * board.square_m
    mirrored = [
        replace(v, T_color_face=flip @ v.T_color_face @ of_board) if v.view.camera == "C2" else v
        for v in posed(views, rig, board)
    ]
    with pytest.raises(CalibrationError, match=r"the images of C[12] are mirrored .*Switch mirroring off"):
        associate(mirrored, board, "C1", list(rig.cameras))


@pytest.mark.parametrize("board", [BOARD, TWO_SIDED], ids=["odd", "two-sided"])
def test_cameras_that_were_mounted_anew_are_named_with_the_frame(board):
    before, after = arc(3), arc(3, 35.0)
    boards, views, rng = drawn(before, board, 24, 3)
    names = sorted(boards)
    late = true_views(after, {f: boards[f] for f in names[11:]}, board, CORNER_NOISE, rng)
    mixed = [*(v for v in views if v.frame < names[11]), *late]
    with pytest.raises(CalibrationError, match=rf"relative pose changed at frame {names[11]}.*mounted anew"):
        associate(posed(mixed, before, board), board, "C1", list(before.cameras))


def test_no_change_is_seen_where_frames_agree_on_nothing():
    rig = arc(2)
    _, views, _ = drawn(rig, BOARD, 24, 3)
    frames = sorted({v.frame for v in views})
    following = dict(zip(frames, [*frames[1:], frames[0]], strict=True))
    late = [replace(v, frame=following[v.frame]) if v.camera == "C2" else v for v in views]
    try:
        pairs = associate(posed(late, rig, BOARD), BOARD, "C1", list(rig.cameras)).pairs
    except CalibrationError as error:
        assert "pose changed at frame" not in str(error)
    else:
        assert [p.cause for p in pairs] == [None]
