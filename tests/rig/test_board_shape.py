"""The print as the bundle finds it: against the truth, in the rig file, and given back."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import synthetic_views as sv
from test_bundle import NOISE, draw, priors_of

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import align, se3
from rgbd_calib.io.board_files import read_board
from rgbd_calib.io.dataset import CameraInfo, write_dataset
from rgbd_calib.io.quality import quality_of
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.patterns import of_type
from rgbd_calib.pipeline.properties import properties_of
from rgbd_calib.pipeline.rig_inputs import board_for
from rgbd_calib.quality import Quality
from rgbd_calib.rig.bundle import bundle
from rgbd_calib.rig.setup import BundleParams, CameraPrior
from rgbd_calib.simulation.views import true_views
from rgbd_calib.trust.self_check import SelfCheckParams
from rgbd_calib.trust.self_check.calibration import check_bundle
from rgbd_calib.types import Board, BoardShape, Rig, RigCamera
from rgbd_calib.views.association import AssociationResult
from rgbd_calib.views.board_pose import repose


def misprinted(board: Board, rng: np.random.Generator) -> Board:
    """0.4 % too wide, every corner 0.2 mm off, the plate bent by a millimetre."""
    flat = board.corners_m()
    middle = flat.mean(axis=0)
    x = (flat - middle) / np.abs(flat - middle).max(axis=0).clip(1e-9)
    moved = middle + (flat - middle) * [1.002, 0.998, 1.0]
    moved[:, :2] += rng.normal(0, 2e-4, (len(flat), 2))
    moved[:, 2] += 1e-3 * x[:, 0] ** 2
    return replace(board, shape=BoardShape(moved))


def test_a_misprinted_bent_board_is_found_as_it_is():
    rng = np.random.default_rng(3)
    rig = sv.arc(3, biased=True)
    true = misprinted(sv.BOARD, rng)
    views = draw(rig, true, 24, rng)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    solution = bundle(views, sv.BOARD, priors_of(rig, rng), T, "C1")
    found, meant = solution.board_shape, true.corners_m()

    def off_m(corners_m: np.ndarray) -> np.ndarray:
        return se3.transform(align.rigid(meant, corners_m), corners_m) - meant

    sigma_m = NOISE.sigma_2d_px / 540 * 2.0 / np.sqrt(24)  # of a corner that is seen from 2 m in 24 views
    assert np.sqrt(np.mean(off_m(sv.BOARD.corners_m())[:, :2] ** 2)) > 3e-4  # as stated
    assert np.sqrt(np.mean(off_m(found.front_m)[:, :2] ** 2)) < 2 * sigma_m
    assert found.front_sd_m is not None and found.back_m is None
    told = " ".join(own.text for own in properties_of(solution))
    assert re.search(r"The print is 0\.(39|40|41) % wider along its columns than along its rows", told), told
    assert re.search(r"bent by (0\.[89]|1\.[0-4])\d mm", told), told
    assert "misregistered" not in told  # it is not
    assert np.sqrt(np.mean((off_m(found.front_m) / found.front_sd_m)[:, :2] ** 2)) < 2


def test_a_back_that_no_camera_saw_tells_nothing_of_the_corners():
    """Where all corners' offsets have one size, those that are not estimated must not count as found to be zero."""
    rng = np.random.default_rng(3)
    rig = sv.arc(3, biased=True)
    views = draw(rig, misprinted(sv.BOARD, rng), 8, rng)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    priors = priors_of(rig, rng)
    one, two = (bundle(views, replace(sv.BOARD, two_sided=sides), priors, T, "C1") for sides in (False, True))
    size, same = (own.problem.weights.sizes["corner offsets"] for own in (one, two))
    assert one.problem.n_globals < two.problem.n_globals
    assert same == pytest.approx(size, rel=1e-3)
    assert 1e-4 < size < 3e-4  # 0.2 mm as printed


@pytest.fixture
def shaped(tmp_path):
    """A rig file with the shape that was found, and the board."""
    rng = np.random.default_rng(1)
    front = sv.TWO_SIDED.corners_m() + rng.normal(0, 1e-4, (sv.TWO_SIDED.n_corners, 3))
    shape = BoardShape(front, front + [0, 0, 0.006], np.full_like(front, 2e-5), np.full_like(front, 4e-5))
    board = replace(sv.TWO_SIDED, shape=shape)
    rig = Rig("C1", {"C1": RigCamera(sv.arc(2).cameras["C1"].intrinsics, np.eye(4), np.zeros((6, 6)))})
    write_rig(tmp_path / "rig.yaml", replace(rig, quality=Quality(board=board)))
    return tmp_path / "rig.yaml", board


def test_the_shape_is_given_back(run, shaped, tmp_path):
    path, board = shaped
    out = run("board-shape", path, "-o", tmp_path / "board.yaml")
    assert out.status == 0 and "front: corners known to 0.020 mm" in out.stderr and "back" in out.stderr
    for file in (path, tmp_path / "board.yaml"):
        again = read_board(file)
        assert np.array_equal(again.corners_m(), board.corners_m())
        assert np.array_equal(again.corners_m(back=True), board.corners_m(back=True))
        assert (again.cols, again.rows, again.square_m, again.thickness_m) == (9, 6, 0.06, board.thickness_m)
    assert run("board-shape", path).stdout == (tmp_path / "board.yaml").read_text()


