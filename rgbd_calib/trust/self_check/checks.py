"""Checks that need no equations: noise against what sensors have, cameras that do not agree, instants that were copied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_sf
from rgbd_calib.trust.self_check.findings import Finding, Level, SelfCheckParams
from rgbd_calib.types import BoardView, IntArray, PlacedView
from rgbd_calib.views.association import Cause
from rgbd_calib.views.depth_scale import clipped_share

LEAST_SD = 1e-9
"""Radians, or metres: of poses that are equal."""
RUN_SHARE = 0.75
"""Of the views that were left out, and of a run of frames: what left them out began and ended at some frame."""


@dataclass(frozen=True)
class ResidualNoise:
    """What a camera's residuals show."""

    sigma_px: float | None
    """Of a pixel coordinate."""
    depth_k_per_m: float | None
    """sigma_z = k z^2 of one corner."""
    apart_px_mm: float = 0.0
    """RMS by which a view's pixels put its board beside where the others put it, mm at the board."""
    apart_depth_mm: float = 0.0
    """The same by its depth."""


def check_noise(noise: Mapping[str, ResidualNoise], params: SelfCheckParams, stated_mm: float) -> list[Finding]:
    """Estimated sigmas against what sensors of this kind have."""
    out = []
    for name, own in noise.items():
        if own.sigma_px is not None and own.sigma_px > params.max_sigma_px:
            level: Level = "distrust" if own.sigma_px > params.bad_sigma_px else "caution"
            text = f"{name}'s corners scatter by {own.sigma_px:.2f} px; finders leave 0.02 to 0.2 px"
            advice = (
                "Blur, a lens that the model does not follow, images of another size, or a board that is not flat. Look at "
                "its residuals in the report; more light, a still board, the right intrinsics"
            )
            out.append(Finding("pixel noise", level, (name,), text, advice))
        if own.depth_k_per_m is not None and own.depth_k_per_m > params.max_depth_k_per_m:
            level = "distrust" if own.depth_k_per_m > params.bad_depth_k_per_m else "caution"
            text = (
                f"{name}'s depth scatters by {4e3 * own.depth_k_per_m:.0f} mm at 2 m, after averaging around each corner; a "
                "single pixel of a Kinect has 6 mm"
            )
            advice = "Depth of another mode or scale, not registered to colour, or lossy (JPEG, 8 bits). Look at a depth image"
            out.append(Finding("depth noise", level, (name,), text, advice))
        for apart_mm, by, check in (
            (own.apart_px_mm, "pixels", "boards apart"),
            (own.apart_depth_mm, "depth", "depth of whole boards"),
        ):
            if apart_mm > max(params.max_apart_mm, stated_mm):
                level = "distrust" if apart_mm > params.bad_apart_mm else "caution"
                text = (
                    f"In one frame, {name}'s {by} put the board {apart_mm:.0f} mm (RMS) from where everything together puts it, far "
                    "more than the noise of its corners"
                )
                advice = (
                    "The board moved between exposures, or clocks differ: hold it still until all have exposed (`doctor` names "
                    "the frames). Or the lens or the depth is not as the model has it"
                )
                out.append(Finding(check, level, (name,), text, advice, round(apart_mm, 2)))
    return out


def check_votes(
    pairs: Sequence[tuple[tuple[str, str], int, int, Cause | None]], two_sided: bool, params: SelfCheckParams
) -> list[Finding]:
    """Pairs of cameras, their common frames, how many of these agree on the relative pose, and why so few."""
    out = []
    poor = [own for own in pairs if own[1] > 1 and own[2] < params.min_votes_share * own[1]]
    advice = (
        "Frames of different instants under one name, mirrored images, another pattern in view, or images of another "
        "session" + ("" if two_sided else "; or a board with two faces without `two_sided: true`")
    )
    for pair, frames, votes, cause in poor:
        text = f"{pair[0]} and {pair[1]}: only {votes} of {frames} common frames agree on the relative pose"
        if cause is None:
            out.append(Finding("frames agree", "distrust", pair, text, advice))
    causes = {(cause.text, cause.advice): cause for *_, cause in poor if cause is not None}
    for cause in causes.values():
        of_cause = [own for own in poor if own[3] == cause]
        named = ", ".join(f"{a} and {b}: {votes} of {frames}" for (a, b), frames, votes, _ in of_cause)
        cameras = tuple(dict.fromkeys(c for pair, *_ in of_cause for c in pair))
        text = f"Few common frames agree on the relative pose ({named}): {cause.text}"
        out.append(Finding("frames agree", "distrust", cameras, text, cause.advice))
    return out


