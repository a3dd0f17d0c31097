"""The errors that a bundle's solution is tested against: what happens to rigs, each as columns for the score test."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.stages.self_check.equations import (
    NO_MOMENT,
    Equations,
    Score,
    clear_effect,
    score_test,
)
from rgbd_calib.stages.self_check.findings import Finding, SelfCheckParams
from rgbd_calib.types import IntArray

Family = Literal["time", "recordings", "sensor", "board", "prior"]


@dataclass(frozen=True)
class Test:
    """One hypothesis that was tested."""

    name: str
    family: Family
    cameras: tuple[str, ...]
    score: Score
    text: str
    advice: str

    @property
    def gain(self) -> float:
        """By how much the hypothesis fits better, its freedom counted (Akaike): orders those that tell of one thing."""
        return self.score.statistic - 2 * self.score.freedom


def tests_of(eq: Equations, params: SelfCheckParams) -> list[Test]:
    """All of them."""
    out = list(_board(eq))
    for c in range(len(eq.cameras)):
        out += [*_over_time(eq, c, params), *_between_recordings(eq, c, params), *_sensor(eq, c), *_prior(eq, c)]
    return out


def findings_of(tests: list[Test], params: SelfCheckParams, stated_mm: float) -> list[Finding]:
    """The tests that failed and matter; of one family, or one camera, the best explanation only.

    One error shows in several tests: a camera that moved also looks like one whose lens changed. What fits best is said.
    """
    limit = params.significance / max(len(tests), 1)
    failed = [t for t in tests if t.score.p < limit and 1e3 * t.score.effect_m > max(params.caution_mm, stated_mm)]
    failed.sort(key=lambda t: -t.gain)
    told: list[Test] = []
    for t in failed:
        if not any(_same_cause(t, other) for other in told):
            told.append(t)
    return [
        Finding(
            t.name,
            "distrust" if 1e3 * t.score.effect_m > max(params.distrust_mm, stated_mm) else "caution",
            t.cameras,
            t.text,
            t.advice,
            round(1e3 * t.score.effect_m, 2),
            t.score.p,
        )
        for t in told
    ]


def _same_cause(test: Test, other: Test) -> bool:
    """Does `other`, which fits better, explain `test` too?"""
    if not test.cameras or not other.cameras:  # a wrong board is seen by all cameras
        return test.gain < other.gain
    return bool(set(test.cameras) & set(other.cameras)) or test.gain < 0.3 * other.gain


def _columns(eq: Equations, name: str, count: int | None = None) -> IntArray:
    part = eq.local[name]
    return np.arange(part.start, part.stop if count is None else part.start + count)


def _mean_z(eq: Equations, where: IntArray) -> float:
    return float(np.average(eq.distance_m[where], weights=eq.corners[where]))


def _over_time(eq: Equations, c: int, params: SelfCheckParams) -> Iterator[Test]:
    """A pose, a lens or a depth that is another one from some frame on."""
    name, mine = eq.cameras[c], (eq.camera == c) & (eq.moment != NO_MOMENT)
    n = len(eq.moments)
    kinds: list[tuple[str, str, int, IntArray, Callable[[Score, str, float], str], str]] = [
        (
            "pose over time",
            "pose",
            6,
            mine & eq.shared,
            lambda s, at, z: f"{name} stands elsewhere from frame {at} on than before: the boards are {_mm(s)} off",
            "Something moved it, or it was taken out and put back. Keep the frames of one side only, or fix the camera "
            "and film again",
        ),
        (
            "lens over time",
            "lens",
            4,
            mine,
            lambda s, at, z: (
                f"{name}'s lens is another one from frame {at} on: focal length {s.estimate[0]:+.1f} px, centre "
                f"{s.estimate[2]:+.1f}, {s.estimate[3]:+.1f} px, or {_mm(s)} at the board"
            ),
            "Switch its autofocus and zoom off, and film again",
        ),
        (
            "depth over time",
            "bias",
            2,
            mine,
            lambda s, at, z: (
                f"{name}'s depth is another one from frame {at} on: {1e3 * (s.estimate[0] + s.estimate[1] * z):+.1f} mm at "
                f"{z:.1f} m"
            ),
            "Let the sensor warm up for half an hour, and film again, the bias recording too",
        ),
    ]
    for check, part, count, where, say, advice in kinds:
        for k in range(1, params.splits):
            split = round(k * n / params.splits)
            late = where & (eq.moment >= split)
            sides = len(np.unique(eq.moment[late])), len(np.unique(eq.moment[where & ~late]))
            if min(sides) < params.min_side or not np.any(eq.gram[late][:, eq.local[part].start, eq.local[part].start]):
                continue
            score = score_test(eq, _columns(eq, part, count), late)
            text = say(score, eq.moments[split], _mean_z(eq, late))
            yield Test(check, "time", (name,), score, text, advice)


def _between_recordings(eq: Equations, c: int, params: SelfCheckParams) -> Iterator[Test]:
    """A lens or a depth that is another one in the recording of each camera alone."""
    name, mine = eq.cameras[c], eq.camera == c
    alone = mine & (eq.moment == NO_MOMENT)
    if min(alone.sum(), (mine & ~alone).sum()) < params.min_side:
        return
    lens = score_test(eq, _columns(eq, "lens", 4), alone)
    fx, fy, cx, cy = -lens.estimate
    yield Test(
        "lens between recordings",
        "recordings",
        (name,),
        lens,
        f"{name}'s lens in the rig's recording is not that of its intrinsic recording: fx {fx:+.1f}, fy {fy:+.1f}, centre "
        f"{cx:+.1f}, {cy:+.1f} px, or {_mm(lens)} at the board",
        "Another camera's images, another resolution or crop, images turned round, or another focus. Check the names, and "
        "record the intrinsics again with the camera as it is in the rig",
    )
    if np.any(eq.gram[alone][:, eq.local["bias"].start, eq.local["bias"].start]):
        depth = score_test(eq, _columns(eq, "bias", 2), alone)
        yield Test(
            "depth between recordings",
            "recordings",
            (name,),
            depth,
            f"{name}'s depth in the rig's recording is not that of its intrinsic recording, by {_mm(depth)}",
            "Check that both are of the same camera, mode and depth scale; let the sensor warm up before either",
        )


def _sensor(eq: Equations, c: int) -> Iterator[Test]:
    """What the models of lens and depth cannot follow: fields over the image, the range, a depth image beside its colour."""
    name, mine = eq.cameras[c], eq.camera == c
    if np.any(eq.gram[mine][:, eq.local["registration"].start, eq.local["registration"].start]):
        a_pixel = float(np.sqrt(_lateral(eq, mine)))
        registration = score_test(eq, _columns(eq, "registration"), mine, a_pixel**2 * np.eye(2))
        du, dv = registration.estimate
        yield Test(
            "registration",
            "sensor",
            (name,),
            registration,
            f"{name}'s depth image lies {du:+.1f} px in u and {dv:+.1f} px in v beside its colour image, or {_mm(registration)}",
            "Register depth to colour with the sensor's own software (capture does), or correct the registration",
        )
        yield Test(
            "depth over the image",
            "sensor",
            (name,),
            field := score_test(eq, _columns(eq, "depth_field"), mine),
            f"{name}'s depth is off by a smooth field over its image, {_mm(field)} RMS: its bias is not of the depth alone",
            "Count with this error in fused clouds; a sensor out of the ordinary may be damaged or hot",
        )
        yield Test(
            "depth over the range",
            "sensor",
            (name,),
            over := score_test(eq, _columns(eq, "range"), mine),
            f"{name}'s depth deviates with the distance in a way that its bias does not follow, {_mm(over)} RMS",
            "Record walls at more distances, over the whole range; check that the depth is not clipped",
        )
    pixels = score_test(eq, _columns(eq, "pixel_field"), mine)
    yield Test(
        "pixels over the image",
        "sensor",
        (name,),
        pixels,
        f"{name}'s corners are off by a smooth field over its image, {_mm(pixels)} RMS at the board: the lens model does not "
        "follow this lens",
        "Check that all images are of one size and crop, and free of a window's refraction; a wide lens needs another model",
    )


def _lateral(eq: Equations, where: IntArray) -> float:
    """Mean square of what a pixel is at the board, metres, by what the centre of the lens moves."""
    at = eq.local["lens"].start + 2
    return float(eq.size[where][:, at, at].sum() / max(int(eq.corners[where].sum()), 1))


def _board(eq: Equations) -> Iterator[Test]:
    """A board that is not as it was stated."""
    everywhere = np.ones(len(eq.camera), bool)
    z = float(np.sqrt(np.average(eq.distance_m**2, weights=eq.corners)))
    scale = score_test(eq, _columns(eq, "scale"), everywhere, np.array([[z**2]]))
    yield Test(
        "scale",
        "board",
        (),
        scale,
        f"By the depth, the board's squares are {100 * scale.estimate[0]:+.2f} % from what was stated "
        f"(± {100 * float(np.sqrt(max(scale.covariance[0, 0], 0))):.2f} %): all distances are off by {_mm(scale)} at {z:.1f} m, or "
        "the depth is",
        "Measure the print with a ruler over as many squares as there are and correct `square`; if it is right, check the "
        "depth's unit and the distances of the bias recording",
    )
    stretch = score_test(eq, _columns(eq, "stretch"), everywhere, z**2 * np.eye(2))
    yield Test(
        "stretch",
        "board",
        (),
        stretch,
        f"The board's columns are {100 * 2 * stretch.estimate[0]:+.2f} % farther apart than its rows, its axes "
        f"{np.degrees(2 * stretch.estimate[1]):+.2f} deg from square",
        "The printer scaled its two ways differently. Measure both, and print again without scaling",
    )
    if np.any(eq.gram[:, eq.local["thickness"].start, eq.local["thickness"].start]):
        thickness = score_test(eq, _columns(eq, "thickness"), everywhere)
        yield Test(
            "thickness",
            "board",
            (),
            thickness,
            f"The board's faces are {1e3 * thickness.estimate[0]:+.1f} mm farther apart than stated",
            "Measure the board's thickness and correct `thickness`",
        )
    yield Test(
        "shape",
        "board",
        (),
        shape := score_test(eq, _columns(eq, "shape"), everywhere),
        f"The board is not flat, by {_mm(shape)} RMS in a shape that the bow does not follow",
        "Glue the print on glass, aluminium or a thick plate",
    )


def _prior(eq: Equations, c: int) -> Iterator[Test]:
    """A depth bias or a lens that was given, against what the recording says.

    With theta0 the prior's mean, of information L, theta the estimate, and C, C' its covariance without and with the
    excess: Var(theta - theta0) = C' + L^-1 - 2 C over the parameters concerned.
    """
    name, mine = eq.cameras[c], eq.camera == c
    if not mine.any():
        return
    says: Mapping[str, tuple[str, str]] = {
        "bias": (
            "The depth that {name} measures on the board is off by {mm} RMS from what its depth bias says",
            "Check the distances of the bias recording (unit, from the lens to the wall, square to it) and that it is of "
            "this camera; without one, the sensor's scale is off, or the board's squares are not as stated",
        ),
        "lens": (
            "{name}'s lens is {mm} RMS at the board from the one that was given",
            "Check that the intrinsics are of this camera and image size; record them again",
        ),
    }
    for part, (text, advice) in says.items():
        local = _columns(eq, part)
        own = eq.index[np.flatnonzero(mine)[0], local]
        used = np.asarray(eq.free[own].astype(bool) & (np.diag(eq.prior)[own] > 0))
        own, local = own[used], local[used]
        if not len(own) or not np.any(eq.gram[mine][:, local, local]):
            continue
        L_inv = np.asarray(np.linalg.pinv(eq.prior[np.ix_(own, own)], hermitian=True), np.float64)
        d = L_inv @ eq.prior_gradient[own]
        at = np.ix_(own, own)
        variance = eq.honest_covariance[at] + L_inv - 2 * eq.covariance[at]
        size = eq.size[mine][:, local[:, None], local].sum(axis=0) / max(int(eq.corners[mine].sum()), 1)
        score = _deviation(d, variance, L_inv, size)
        yield Test(f"{part} given", "prior", (name,), score, text.format(name=name, mm=_mm(score)), advice)


def _deviation(d: FloatArray, variance: FloatArray, scale: FloatArray, size: FloatArray) -> Score:
    """Score of a deviation with this variance; where it is but a little of `scale`, the prior decides and tells nothing."""
    unit = 1 / np.sqrt(np.diag(scale))
    values, vectors = np.linalg.eigh(variance * np.outer(unit, unit))
    kept = values > 1e-3
    if not kept.any():
        return Score(0.0, 0, 1.0, d, variance, 0.0)
    U = vectors[:, kept]
    y = U.T @ (unit * d)
    statistic = float(np.sum(y**2 / values[kept]))
    B = U / unit[:, None]
    effect = clear_effect(y, np.diag(values[kept]), B, size)
    return Score(statistic, int(kept.sum()), float(chi2.sf(statistic, int(kept.sum()))), d, variance, effect)


def _mm(score: Score) -> str:
    return f"{1e3 * score.effect_m:.1f} mm"