def test_a_rig_without_a_shape_says_which_method_finds_it(run, shaped, tmp_path):
    _, board = shaped
    flat = Rig("C1", {"C1": RigCamera(sv.arc(2).cameras["C1"].intrinsics, np.eye(4), np.zeros((6, 6)))})
    write_rig(tmp_path / "flat.yaml", replace(flat, quality=Quality(board=replace(board, shape=None))))
    out = run("board-shape", tmp_path / "flat.yaml")
    assert out.status == 2 and "--method bundle" in out.stderr


def test_a_view_is_posed_on_the_print_as_it_is():
    """Front and back, exactly, where a flat print leaves a tenth of a degree."""
    rng = np.random.default_rng(2)
    flat = sv.TWO_SIDED
    front = misprinted(flat, rng).corners_m()
    behind = front + [2e-4, -1e-4, flat.thickness_m] + rng.normal(0, 1e-4, front.shape)
    true = replace(flat, shape=BoardShape(front, behind))
    rig = sv.ring(3)
    boards = sv.board_poses(rig, flat, 6, rng)
    placed = sv.placed_truly(rig, boards, true_views(rig, boards, true, sv.EXACT, rng), true)
    assert {p.back for p in placed} == {False, True}
    for p in placed:
        off = replace(p, T_color_board=se3.retract(p.T_color_board, rng.normal(0, 2e-3, 6)))
        again = repose(off, true, rig.cameras[p.view.camera].intrinsics)
        assert np.abs(se3.difference(p.T_color_board, again.T_color_board)).max() < 1e-9


def test_the_shape_is_taken_for_the_same_board_only(shaped, tmp_path):
    path, board = shaped
    rig = read_rig(path)
    lens = rig.cameras["C1"].intrinsics
    info = {"C1": CameraInfo(lens.width, lens.height)}
    for stated, known in ((replace(board, shape=None), True), (replace(board, shape=None, square_m=0.05), False)):
        (tmp_path / "dataset.yaml").unlink(missing_ok=True)
        write_dataset(tmp_path, info, stated)
        (tmp_path / "C1" / "color").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "C1" / "color" / "0.png"), np.zeros((lens.height, lens.width, 3), np.uint8))
        found = board_for(open_recording(tmp_path), rig)
        assert (found.shape is not None) == known and found.square_m == stated.square_m
    with pytest.raises(ConfigError, match="describes no board"):
        board_for(open_recording(tmp_path), replace(rig, quality=quality_of({"board": {"cols": 9}})))


def test_what_is_held_at_zero_on_request_is_looked_for():
    """A print that is 0.6 % out of square, and an estimate that may not say so."""
    rig, rng = sv.arc(3, biased=True), np.random.default_rng(0)
    flat = sv.BOARD.corners_m()
    true = replace(sv.BOARD, shape=BoardShape(flat * [1.003, 0.997, 1.0]))
    boards = sv.board_poses(rig, sv.BOARD, 15, rng)
    placed = list(sv.placed_truly(rig, boards, true_views(rig, boards, true, NOISE, rng), true))
    priors = {name: CameraPrior(own.intrinsics, None, True, own.depth_bias) for name, own in rig.cameras.items()}
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    views = [p.view for p in placed]
    nothing = AssociationResult((), {}, {}, (), "C1")
    told = {}
    for hold in ((), ("print", "corner offsets")):
        result = bundle(placed, sv.BOARD, priors, T, "C1", BundleParams(hold=hold))
        check = check_bundle(result, sv.BOARD, views, nothing, sorted(boards), 0.0, SelfCheckParams())
        told[bool(hold)] = [f.text for f in check.findings]
    assert told[False] == []
    assert "The printed squares are not square: 0.6" in told[True][0]


@pytest.mark.parametrize("kind", ["checkerboard", "aprilgrid"])
def test_a_bow_is_found_where_frames_show_either_face_and_nothing_tells_which(kind):
    rng = np.random.default_rng(5)
    nominal = of_type(Board(8, 6, 0.06, two_sided=True, thickness_m=0.006), kind)
    front = misprinted(nominal, rng).corners_m()
    true = replace(nominal, shape=BoardShape(front, front + [0, 0, nominal.thickness_m]))
    rig = sv.arc(2, biased=True)
    views = draw(rig, true, 24, rng)
    other = nominal.T_face_board(back=True, turned=False)
    boards = {v.view.frame: rig.cameras[v.view.camera].T_world_color @ v.T_color_board for v in views}
    turned = {frame: T @ other if k % 2 else T for k, (frame, T) in enumerate(boards.items())}
    seen = true_views(rig, turned, true, NOISE, rng)
    as_front = sv.placed_truly(rig, boards, seen, nominal)  # cameras that see one face agree, whichever it is
    assert not any(p.back for p in as_front)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    found = bundle(as_front, nominal, priors_of(rig, rng), T, "C1").board_shape.front_m
    behind = true.shape.back_m.reshape(6, 8, 3)[:, ::-1].reshape(-1, 3) * [
        -1,
        1,
        -1,
    ]  # the front may have been called back
    off = min(np.std((se3.transform(align.rigid(meant, found), found) - meant)[:, 2]) for meant in (front, behind))
    assert off < 0.1 * np.std(front[:, 2])
