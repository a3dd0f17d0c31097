"""Each check looks at what was measured over a whole recording and says what to mend; what is usual in this recording
is the measure for what is odd in it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.views.depth_scale import name_factor
from rgbd_calib.views.doctor.findings import Kind, RecordingFinding, listed
from rgbd_calib.views.doctor.measures import BLACK, ImageMeasures, ViewMeasures

Key = tuple[str, str]
"""(camera, frame)."""


@dataclass(frozen=True)
class DoctorParams:
    """When something is worth a sentence."""

    max_spread_s: float = 0.020
    """Between the exposures of one frame: free-running cameras at 30 Hz are within half a period, 17 ms."""
    min_frames_share: float = 0.9
    """Of the recording's frames, that each camera should have."""
    max_edge_ratio: float = 1.7
    """Of a view's edges over the camera's median, and `max_edge_px` more."""
    max_edge_px: float = 1.0
    max_texture_ratio: float = 0.6
    """Less texture on the board, or where it must be, than this share of the camera's median is blur; sharp views of one
    camera were above 0.72 of it in simulated and real recordings."""
    max_white_share: float = 0.45
    """Of the board's area; half of it is paper. Paper that is partly white does no harm to corners."""
    max_dark_level: float = 120.0
    """Of the dark squares, where a part of the board is white."""
    max_white_image_share: float = 0.3
    min_contrast: float = 40.0
    min_depth_share: float = 0.7
    max_covered_share: float = 0.02
    max_depth_sigmas: float = 5.0
    """Deviation of depth against pixels, in deviations of the camera's other views."""
    max_depth_offset: float = 0.004
    """And as a share of the distance."""
    max_shift_ratio: float = 7.0
    """Board against the other cameras' board, as a share of its distance: over the median of all views. Of 268 simulated views
    of boards that stood still, with prints out of square and lenses by a few views, the worst is at 5.1."""
    max_own_shift_ratio: float = 2.5
    """And over the median of the camera: a lens that is known badly shifts all of its views."""
    max_shift_m: float = 0.005
    max_depth_offset_m: float = 0.010
    """And in metres: less is within what depth is off by in one place of the image or another."""
    max_missed_share: float = 0.3
    """Of the views in which a camera should see the whole board and does not."""
    min_missed: int = 2
    """Fewer of them, or less than 5 %, need no sentence: something stood between."""


def check_frames(
    color: Mapping[str, Sequence[str]], depth: Mapping[str, Sequence[str]], params: DoctorParams
) -> list[RecordingFinding]:
    """Frames that some cameras lack, where cameras were filmed together; depth images that are missing."""
    findings = []
    shared = len({f for frames in color.values() for f in frames}) < sum(map(len, color.values()))
    together = sorted({f for frames in color.values() for f in frames})
    for camera, frames in color.items():
        lost = [f for f in together if f not in frames] if shared else []
        if lost:
            findings.append(
                RecordingFinding(
                    "missing",
                    (camera,),
                    tuple(lost),
                    len(frames) < params.min_frames_share * len(together),
                    f"{camera} has {len(frames)} of {len(together)} frames; {listed(lost)} missing. Check its cable and USB "
                    "bandwidth, and film again",
                )
            )
        bare = [f for f in frames if f not in depth[camera]]
        if not depth[camera]:
            text = f"{camera} has no depth images: it is posed by its pixels alone. Record depth if the camera has it"
            findings.append(RecordingFinding("missing", (camera,), (), False, text))
        elif bare:
            enough = len(frames) - len(bare) >= params.min_frames_share * len(frames)
            text = (
                f"{camera}: {listed(bare)} without depth image ({len(bare)} of {len(frames)}). Check its USB bandwidth, "
                "and film again"
            )
            findings.append(RecordingFinding("missing", (camera,), tuple(bare), not enough, text))
    return findings


