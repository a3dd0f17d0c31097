"""The errors that a bundle's solution is tested against: what happens to rigs, each as columns for the score test."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rgbd_calib.trust.self_check.equations import NO_MOMENT, Equations, Score
from rgbd_calib.trust.self_check.findings import SelfCheckParams
from rgbd_calib.trust.self_check.hypothesis import Hypothesis, Say
from rgbd_calib.types import IntArray

SEEN_BY_PRIOR = 1e-9
"""The board's size is not seen in pixels; what is known of the depth before is little against them."""


def hypotheses_of(eq: Equations, params: SelfCheckParams) -> list[Hypothesis]:
    """All that are tested."""
    listed = [*_board(eq), *_registration_of_all(eq)]
    for c in range(len(eq.cameras)):
        listed += [*_over_time(eq, c, params), *_between_recordings(eq, c, params), *_sensor(eq, c), *_prior(eq, c)]
    return listed


def _columns(eq: Equations, name: str, count: int | None = None) -> IntArray:
    part = eq.local[name]
    return np.arange(part.start, part.stop if count is None else part.start + count)


def _seen(eq: Equations, name: str, where: IntArray) -> bool:
    """Do these views have what the first column of this name is of?"""
    at = eq.local[name].start
    return bool(np.any(eq.gram[where][:, at, at]))


def _mean_z(eq: Equations, where: IntArray) -> float:
    return float(np.average(eq.distance_m[where], weights=eq.corners[where]))


def _over_time(eq: Equations, c: int, params: SelfCheckParams) -> Iterator[Hypothesis]:
    """A pose, a lens or a depth that is another one from some frame on."""
    name, mine = eq.cameras[c], (eq.camera == c) & (eq.moment != NO_MOMENT)
    n = len(eq.moments)

    def pose(at: str, z: float) -> Say:
        return lambda s: f"{name} stands elsewhere from frame {at} on than before: the boards are {_mm(s)} off"

    def lens(at: str, z: float) -> Say:
        return lambda s: (
            f"{name}'s lens is another one from frame {at} on, or it was turned a little: focal length {s.estimate[0]:+.1f} px, centre "
            f"{s.estimate[2]:+.1f}, {s.estimate[3]:+.1f} px, or {_mm(s)} at the board"
        )

    def depth(at: str, z: float) -> Say:
        return lambda s: (
            f"{name}'s depth is another one from frame {at} on, by {1e3 * abs(s.estimate[0] + s.estimate[1] * z):.1f} mm at "
            f"{z:.1f} m"
        )

    kinds: list[tuple[str, str, int, IntArray, Callable[[str, float], Say], str]] = [
        (
            "pose over time",
            "pose",
            6,
            mine & eq.shared,
            pose,
            "Something moved it, or the frames are of two sessions. Keep the frames of one side only, or fix the camera and "
            "film again",
        ),
        ("lens over time", "lens", 4, mine, lens, "Switch its autofocus and zoom off, and film again"),
        (
            "depth over time",
            "bias",
            2,
            mine,
            depth,
            "Let the sensor warm up for half an hour, and film again, the bias recording too",
        ),
    ]
    for check, part, count, where, say, advice in kinds:
        for split in dict.fromkeys(round(k * n / params.splits) for k in range(1, params.splits)):
            late = where & (eq.moment >= split)
            sides = len(np.unique(eq.moment[late])), len(np.unique(eq.moment[where & ~late]))
            if min(sides) >= params.min_side and _seen(eq, part, late):
                text = say(eq.moments[split], _mean_z(eq, late))
                yield Hypothesis(check, (name,), _columns(eq, part, count), late, text, advice)


def _between_recordings(eq: Equations, c: int, params: SelfCheckParams) -> Iterator[Hypothesis]:
    """A lens or a depth that is another one in the recording of each camera alone."""
    name, mine = eq.cameras[c], eq.camera == c
    alone = mine & (eq.moment == NO_MOMENT)
    if min(alone.sum(), (mine & ~alone).sum()) < params.min_side:
        return

    def lens(s: Score) -> str:
        fx, fy, cx, cy = -s.estimate
        return (
            f"{name}'s lens in the rig's recording is not that of its intrinsic recording: fx {fx:+.1f}, fy {fy:+.1f}, "
            f"centre {cx:+.1f}, {cy:+.1f} px, or {_mm(s)} at the board"
        )

    yield Hypothesis(
        "lens between recordings",
        (name,),
        _columns(eq, "lens", 4),
        alone,
        lens,
        "Another camera's images, another resolution or crop, images turned round, or another focus. Check the names, and "
        "record the intrinsics again with the camera as it is in the rig",
    )
    if _seen(eq, "bias", alone):
        yield Hypothesis(
            "depth between recordings",
            (name,),
            _columns(eq, "bias", 2),
            alone,
            lambda s: f"{name}'s depth in the rig's recording is not that of its intrinsic recording, by {_mm(s)}",
            "Check that both are of the same camera, mode and depth scale; let the sensor warm up before either",
        )


_REGISTER = "Register depth to colour with the sensor's own software (capture does), or correct the registration"


def _registration_of_all(eq: Equations) -> Iterator[Hypothesis]:
    """Depth that nobody registered: the same in every camera, and in all of them together clearer than in one."""
    with_depth = [c for c in range(len(eq.cameras)) if _seen(eq, "registration", eq.camera == c)]
    where = np.isin(eq.camera, with_depth)
    if len(with_depth) > 1:
        yield Hypothesis(
            "registration of all",
            tuple(eq.cameras[c] for c in with_depth),
            _columns(eq, "registration"),
            where,
            lambda s: (
                f"In all cameras the depth image lies beside its colour image, by {s.estimate[0]:+.1f} px in u and "
                f"{s.estimate[1]:+.1f} px in v in the mean, or {_mm(s)} at the board"
            ),
            _REGISTER,
            _lateral(eq, where) * np.eye(2),
        )


