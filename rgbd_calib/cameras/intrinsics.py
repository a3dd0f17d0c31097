"""Intrinsics of one camera from views of a board: Zhang's method, as OpenCV refines it.

Views that do not fit are left out one by one, the worst first: a view goes while its RMS exceeds `max_view_ratio` times
the median RMS of all. What kind of lens it is, :mod:`.lens_choice` says.

The time grows with the cube of the number of views. Of more than `max_views` those are taken that tell most of the lens.

References
----------
The paper, section 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rgbd_calib.cameras.lens_choice import best, choose
from rgbd_calib.cameras.zhang import ZhangSolution, information, solve
from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.selection import most_informative
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import LensChoice
from rgbd_calib.types import Board, BoardView

MAX_RELATIVE_SD = 0.05
"""Above this standard deviation of a focal length, as a share of it, the views do not determine it."""
PROFILE_SIGMAS = 5.0
"""The standard deviation is that of a linear model; where the views are square to the camera, the focal length runs away
with the distance and takes it along. So the pixels must also rule out, by this many sigmas, focal lengths that are off by
this many of the largest standard deviation allowed."""


@dataclass(frozen=True)
class IntrinsicsParams:
    min_views: int = 3
    """Zhang's method needs three; ten or more with strong tilts are good."""
    max_view_ratio: float = 3.0
    min_outlier_px: float = 0.5
    """A view with a smaller RMS than this is never left out."""
    max_views: int = 100
    """Of more, the most informative ones are used (D-optimal): some seconds, where a thousand would take an hour."""
    lens: Literal["auto", "brown", "rational", "fisheye"] = "auto"
    """OpenCV's five coefficients, its eight, or its fisheye; auto: the one that views held out ask for."""


@dataclass(frozen=True)
class IntrinsicsResult:
    """Intrinsics of one camera and what they rest on."""

    intrinsics: Intrinsics
    standard_deviation: FloatArray
    """(4 + n,) of fx, fy, cx, cy (px) and the lens's coefficients; 0 for k3 where it is held at 0."""
    rms_px: float
    view_rms_px: dict[str, float]
    """By frame, of the views that were used."""
    dropped: dict[str, str]
    """Why, by frame, of the views that were left out."""
    not_needed: tuple[str, ...] = ()
    """Frames of the views beyond `max_views`."""
    choice: LensChoice = field(default_factory=lambda: LensChoice("brown", {}))
    """The kind of the lens, and how well each kind fits."""


def calibrate_intrinsics(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], params: IntrinsicsParams | None = None
) -> IntrinsicsResult:
    """Intrinsics of the camera whose `views` these are, for images of `size` (width, height) px.

    Raises
    ------
    CalibrationError
        Too few views, or views that do not determine the focal length.
    """
    params = params or IntrinsicsParams()
    name = views[0].camera if views else "camera"
    kept, dropped = most_telling(views, board, size, params.max_views), dict[str, str]()
    not_needed = tuple(v.frame for v in views if v.frame not in {k.frame for k in kept})
    _check_enough(kept, params, name)
    if params.lens == "auto":
        choice, solution = choose(kept, board, size)
    else:
        choice, solution = LensChoice(params.lens, {}), best(kept, board, size, params.lens)
    while True:
        rms = solution.view_rms_px
        worst = int(np.argmax(rms))
        limit_px = max(params.max_view_ratio * float(np.median(rms)), params.min_outlier_px)
        if rms[worst] <= limit_px:
            break
        dropped[kept[worst].frame] = f"RMS {rms[worst]:.2f} px, {limit_px:.2f} px allowed"
        del kept[worst]
        _check_enough(kept, params, name)
        solution = best(kept, board, size, choice.kind)
    lens, sd = solution.lens, solution.standard_deviation
    if not np.all(sd[:2] < MAX_RELATIVE_SD * lens.vector[:2]):
        raise CalibrationError(
            f"{name}: focal length {lens.fx:.0f} px known to {sd[0]:.0f} px only, from {len(kept)} views; "
            f"{100 * MAX_RELATIVE_SD:.0f} % needed. Film the board tilted up to 40 degrees, both ways, not only square to the camera"
        )
    if (chi2 := _chi2_of_wrong_focal(kept, board, choice.kind, solution)) < PROFILE_SIGMAS**2:
        raise CalibrationError(
            f"{name}: a focal length {100 * PROFILE_SIGMAS * MAX_RELATIVE_SD:.0f} % off fits the {len(kept)} views nearly as "
            f"well (chi^2 larger by {max(chi2, 0):.0f}); {PROFILE_SIGMAS**2:.0f} needed. "
            "Film the board tilted up to 40 degrees, both ways, not only square to the camera"
        )
    by_frame = dict(zip([view.frame for view in kept], rms.tolist(), strict=True))
    return IntrinsicsResult(lens, sd, solution.rms_px, by_frame, dropped, not_needed, choice)


def _check_enough(kept: Sequence[BoardView], params: IntrinsicsParams, name: str) -> None:
    if len(kept) < params.min_views:
        raise CalibrationError(
            f"{name}: {len(kept)} usable view(s) of the board for the intrinsics, {params.min_views} needed. "
            "Film the board close, in all parts of the image, tilted up to 40 degrees both ways"
        )


def most_telling(views: Sequence[BoardView], board: Board, size: tuple[int, int], n: int) -> list[BoardView]:
    """The `n` views that together tell most of the lens, in their order; all where there are no more."""
    if len(views) <= n:
        return list(views)
    spread = np.linspace(0, len(views) - 1, max(n // 2, 3)).astype(int)
    lens = solve([views[i] for i in spread], board, size, "brown", hold_k3=True).lens
    told = np.stack([information(view, board, lens) for view in views])
    weak = np.array([0.1 * lens.fx, 0.1 * lens.fy, 0.1 * size[0], 0.1 * size[1], 0.5, 0.5, 0.05, 0.05, 0.5])
    return [views[i] for i in most_informative(np.diag(weak**-2.0), told.__getitem__, len(views), n)]


def _chi2_of_wrong_focal(views: list[BoardView], board: Board, kind: LensKind, solution: ZhangSolution) -> float:
    """By how much chi^2 grows, in units of the residuals' own variance, where the focal lengths are held off."""
    n, lens, grown = 2 * sum(len(view.ids) for view in views), solution.lens, [float("inf")]
    hold_k3 = kind == "brown" and lens.distortion[4] == 0
    for factor in (1 - PROFILE_SIGMAS * MAX_RELATIVE_SD, 1 / (1 - PROFILE_SIGMAS * MAX_RELATIVE_SD)):
        vector = lens.vector
        vector[:2] *= factor
        if kind != "fisheye":  # the same lens in pixels
            vector[4:] *= factor ** np.array([2, 4, 1, 1, 6, 2, 4, 6])[: len(lens.distortion)]
        try:
            held = solve(
                views,
                board,
                (lens.width, lens.height),
                kind,
                hold_k3=hold_k3,
                guess=lens.with_vector(vector),
                hold_focal=True,
            )
        except CalibrationError:
            continue  # it fits no view at all
        grown.append(n * ((held.rms_px / solution.rms_px) ** 2 - 1))
    return min(grown)
