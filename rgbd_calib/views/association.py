"""Which corner is which: face and half turn of every view, from what most frames agree on.

A view shows the face (front or back of a two-sided board) in one of the turns that the print allows. Each choice is a
fixed motion G between the face as it was read and the board's frame: the identity, the half turn H, the back B, or BH.
They commute and are their own inverses, so the relative pose of two cameras in one frame depends on the product of
their choices alone: as many hypotheses as there are motions. The right one makes the relative pose agree over the
frames. So: for each pair of cameras, the relative pose with the most votes (one vote a frame); then the strongest
pairs chained to all cameras; then, frame by frame, the choices that agree with those poses.

One frame's board may be read from either side: the choice of its first view is free, and the others follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, PlacedView, PosedView

MIN_AGREEING = 0.5
"""Share of a pair's frames: where fewer agree, and no more than by another reading, they are not of one instant each."""
MIN_SIDE, MOST_OF_SIDE, FEW = 3, 0.8, 0.75
"""Frames before and after a change of the relative pose, the share of each side that must agree, and the share of all below
which a change is looked for."""

MAX_PROPOSALS = 128
"""Frames of a pair that propose a relative pose, spread over all of them; all vote. So the time grows as the frames do."""


@dataclass(frozen=True)
class AssociationParams:
    max_angle_rad: float = 0.10
    """Two relative poses agree where they differ by less than this and than max_shift of the distance."""
    max_shift: float = 0.10


@dataclass(frozen=True)
class Cause:
    """Why frames do not agree."""

    text: str
    """A clause."""
    advice: str
    """A sentence without its full stop."""


@dataclass(frozen=True)
class PairVotes:
    """What the frames say of two cameras."""

    cameras: tuple[str, str]
    frames: int
    votes: int
    """Frames that agree with the best relative pose."""
    rival_votes: int
    """The most frames that agree with a pose from other choices: equal votes mean that nothing decides."""
    T_a_b: FloatArray
    cause: Cause | None = None
    """Where few agree: another description of the board with which most would."""


@dataclass(frozen=True)
class AssociationResult:
    """Decided views, and the views that fit nothing."""

    views: tuple[PlacedView, ...]
    T_world_color: dict[str, FloatArray]
    """Rough poses from single views, world = the reference camera."""
    dropped: dict[tuple[str, str], str]
    """Why, by (camera, frame)."""
    pairs: tuple[PairVotes, ...]
    reference: str


def associate(
    views: Sequence[PosedView],
    board: Board,
    reference: str,
    cameras: Sequence[str],
    params: AssociationParams | None = None,
) -> AssociationResult:
    """Decide face and turn of every view and place every camera roughly.

    Raises
    ------
    CalibrationError
        Cameras that no chain of common views joins (names the groups and which pair to film), a half turn that nothing
        decides, or a pair whose relative pose changed.
    """
    params = params or AssociationParams()
    pairs = _explained(_vote(_by_frame(views), _motions(board), params), views, board, params)
    for pair in pairs:
        if pair.cause is None and (change := _changed(pair, views, board, params)):
            raise CalibrationError(_disagreement(replace(pair, cause=change)))
    _check_connected(cameras, pairs)
    T_world_color = _chain(reference, cameras, pairs)
    placed, dropped = label_views(views, board, T_world_color, params)
    return AssociationResult(placed, T_world_color, dropped, tuple(pairs), reference)


def label_views(
    views: Sequence[PosedView], board: Board, T_world_color: Mapping[str, FloatArray], params: AssociationParams
) -> tuple[tuple[PlacedView, ...], dict[tuple[str, str], str]]:
    """Face and turn of every view by known camera poses; and why, by (camera, frame), of the views that fit in none."""
    by_frame, motions = _by_frame(views), _motions(board)
    placed: list[PlacedView] = []
    dropped: dict[tuple[str, str], str] = {}
    for frame in sorted(by_frame):
        good, bad = _choose(by_frame[frame], motions, T_world_color, params)
        placed += good
        dropped |= {(camera, frame): why for camera, why in bad.items()}
    return tuple(placed), dropped