def _sensor(eq: Equations, c: int) -> Iterator[Hypothesis]:
    """What the models of lens and depth cannot follow: fields over the image, the range, a depth image beside its colour."""
    name, mine = eq.cameras[c], eq.camera == c
    if _seen(eq, "registration", mine):
        yield Hypothesis(
            "registration",
            (name,),
            _columns(eq, "registration"),
            mine,
            lambda s: (
                f"{name}'s depth image lies {s.estimate[0]:+.1f} px in u and {s.estimate[1]:+.1f} px in v beside its colour "
                f"image, or {_mm(s)} at the board"
            ),
            _REGISTER,
            _lateral(eq, mine) * np.eye(2),
        )
        yield Hypothesis(
            "depth over the image",
            (name,),
            _columns(eq, "depth_field"),
            mine,
            lambda s: (
                f"{name}'s depth is off by a smooth field over its image, {_mm(s)} RMS: its bias is not of the depth alone"
            ),
            "Count with this error in fused clouds; a sensor out of the ordinary may be damaged or hot",
        )
        yield Hypothesis(
            "depth over the range",
            (name,),
            _columns(eq, "range"),
            mine,
            lambda s: f"{name}'s depth deviates with the distance in a way that its bias does not follow, {_mm(s)} RMS",
            "Record walls at more distances, over the whole range; check that the depth is not clipped",
        )
    yield Hypothesis(
        "pixels over the image",
        (name,),
        _columns(eq, "pixel_field"),
        mine,
        lambda s: (
            f"{name}'s corners are off by a smooth field over its image, {_mm(s)} RMS at the board: the lens model does not "
            "follow this lens"
        ),
        "Check that all images are of one size and crop, and free of a window's refraction; a wide lens needs another model",
    )


def _lateral(eq: Equations, where: IntArray) -> float:
    """Mean square of what a pixel is at the board, metres, by what the centre of the lens moves."""
    at = eq.local["lens"].start + 2
    return float(eq.size[where][:, at, at].sum() / max(int(eq.corners[where].sum()), 1))


def _board(eq: Equations) -> Iterator[Hypothesis]:
    """A board that is not as it was stated."""
    everywhere = np.ones(len(eq.camera), bool)
    z = usual_distance_m(eq)
    yield Hypothesis(
        "scale",
        (),
        _columns(eq, "scale"),
        everywhere,
        lambda s: (
            f"By the depth, the board's squares are {100 * s.estimate[0]:+.2f} % from what was stated "
            f"(± {100 * float(np.sqrt(max(s.covariance[0, 0], 0))):.2f} %): all distances are off by {_mm(s)} at {z:.1f} m, or the "
            "depth is"
        ),
        "Measure the print with a ruler over as many squares as there are and correct `square`; if it is right, check the "
        "depth's unit and the distances of the bias recording",
        np.array([[z**2]]),
        least_seen=SEEN_BY_PRIOR,
    )
    yield Hypothesis(
        "stretch",
        (),
        _columns(eq, "stretch"),
        everywhere,
        lambda s: (
            f"The board's columns are {100 * 2 * s.estimate[0]:+.2f} % farther apart than its rows, its axes "
            f"{np.degrees(2 * s.estimate[1]):+.2f} deg from square"
        ),
        "The printer scaled its two ways differently. Measure both, and print again without scaling",
        z**2 * np.eye(2),
    )
    if _seen(eq, "thickness", everywhere):
        yield Hypothesis(
            "thickness",
            (),
            _columns(eq, "thickness"),
            everywhere,
            lambda s: f"The board's faces are {1e3 * s.estimate[0]:+.1f} mm farther apart than stated",
            "Measure the board's thickness and correct `thickness`",
            np.eye(1),
        )
    yield Hypothesis(
        "shape",
        (),
        _columns(eq, "shape"),
        everywhere,
        lambda s: f"The board is not flat, by {_mm(s)} RMS in a shape that the bow does not follow",
        "Glue the print on glass, aluminium or a thick plate",
    )


def usual_distance_m(eq: Equations) -> float:
    """RMS distance of the boards."""
    return float(np.sqrt(np.average(eq.distance_m**2, weights=eq.corners)))


def _prior(eq: Equations, c: int) -> Iterator[Hypothesis]:
    """A depth bias or a lens that was given."""
    name, mine = eq.cameras[c], eq.camera == c
    if _seen(eq, "bias", mine):
        yield Hypothesis(
            "bias given",
            (name,),
            _columns(eq, "bias"),
            mine,
            lambda s: f"{name}'s depth on the board is {_mm(s)} RMS from what was known of its depth bias before",
            "Check the distances of the bias recording (unit, from the lens to the wall, square to it) and that it is of "
            "this camera; without one, its depth scale, or the board's squares",
            of_prior=True,
        )
    if mine.any():
        yield Hypothesis(
            "lens given",
            (name,),
            _columns(eq, "lens"),
            mine,
            lambda s: f"{name}'s lens is {_mm(s)} RMS at the board from the one that was given",
            "Check that the intrinsics are of this camera and image size; record them again",
            of_prior=True,
        )


def _mm(score: Score) -> str:
    return f"{1e3 * score.effect_m:.1f} mm"
