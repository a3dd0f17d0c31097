"""What a carried board gives: clocks and alignment over seeds, against still frames."""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.calibrate import calibrate
from rgbd_calib.pipeline.calibrate_carried import calibrate_carried
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.session import draw_scene, film, write_session
from rgbd_calib.simulation.wave import WaveSession, film_wave, write_wave
from rgbd_calib.types import Rig

EVERY = 5
"""Of the views, those whose boards span the volume where the board went."""


def alignment_mm(rig: Rig, truth: Rig, session: WaveSession | None = None) -> float:
    """Mean over what two cameras see from 1 to 3 m, or over where a session's board went."""
    boards, board = {}, None
    if session is not None:
        boards = {f"{v.camera} {v.frame}": session.T_world_board(v) for v in session.views[::EVERY]}
        board = session.board
    return 1e3 * float(against_truth(rig, truth, boards, board).distance_m.mean())


def pose_nees(rig: Rig, truth: Rig) -> float:
    """Mean over the cameras but the reference, per degree of freedom."""
    out = []
    for name, own in rig.cameras.items():
        if name != rig.reference:
            left = se3.difference(own.T_world_color, truth.cameras[name].T_world_color)
            out.append(float(left @ np.linalg.solve(own.covariance, left)) / 6)
    return float(np.mean(out))


def study(seed: int, cameras: int, args: argparse.Namespace) -> dict[str, Any]:
    realism = IDEAL if args.ideal else Realism()
    rng = np.random.default_rng(seed)
    scene = draw_scene(cameras, "arc", args.still_frames, 0, rng, realism=realism)
    params = WaveParams(
        seconds=args.seconds,
        rate_hz=args.rate,
        offset_s=args.offset,
        lost=0.1,
        drift_ppm=args.drift,
        readout_s=args.readout,
        jitter_s=args.jitter,
    )
    session = film_wave(scene, params, rng)
    out: dict[str, Any] = {"seed": seed, "cameras": cameras, "views": len(session.views)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_wave(session, folder)
        begin = time.process_time()
        found = calibrate_carried(
            open_recording(folder / "wave"), load_config(None), detections=Detections(session.views, ())
        ).rig
        out["cpu_s"] = time.process_time() - begin
        out["mm"], out["nees"] = alignment_mm(found, session.truth), pose_nees(found, session.truth)
        out["board_mm"] = alignment_mm(found, session.truth, session)
        out["stated_mm"] = found.quality.expected_mm or float("nan")
        for name_, truth in session.clocks.items():
            clock = found.cameras[name_].clock
            assert clock is not None
            out.setdefault("offset_ms", []).append(1e3 * (clock.offset_s - truth.offset_s))
            middle_ms = 1e3 * (clock.offset_s - truth.offset_s) + 0.5e-3 * args.seconds * (
                clock.drift_ppm - truth.drift_ppm
            )
            out.setdefault("middle_ms", []).append(middle_ms)
            out.setdefault("offset_sd_ms", []).append(1e3 * clock.offset_sd_s)
            out.setdefault("drift_ppm", []).append(clock.drift_ppm - truth.drift_ppm)
            out.setdefault("drift_sd_ppm", []).append(clock.drift_sd_ppm)
            out.setdefault("delay_ms", []).append(1e3 * (clock.depth_delay_s - truth.depth_delay_s))
            out.setdefault("delay_sd_ms", []).append(1e3 * clock.depth_delay_sd_s)
            out.setdefault("readout_ms", []).append(1e3 * (clock.readout_s - truth.readout_s))
        if args.compare:
            still = film(scene, rng)
            write_session(replace(still, close=None), folder)
            begin = time.process_time()
            alone = calibrate(
                open_recording(folder / "extrinsic"), load_config(None), detections=Detections(still.views, ())
            ).rig
            out["still_cpu_s"], out["still_views"] = time.process_time() - begin, len(still.views)
            out["still_mm"] = alignment_mm(alone, session.truth)
            out["still_board_mm"] = alignment_mm(alone, session.truth, session)
    return out


def told(own: dict[str, Any]) -> str:
    lines = [f"{own['cameras']} cameras, seed {own['seed']}, {own['views']} views, {own['cpu_s']:.0f} s CPU:"]
    ratio = own["stated_mm"] / own["board_mm"]
    lines.append(
        f"  alignment {own['board_mm']:.2f} mm where the board went (stated {own['stated_mm']:.2f}, stated/true {ratio:.2f}), "
        f"{own['mm']:.2f} mm over 1 to 3 m, NEES of poses {own['nees']:.2f}"
    )
    for key, sd, unit in (
        ("offset_ms", "offset_sd_ms", "ms"),
        ("drift_ppm", "drift_sd_ppm", "ppm"),
        ("delay_ms", "delay_sd_ms", "ms"),
    ):
        pairs = ", ".join(f"{e:+.3f} ± {s:.3f}" for e, s in zip(own[key], own[sd], strict=True) if s > 0)
        lines.append(f"  error of {key.split('_')[0]}, {unit}: {pairs}")
    lines.append(f"  error of the clocks in the middle, ms: {', '.join(f'{e:+.3f}' for e in own['middle_ms'])}")
    lines.append(f"  error of readout, ms: {', '.join(f'{e:+.2f}' for e in own['readout_ms'])}")
    if "still_mm" in own:
        lines.append(
            f"  still frames: {own['still_board_mm']:.2f} mm where the board went, {own['still_mm']:.2f} mm over 1 to 3 m ({own['still_views']} views, {own['still_cpu_s']:.0f} s CPU)"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 5), metavar=("FIRST", "END"))
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--offset", type=float, default=45.0, help="clocks are drawn from +- this, s")
    parser.add_argument("--drift", type=float, default=20.0)
    parser.add_argument("--readout", type=float, default=0.0)
    parser.add_argument("--jitter", type=float, default=0.0)
    parser.add_argument("--still-frames", type=int, default=30)
    parser.add_argument("--ideal", action="store_true", help="no print, field and registration errors")
    parser.add_argument("--compare", action="store_true", help="still frames too")
    args = parser.parse_args()
    for cameras in args.cameras:
        for seed in range(*args.seeds):
            print(told(study(seed, cameras, args)), flush=True)


if __name__ == "__main__":
    main()