FaceMotion = tuple[bool, bool, FloatArray]
"""(back, turned, T_face_board)."""


def _by_frame(views: Sequence[PosedView]) -> dict[str, dict[str, PosedView]]:
    out: dict[str, dict[str, PosedView]] = {}
    for posed in views:
        out.setdefault(posed.view.frame, {})[posed.view.camera] = posed
    return out


def _motions(board: Board) -> list[FaceMotion]:
    turns = (False, True) if board.symmetric else (False,)
    faces = (False, True) if board.two_sided else (False,)
    return [(back, turned, board.T_face_board(back, turned)) for back in faces for turned in turns]


def _distance(T: FloatArray, others: FloatArray, params: AssociationParams) -> FloatArray:
    """How far (...) each of `others` (..., 4, 4) is from T (..., 4, 4), in units of the tolerance: below 1 they agree."""
    D = se3.inverse(T) @ others
    scale = np.maximum(np.linalg.norm(T[..., :3, 3], axis=-1), 0.3)
    shift: FloatArray = np.linalg.norm(D[..., :3, 3], axis=-1) / (params.max_shift * scale)
    return np.maximum(so3.angle_rad(D[..., :3, :3]) / params.max_angle_rad, shift)


def _vote(
    by_frame: dict[str, dict[str, PosedView]], motions: list[FaceMotion], params: AssociationParams
) -> list[PairVotes]:
    listed = _relative_poses(by_frame, motions)
    return [_best_of(pair, relative, params) for pair, relative in sorted(listed.items())]


def _relative_poses(
    by_frame: Mapping[str, Mapping[str, PosedView]], motions: list[FaceMotion]
) -> dict[tuple[str, str], FloatArray]:
    """T_a_b (frames, motions, 4, 4) of each pair by its common frames, in the order of their names."""
    listed: dict[tuple[str, str], list[FloatArray]] = {}
    for frame in sorted(by_frame):
        for a, b in combinations(sorted(by_frame[frame]), 2):
            T_a_face, T_b_face = by_frame[frame][a].T_color_face, by_frame[frame][b].T_color_face
            relative = np.stack([T_a_face @ G @ se3.inverse(T_b_face) for _, _, G in motions])
            listed.setdefault((a, b), []).append(relative)
    return {pair: np.stack(own) for pair, own in listed.items()}


def _explained(
    pairs: list[PairVotes], views: Sequence[PosedView], board: Board, params: AssociationParams
) -> list[PairVotes]:
    """With the cause of few votes, where another description of the board has most frames agree."""
    poor = {p.cameras for p in pairs if p.frames > 2 and p.votes < MIN_AGREEING * p.frames}
    causes: dict[tuple[str, str], tuple[float, Cause | None]] = {}
    concerned = [v for v in views if any(v.view.camera in pair for pair in poor)]
    for cause, read, motions in _other_readings(concerned, board):
        for p in _vote(_by_frame(read), motions, params):
            best, _ = causes.get(p.cameras, (MIN_AGREEING * p.frames, None))
            if p.cameras in poor and p.votes > best:
                causes[p.cameras] = p.votes, cause
    return [replace(p, cause=causes[p.cameras][1] if p.cameras in causes else None) for p in pairs]


def _changed(pair: PairVotes, views: Sequence[PosedView], board: Board, params: AssociationParams) -> Cause | None:
    """Where few agree: the frame from which on, in the order of names, they agree on another pose."""
    if pair.frames < 2 * MIN_SIDE or pair.votes >= FEW * pair.frames:
        return None
    by_frame = {frame: own for frame, own in _by_frame(views).items() if own.keys() >= set(pair.cameras)}
    relative = _relative_poses(by_frame, _motions(board))[pair.cameras]
    one = _distance(pair.T_a_b, relative, params).min(axis=1) < 1
    if (~one).sum() < MIN_SIDE:
        return None
    rest = _best_of(pair.cameras, relative[~one], params)
    other = _distance(rest.T_a_b, relative, params).min(axis=1) < 1
    names, places = sorted(by_frame), np.arange(MIN_SIDE, len(by_frame) - MIN_SIDE + 1)
    for before, after in ((one, other), (other, one)):
        votes = np.cumsum(before)[places - 1] + np.sum(after) - np.cumsum(after)[places - 1]
        n = int(places[np.argmax(votes)])
        if min(before[:n].mean(), after[n:].mean()) >= MOST_OF_SIDE:
            return Cause(
                f"their relative pose changed at frame {names[n]}",
                "One of them was moved or mounted anew, or its images turned: keep the frames before it or those from it on",
            )
    return None