def check_stems(
    color: Mapping[str, Sequence[str]], stamps_us: Mapping[str, Mapping[str, tuple[float, float]]]
) -> list[RecordingFinding]:
    """Cameras whose frames never have the name of another camera's, so that nothing says what was simultaneous.

    Where no two cameras share a name and their times do not overlap, each was filmed by itself: nothing to find.
    """
    names = {c: set(frames) for c, frames in color.items() if frames}
    alone = [c for c in names if not any(names[c] & names[other] for other in names if other != c)]
    if len(names) < 2 or not alone:
        return []
    times = {c: [t for t, _ in stamps_us.get(c, {}).values() if np.isfinite(t)] for c in names}
    spans = {c: (min(own), max(own)) for c, own in times.items() if own}
    together = any(
        spans[c][0] <= spans[o][1] and spans[o][0] <= spans[c][1] for c in alone if c in spans for o in spans if o != c
    )
    all_alone = len(alone) == len(names)
    if all_alone and len(spans) == len(names) and not together:
        return []
    shown = "; ".join(f"{c}: {', '.join(sorted(own)[:3])}" for c, own in names.items())
    join = "`rgbd-calib import RECORDING -o NEW --match"
    if together:
        remedy = f"Their times overlap: join frames by time with {join} timestamp`"
    else:
        remedy = (
            "If they were filmed at the same time, name each instant alike, or join frames by their timestamps "
            f"({join} timestamp`) or by their order ({join} order`)"
        )
    text = (
        f"{', '.join(alone)}: no frame has the name of another camera's frame, so that nothing says which images show one "
        f"instant ({shown}). {remedy}"
    )
    return [RecordingFinding("not joined", tuple(alone), (), together or not all_alone, text)]


def check_timestamps(
    stamps_us: Mapping[str, Mapping[str, tuple[float, float]]], params: DoctorParams
) -> list[RecordingFinding]:
    """Exposures of one frame that are too far apart, between cameras and between colour and depth of one camera."""
    findings, limit_us = [], 1e6 * params.max_spread_s
    wanted = f"{1e3 * params.max_spread_s:g} ms at most are needed"
    for camera, rows in stamps_us.items():
        late = {f: abs(c - d) for f, (c, d) in rows.items() if abs(c - d) > limit_us}
        if late:
            text = (
                f"{camera}: colour and depth up to {max(late.values()) / 1e3:.0f} ms apart in {listed(sorted(late))}; "
                f"{wanted}. Hold the board still for a second at each place, or let the sensor synchronise its streams"
            )
            findings.append(RecordingFinding("unsynchronised", (camera,), tuple(sorted(late)), True, text))
    frames = sorted({f for rows in stamps_us.values() for f in rows})
    spread, worst = {}, dict.fromkeys(stamps_us, 0)
    for frame in frames:
        times = {c: rows[frame][0] for c, rows in stamps_us.items() if frame in rows and np.isfinite(rows[frame][0])}
        if len(times) > 1 and max(times.values()) - min(times.values()) > limit_us:
            spread[frame] = max(times.values()) - min(times.values())
            middle = float(np.median(list(times.values())))
            worst[max(times, key=lambda c: abs(times[c] - middle))] += 1
    if spread:
        camera = max(worst, key=lambda c: worst[c])
        text = (
            f"cameras up to {max(spread.values()) / 1e3:.0f} ms apart in {listed(sorted(spread))} ({camera} mostly); {wanted}. "
            "Hold the board still for a second at each place, or synchronise the cameras"
        )
        findings.append(RecordingFinding("unsynchronised", (camera,), tuple(sorted(spread)), True, text))
    return findings


def check_exposure(
    images: Mapping[Key, ImageMeasures], views: Mapping[Key, ViewMeasures], params: DoctorParams
) -> list[RecordingFinding]:
    """Boards, or whole images, that are white or black."""
    bright = [
        k
        for k, m in views.items()
        if m.white_share > params.max_white_share or (m.white_share > 0.2 and m.dark_level > params.max_dark_level)
    ]
    bright += [k for k, m in images.items() if k not in views and m.white_share > params.max_white_image_share]
    dark = [k for k, m in views.items() if m.contrast < params.min_contrast]
    dark += [k for k, m in images.items() if k not in views and m.median_grey < BLACK]
    return [
        *_by_camera("overexposed", bright, "the board or the image is white. Turn the light or the exposure down"),
        *_by_camera("underexposed", dark, "too dark to tell the squares well. Light the board, or expose longer"),
    ]