def check_steps(views: Sequence[PlacedView], frames_in_time: Sequence[str], params: SelfCheckParams) -> list[Finding]:
    """Relative poses by single views that change at one frame, the clearest first.

    A change that bends everything else to it, lenses and boards too, or of which most views were left out, leaves no sound
    estimate by which to see it. So each frame is asked alone: the likeliest step of errors by Laplace, of a scale that each component has for itself; then the step
    of the medians against the median absolute deviation from them.
    """
    poses: dict[str, dict[str, FloatArray]] = {}
    for v in views:
        poses.setdefault(v.view.frame, {})[v.view.camera] = v.T_color_board
    found: list[tuple[float, tuple[str, str], str]] = []
    for pair in combinations(sorted({v.view.camera for v in views}), 2):
        common = [f for f in frames_in_time if set(pair) <= poses.get(f, {}).keys()]
        if len(common) < 2 * params.min_side:
            continue
        relative = np.stack([poses[f][pair[0]] @ se3.inverse(poses[f][pair[1]]) for f in common])
        x = se3.difference(relative, relative[0])
        places = range(params.min_side, len(common) - params.min_side + 1)
        n = min(places, key=lambda n: float(np.log(np.abs(_about_medians(x, n)).mean(axis=0) + LEAST_SD).sum()))
        of_median = np.sqrt(np.pi / 2 * (1 / n + 1 / (len(common) - n)))
        sd = np.maximum(1.4826 * np.median(np.abs(_about_medians(x, n)), axis=0) * of_median, LEAST_SD)
        size = float(np.linalg.norm((np.median(x[n:], axis=0) - np.median(x[:n], axis=0)) / sd))
        if size > params.min_step_sd:
            found.append((size, pair, common[n]))
    advice = "A camera was moved or mounted anew, or its lens refocused: keep the frames before it or those from it on"
    return [
        Finding(
            "pose over time",
            "distrust",
            pair,
            f"{' and '.join(pair)}: their relative pose changed at frame {frame}",
            advice,
        )
        for _, pair, frame in sorted(found, reverse=True)
    ]


def _about_medians(x: FloatArray, n: int) -> FloatArray:
    """Rows (frames, k) less the median of the first n, or of the rest."""
    return np.concatenate([x[:n] - np.median(x[:n], axis=0), x[n:] - np.median(x[n:], axis=0)])


def check_dropped(
    views: Mapping[str, Sequence[str]],
    dropped: Mapping[str, Sequence[str]],
    frames_in_time: Sequence[str],
    params: SelfCheckParams,
    what: str = "",
) -> list[Finding]:
    """The frames of each camera's views, and of those that were left out; `what` of them, if not all."""
    out = []
    for name, frames in dropped.items():
        seen, lost = set(views.get(name, ())), set(frames)
        if len(lost) <= max(params.max_dropped_share * len(seen), 1):
            continue
        when = _run([f for f in frames_in_time if f in seen], lost)
        text = f"{what}{len(lost)} of {name}'s {len(seen)} views do not fit the rest and were left out{when}"
        advice = (
            "So many are no accident: the camera moved, its images are of other instants or of another camera, or another "
            "pattern is in view. Look at the frames that are named above"
        )
        out.append(Finding("views left out", "distrust", (name,), text, advice))
    return out


def _run(in_time: Sequence[str], lost: set[str]) -> str:
    """Between which of a camera's frames those that were left out are, where nearly all are in one run of them."""
    gain = np.cumsum([0, *(1 if frame in lost else -1 for frame in in_time)])
    first = np.minimum.accumulate(gain)
    last = int(np.argmax(gain - first))  # the run in which most more are lost than kept
    begin = int(np.flatnonzero(gain[: last + 1] == first[last])[-1])
    run = [frame for frame in in_time[begin:last] if frame in lost]
    if len(run) < 3 or len(run) < RUN_SHARE * max(len(lost & set(in_time)), last - begin):
        return ""
    return f", {'all' if lost <= set(run) else f'{len(run)} of them'} between {run[0]} and {run[-1]}"


def check_copies(views: Sequence[BoardView], sigma_px: float, params: SelfCheckParams) -> list[Finding]:
    """Frames in which nothing moved are one measurement, not many."""
    by_frame: dict[str, dict[str, BoardView]] = {}
    for view in views:
        by_frame.setdefault(view.frame, {})[view.camera] = view
    placements: list[dict[str, BoardView]] = []
    places = _Places(views, len(by_frame))
    limit = params.copies_sigmas * sigma_px
    for frame in sorted(by_frame):
        own = by_frame[frame]
        if not any(_same(own, placements[k], limit) for k in places.near(own, limit)):
            places.add(own)
            placements.append(own)
    if len(by_frame) <= params.max_copies * len(placements):
        return []
    ratio = len(by_frame) / len(placements)
    text = (
        f"{len(by_frame)} frames show the board in {len(placements)} places only: the errors of one place do not average out "
        f"over its frames, and the stated errors are too small by {np.sqrt(ratio):.1f} times or more"
    )
    advice = "Keep one frame of each place, and film the board in more places (20 to 30)"
    return [Finding("placements", "distrust" if len(placements) < 10 else "caution", (), text, advice)]