def _other_readings(
    views: Sequence[PosedView], board: Board
) -> Iterator[tuple[Cause, Sequence[PosedView], list[FaceMotion]]]:
    """What people have otherwise than stated, and the views and motions that would be right."""
    for camera in sorted({v.view.camera for v in views}):
        cause = Cause(
            f"the images of {camera} are mirrored against those of the other camera",
            f"Switch mirroring off where {camera} is recorded, or flip its colour and depth images left to right",
        )
        for axis in (0, 1):  # a mirrored print is read as the print again, by another corner
            read = [
                replace(v, T_color_face=_mirrored(v.T_color_face, board, axis)) if v.view.camera == camera else v
                for v in views
            ]
            yield cause, read, _motions(board)
    if (other := _other_board(board)) is not None:
        yield other[0], views, other[1]


def _mirrored(T_color_face: FloatArray, board: Board, axis: int) -> FloatArray:
    """Pose of a face in the image flipped left to right, its corners in reverse order along one axis of the board."""
    of_image, of_face = np.diag([-1.0, 1, 1, 1]), np.eye(4)
    of_face[axis, axis], of_face[axis, 3] = -1, board.grid[-1][axis] * board.square_m
    return np.asarray(of_image @ T_color_face @ of_face)


def _other_board(board: Board) -> tuple[Cause, list[FaceMotion]] | None:
    """What people misstate of a board with two faces, and the motions that would be right."""
    if board.two_sided and board.symmetric:
        return None
    back = (True, board.two_sided, board.T_face_board(True, board.two_sided))
    cause = Cause("the board shows both of its faces", "Add two_sided: true and the thickness to dataset.yaml")
    if board.two_sided:
        cause = Cause(
            "the back's corners are rotated by 180° against the stated board, so that cols and rows are exchanged, or the "
            "back is glued upside down",
            "Exchange cols and rows in dataset.yaml",
        )
    return cause, [(False, False, np.eye(4)), back]


def _best_of(pair: tuple[str, str], relative: FloatArray, params: AssociationParams) -> PairVotes:
    """The relative pose with most votes among (frames, motions, 4, 4); ties go to the tightest."""
    n_frames, n_motions = relative.shape[:2]
    proposed = np.unique(np.linspace(0, n_frames - 1, min(n_frames, MAX_PROPOSALS)).astype(int))
    candidates = relative[proposed].reshape(-1, 4, 4)
    nearest, spread = np.empty((len(candidates), n_frames)), np.empty((len(candidates), len(candidates)))
    for k, T in enumerate(candidates):
        distance = _distance(T, relative, params)
        nearest[k], spread[k] = distance.min(axis=1), distance[proposed].ravel()
    votes = np.sum(nearest < 1, axis=1)
    score = votes - np.sum(np.minimum(nearest, 1), axis=1) / (n_frames + 1)
    best = int(np.argmax(score))
    rivals = spread[best] >= 2  # a different pose, not the same one with noise
    rival = int(votes[rivals].max()) if rivals.any() and n_motions > 1 else 0
    choice = _distance(candidates[best], relative, params).argmin(axis=1)
    chosen = relative[np.arange(n_frames), choice][nearest[best] < 1]
    T = se3.make(so3.mean(chosen[:, :3, :3]), np.median(chosen[:, :3, 3], axis=0))
    return PairVotes(pair, n_frames, int(votes[best]), rival, T)