def check_sharpness(
    views: Mapping[Key, ViewMeasures], missed: Mapping[Key, tuple[float, bool]], params: DoctorParams
) -> list[RecordingFinding]:
    """Views that are blurred against the camera's others, and boards that should be seen and were not found.

    `missed` has the texture where a board must be by the other cameras, and whether it lies well inside the image.
    """
    blurred: list[Key] = []
    lost: list[Key] = []
    for camera in {c for c, _ in (*views, *missed)}:
        mine = {k: m for k, m in views.items() if k[0] == camera}
        widths = [m.edge_px for m in mine.values() if not np.isnan(m.edge_px)]  # of checkerboards only
        usual = np.median(widths) if widths else np.nan
        usual_texture = np.median([m.texture for m in mine.values()]) if mine else np.nan
        for key, m in mine.items():
            wide = m.edge_px > max(params.max_edge_ratio * usual, usual + params.max_edge_px)
            if wide or m.texture < params.max_texture_ratio * usual_texture:
                blurred.append(key)
        for key, (texture, whole) in missed.items():
            if key[0] == camera and texture < params.max_texture_ratio * usual_texture:
                blurred.append(key)
            elif key[0] == camera and whole:
                lost.append(key)
    findings = _by_camera(
        "blurred", blurred, "the board is blurred. Hold it still while all cameras expose, more light"
    )
    for camera in sorted({c for c, _ in lost}):
        frames = tuple(sorted(f for c, f in lost if c == camera))
        expected = len(frames) + sum(c == camera for c, _ in views)
        if len(frames) < max(params.min_missed, 0.05 * expected):
            continue
        text = (
            f"{camera}: the board should be seen whole in {listed(frames)} and was not found ({len(frames)} of {expected}). "
            "Keep things from between, and its white border free"
        )
        findings.append(
            RecordingFinding("not found", (camera,), frames, len(frames) > params.max_missed_share * expected, text)
        )
    return findings


def check_empty(images: set[Key], seen: set[Key]) -> list[RecordingFinding]:
    """Frames in which no camera shows the board."""
    empty = tuple(sorted({f for _, f in images} - {f for _, f in seen}))
    if not empty:
        return []
    text = (
        f"no camera shows the board in {listed(empty)}. They add nothing: hold the board where two cameras see it whole"
    )
    return [RecordingFinding("not found", (), empty, False, text)]


def check_depth_unit(offsets: Mapping[Key, tuple[float, float]], lens_known: Collection[str]) -> list[RecordingFinding]:
    """Cameras whose depth differs from the board's distance by its pixels by a factor that lies between units.

    `offsets` are the board's distance by pixels, metres, and depth over it less one, by view; factors below 2 are judged
    for cameras whose lens is given or estimated, `lens_known`.
    """
    findings = []
    for camera in dict.fromkeys(camera for camera, _ in offsets):
        ratio = float(np.median([1 + share for (name, _), (_, share) in offsets.items() if name == camera]))
        factor = name_factor(ratio)
        if factor and (camera in lens_known or not 0.5 < ratio < 2):
            text = (
                f"{camera}: measured depth is {ratio:.3g} times the board's distance by its pixels, about 1 needed; {factor}. "
                "Correct depth_scale in dataset.yaml, or the board's square if all cameras agree"
            )
            findings.append(RecordingFinding("depth unit", (camera,), (), True, text))
    return findings


def check_depth(
    views: Mapping[Key, ViewMeasures], offset: Mapping[Key, tuple[float, float]], params: DoctorParams
) -> list[RecordingFinding]:
    """Depth that is missing on the board, covered, or of another instant than the colour image.

    `offset` has, for each view, the board's distance by its pixels, metres, and depth over it, less one.
    """
    none = [k for k, m in views.items() if m.depth_share < params.min_depth_share]
    covered = [k for k, m in views.items() if m.covered_share > params.max_covered_share and k not in none]
    late = []
    for camera in {c for c, _ in offset}:
        keys = [k for k in offset if k[0] == camera and k not in none]
        if len(keys) < 4:
            continue
        z, share = np.array([offset[k] for k in keys]).T
        left = share - _robust_line(z, share)
        usual = 1.4826 * float(np.median(np.abs(left)))
        limit = max(params.max_depth_offset, params.max_depth_sigmas * usual)
        late += [
            k
            for k, d, m in zip(keys, left, z, strict=True)
            if abs(d) > limit and abs(d) * m > params.max_depth_offset_m
        ]
    return [
        *_by_camera(
            "no depth",
            none,
            f"depth on less than {100 * params.min_depth_share:.0f} % of the board. Keep it within the sensor's range, turn "
            "it toward the camera, and keep sunlight off it",
        ),
        *_by_camera(
            "covered", covered, "something is before the board in the depth image. Keep hands and cables off it"
        ),
        *_by_camera(
            "depth late",
            [k for k in late if k not in covered],
            "colour and depth put the board at different distances: it moved between the two. Hold it still",
        ),
    ]