def check_clipped(views: Sequence[BoardView], params: SelfCheckParams) -> list[Finding]:
    """Depths that end at one value: the sensor, or a conversion, had nothing beyond."""
    depths: dict[str, list[FloatArray]] = {}
    for view in views:
        depths.setdefault(view.camera, []).append(view.depth_m[np.isfinite(view.depth_m)])
    out = []
    for name, listed in depths.items():
        z_m = np.concatenate(listed)
        share = clipped_share(z_m, params.clipped_width)
        if share > params.max_clipped_share:
            text = f"{100 * share:.0f} % of {name}'s depths on the board are {z_m.max():.2f} m, and none is more: they are clipped"
            advice = "Keep the board within the sensor's range, and convert depth without a limit"
            out.append(Finding("depth clipped", "distrust", (name,), text, advice))
    return out


class _Places:
    """Corners of the placements until now, so that a frame is compared with the few that may be its own."""

    def __init__(self, views: Sequence[BoardView], n: int) -> None:
        corners = 1 + max((int(view.ids.max(initial=0)) for view in views), default=0)
        cameras = {view.camera for view in views}
        self._px = {name: np.full((n, corners, 2), np.nan) for name in cameras}
        self._seen = {name: np.zeros(n, bool) for name in cameras}
        self._n = 0

    def add(self, own: Mapping[str, BoardView]) -> None:
        for name, view in own.items():
            self._px[name][self._n, view.ids] = view.corners_px
            self._seen[name][self._n] = True
        self._n += 1

    def near(self, own: Mapping[str, BoardView], limit_px: float) -> IntArray:
        """Numbers of the placements that no camera's first corner tells from this frame, and that some camera sees too."""
        apart, common = np.zeros(self._n, bool), np.zeros(self._n, bool)
        for name, view in own.items():
            if len(view.ids):
                px = self._px[name][: self._n, view.ids[0]]
                apart |= np.any(np.abs(px - view.corners_px[0]) >= limit_px, axis=1)  # never where it is not seen
                common |= self._seen[name][: self._n]
        return np.flatnonzero(common & ~apart)


def _same(a: Mapping[str, BoardView], b: Mapping[str, BoardView], limit_px: float) -> bool:
    """Every camera that sees both sees all corners at the same pixels."""
    common = a.keys() & b.keys()
    return bool(common) and all(_apart_px(a[c], b[c]) < limit_px for c in common)


def _apart_px(a: BoardView, b: BoardView) -> float:
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    return float(np.abs(a.corners_px[i] - b.corners_px[j]).max()) if len(i) else np.inf


def check_factors(factors: Mapping[str, tuple[float, float]], params: SelfCheckParams) -> list[Finding]:
    """Weighted squares over their redundancy, and the redundancy, by kind of residual.

    They are 1 where sigmas were estimated, by construction; where they were given, squares ~ sigma^2 chi2(redundancy).
    """
    out = []
    for kind, (factor, redundancy) in factors.items():
        if not (np.isfinite(factor) and redundancy > 0):
            continue
        p, ratio = chi2_sf(factor * redundancy, redundancy), float(np.sqrt(factor))
        if p < params.significance / len(factors) and ratio > params.max_factor:
            level: Level = "distrust" if ratio > params.max_group_ratio else "caution"
            text = f"{kind} scatter {ratio:.2f} times as much as the sigma that was given ({redundancy:.0f} degrees of freedom)"
            advice = "Leave the sigma to be estimated; or a lens, a pose of the scene or a match is wrong: look at the residuals"
            out.append(Finding("chi-square", level, (), text, advice, p=p))
    return out


def group_ratios(residual_sigmas: FloatArray, group: IntArray, least: int) -> dict[int, float]:
    """Deviation of residuals (n,) by group over that of all, of the groups with `least` or more."""
    whole = float(np.sqrt(np.mean(residual_sigmas**2))) if len(residual_sigmas) else 1.0
    out = {}
    for g in np.unique(group):
        mine = residual_sigmas[group == g]
        if len(mine) >= least:
            out[int(g)] = float(np.sqrt(np.mean(mine**2))) / max(whole, 1e-12)
    return out


def check_groups(ratios: Mapping[tuple[str, str, str], float], params: SelfCheckParams) -> list[Finding]:
    """Ratios by (camera, pixels or depth, part of the data): where the noise is another one, the weights are wrong."""
    out = []
    for (name, kind, part), ratio in ratios.items():
        if ratio > params.max_group_ratio:
            text = f"{name}'s {kind} scatter {ratio:.1f} times as much {part} as on the whole"
            advice = "The stated errors hold on the average only. Look at the residuals of these views in the report"
            out.append(Finding("noise of parts", "caution", (name,), text, advice))
    return out