def _check_connected(cameras: Sequence[str], pairs: Sequence[PairVotes]) -> None:
    group = {camera: i for i, camera in enumerate(cameras)}
    for pair in pairs:
        a, b = (group[camera] for camera in pair.cameras)
        group = {camera: a if g == b else g for camera, g in group.items()}
    groups: dict[int, list[str]] = {}
    for camera in cameras:
        groups.setdefault(group[camera], []).append(camera)
    if len(groups) > 1:
        first, *rest = groups.values()
        text = " | ".join("{" + ", ".join(g) + "}" for g in groups.values())
        film = " and ".join(f"{first[-1]} with {other[0]}" for other in rest)
        raise CalibrationError(
            f"cameras are not connected: no common view of the board joins the groups {text}; one frame in which both see "
            f"it is needed, five are good. Film {film} together (or any other camera of those groups)"
        )


def _chain(reference: str, cameras: Sequence[str], pairs: Sequence[PairVotes]) -> dict[str, FloatArray]:
    """Poses over the maximum spanning tree from the reference, by margin of the vote, then by votes."""
    placed = {reference: np.eye(4)}
    while len(placed) < len(cameras):
        reach = [p for p in pairs if (p.cameras[0] in placed) != (p.cameras[1] in placed)]
        best = max(reach, key=lambda p: (p.votes - p.rival_votes, p.votes))
        a, b = best.cameras
        if best.cause:
            raise CalibrationError(_disagreement(best))
        if best.votes <= best.rival_votes and best.votes < MIN_AGREEING * best.frames and best.frames > 2:
            raise CalibrationError(
                f"{a} and {b}: {best.votes} of {best.frames} common frames agree on the relative pose, not more than agree by "
                f"chance; {MIN_AGREEING:.0%} at least are needed. Frames of different instants under one name, of another "
                "session, mirrored images, or another pattern in view: look at a few frames of both, and film again"
            )
        if best.votes <= best.rival_votes:
            raise CalibrationError(
                f"{a} and {b}: {best.frames} common view(s), and the board could be rotated by 180°, or seen from its other "
                f"side, in {'it' if best.frames == 1 else 'them'} just as well; two frames with the board held differently "
                "are needed. Film this pair again, or use a board with cols + rows odd"
            )
        if a in placed:
            placed[b] = placed[a] @ best.T_a_b
        else:
            placed[a] = placed[b] @ se3.inverse(best.T_a_b)
    return {camera: placed[camera] for camera in cameras}


def _disagreement(pair: PairVotes) -> str:
    (a, b), cause = pair.cameras, pair.cause
    assert cause is not None
    return f"{a} and {b}: only {pair.votes} of {pair.frames} common frames agree on the relative pose: {cause.text}. {cause.advice}"


def _choose(
    views: dict[str, PosedView],
    motions: list[FaceMotion],
    T_world_color: Mapping[str, FloatArray],
    params: AssociationParams,
) -> tuple[list[PlacedView], dict[str, str]]:
    """Choices of one frame that agree with the poses of the cameras, and the views that do not fit."""
    cameras = sorted(views)
    T_color_face = np.stack([views[camera].T_color_face for camera in cameras])
    W = np.stack([T_world_color[camera] for camera in cameras])
    G = np.stack([motion for _, _, motion in motions])
    # by anchor, other camera and motion; compare camera poses, not board poses: that is what the tolerance is stated for
    anchors = se3.inverse(W)[:, None] @ W[None]
    relative = (T_color_face[:, None] @ G)[:, None] @ se3.inverse(T_color_face)[:, None]
    distance = _distance(anchors[:, :, None], relative, params)
    choices = distance.argmin(axis=2)
    fits = distance.min(axis=2) < 2  # the chain's own error comes on top of one view's
    own = np.arange(len(cameras))
    fits[own, own], choices[own, own] = True, 0
    anchor = int(np.argmax(fits.sum(axis=1)))
    best = [(camera, int(choices[anchor, k])) for k, camera in enumerate(cameras) if fits[anchor, k]]
    placed = []
    for camera, choice in best:
        back, turned, G = motions[choice]
        placed.append(PlacedView(views[camera].view, back, turned, views[camera].T_color_face @ G))
    seen = sorted(camera for camera, _ in best)
    bad = {
        camera: f"the board's pose agrees in no reading with {', '.join(seen) or 'the rig'}"
        for camera in views
        if camera not in seen
    }
    return placed, bad