def check_consistency(
    shift_m: Mapping[Key, float],
    distance_m: Mapping[Key, float],
    unfit: Mapping[Key, str],
    views: Sequence[Key],
    params: DoctorParams,
) -> list[RecordingFinding]:
    """Views that put the board elsewhere than the other cameras do, and views whose board fits in no reading.

    `distance_m` are of the boards from the cameras: what a lens or a print is off by moves a far board farther.
    """
    findings = []
    share = {key: d / distance_m[key] for key, d in shift_m.items()}
    usual = float(np.median(list(share.values()))) if share else 0.0
    own = {c: float(np.median([d for (b, _), d in share.items() if b == c])) for c, _ in share}
    most = {c: max(params.max_shift_ratio * usual, params.max_own_shift_ratio * d) for c, d in own.items()}
    limit_m = {(c, f): max(params.max_shift_m, most[c] * distance_m[c, f]) for c, f in shift_m}
    frames: dict[str, list[str]] = {}
    for camera, frame in shift_m:
        frames.setdefault(frame, []).append(camera)
    moved: dict[tuple[str, ...], dict[str, Key]] = {}
    for frame, cameras in frames.items():
        off = [c for c in cameras if shift_m[c, frame] > limit_m[c, frame]]
        if off:
            worst = max(off, key=lambda c: shift_m[c, frame])
            named = tuple(sorted(cameras)) if len(cameras) == 2 else (worst,)
            moved.setdefault(named, {})[frame] = worst, frame
    for named, by_frame in sorted(moved.items()):
        worst_view = max(by_frame.values(), key=lambda key: shift_m[key])
        text = (
            f"{' or '.join(named)}: in {listed(sorted(by_frame))} the board is up to {1e3 * shift_m[worst_view]:.0f} mm "
            f"from where {'the other sees' if len(named) == 2 else 'the others see'} it "
            f"({1e3 * usual * distance_m[worst_view]:.1f} mm are usual at {distance_m[worst_view]:.1f} m): "
            "it moved between the shots. Hold it still until all cameras have exposed, or delete these frames"
        )
        findings.append(RecordingFinding("moved", named, tuple(sorted(by_frame)), True, text))
    seen: dict[str, set[str]] = {}
    for camera, frame in views:
        seen.setdefault(frame, set()).add(camera)
    remedy = (
        "another pattern, a board turned round, or frames of different instants. Take other patterns out of sight, or "
        "delete these frames"
    )
    # of two cameras nobody can say which one is wrong
    groups: dict[tuple[str, ...], list[str]] = {}
    for camera, frame in unfit:
        groups.setdefault(tuple(sorted(seen[frame])) if len(seen[frame]) == 2 else (camera,), []).append(frame)
    for group, odd in sorted(groups.items()):
        odd_frames = tuple(sorted(set(odd)))
        others = "the other sees" if len(group) == 2 else "the others see"
        text = (
            f"{' or '.join(group)}: what it shows in {listed(odd_frames)} is not the board where {others} it: {remedy}"
        )
        findings.append(RecordingFinding("not the board", group, odd_frames, True, text))
    return findings


def _robust_line(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Theil and Sen's line (a depth bias grows with distance), or the median where the distances are all alike."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.abs(x[i] - x[j]) > 0.1
    slope = float(np.median((y[i] - y[j])[apart] / (x[i] - x[j])[apart])) if apart.sum() > 5 else 0.0
    line: np.ndarray = slope * x + np.median(y - slope * x)
    return line


def _by_camera(kind: Kind, keys: Sequence[Key], what: str) -> list[RecordingFinding]:
    findings = []
    for camera in sorted({c for c, _ in keys}):
        frames = tuple(sorted(f for c, f in keys if c == camera))
        findings.append(RecordingFinding(kind, (camera,), frames, True, f"{camera}: {listed(frames)}: {what}"))
    return findings
