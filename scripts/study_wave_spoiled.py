"""What the self-checks of a carried board say: of good recordings nothing, of spoiled ones the cause; for docs/guides/clocks.md.

python scripts/study_wave_spoiled.py --kinds none --cameras 2 --seeds 0 5 [--parts]
python scripts/study_wave_spoiled.py --seeds 0 2
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from study_wave import alignment_mm

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.calibrate_carried import calibrate_carried
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.session import TrueScene, draw_scene
from rgbd_calib.simulation.wave import WaveSession, film_wave, write_wave
from rgbd_calib.trust import uncertainty
from rgbd_calib.trust.verdict import judge
from rgbd_calib.types import Board, BoardShape, BoardView, Rig

SPOILED = "C2"
MOTION = np.array([0.004, -0.006, 0.003, 0.006, -0.004, 0.008])
"""rad and m: a camera that is knocked."""
PARTS = {
    "pose": ("T_world_color",),
    "lens": ("intrinsics",),
    "depth": ("depth_bias", "depth_field", "depth_camera"),
}
Film = Callable[[TrueScene, Board | None], WaveSession]


def late(session: WaveSession, view: BoardView) -> bool:
    """Is it of the spoiled camera's second half?"""
    times = session.t_s[view.camera]
    return view.camera == SPOILED and times[view.frame] > float(np.median(list(times.values())))


def joined(before: WaveSession, after: WaveSession) -> WaveSession:
    """The spoiled camera's second half from another session of the same motion and clocks."""
    views = [v for v in before.views if not late(before, v)] + [v for v in after.views if late(after, v)]
    return replace(before, views=tuple(views))


def with_camera(scene: TrueScene, **changes: object) -> TrueScene:
    cameras = {**scene.rig.cameras, SPOILED: replace(scene.rig.cameras[SPOILED], **changes)}  # type: ignore[arg-type]
    return replace(scene, rig=replace(scene.rig, cameras=cameras))


def moved(scene: TrueScene, film: Film) -> WaveSession:
    T = se3.retract(scene.rig.cameras[SPOILED].T_world_color, MOTION)
    return joined(film(scene, None), film(with_camera(scene, T_world_color=T), None))


def refocused(scene: TrueScene, film: Film) -> WaveSession:
    K = scene.rig.cameras[SPOILED].intrinsics
    other = replace(K, fx=1.008 * K.fx, fy=1.008 * K.fy)
    return joined(film(scene, None), film(with_camera(scene, intrinsics=other), None))


def wrong_square(scene: TrueScene, film: Film) -> WaveSession:
    return film(scene, replace(scene.board, square_m=1.05 * scene.board.square_m, shape=None))


def clock_jumps(scene: TrueScene, film: Film) -> WaveSession:
    session = film(scene, None)
    stamps = dict(session.stamps_us[SPOILED])
    for frame in list(stamps)[len(stamps) // 2 :]:
        stamps[frame] = (stamps[frame][0] + 12e3, stamps[frame][1] + 12e3)
    return replace(session, stamps_us={**session.stamps_us, SPOILED: stamps})


def each_view(session: WaveSession, change: Callable[[BoardView], BoardView]) -> WaveSession:
    return replace(session, views=tuple(change(v) for v in session.views))


def depth_drifts(scene: TrueScene, film: Film) -> WaveSession:
    session = film(scene, None)
    return each_view(session, lambda v: replace(v, depth_m=v.depth_m + 0.012) if late(session, v) else v)


def depth_scaled(scene: TrueScene, film: Film) -> WaveSession:
    session = film(scene, None)

    def change(v: BoardView) -> BoardView:
        return replace(v, depth_m=v.depth_m * 1.02) if v.camera == SPOILED else v

    return each_view(session, change)


def bent_board(scene: TrueScene, film: Film) -> WaveSession:
    """An S, 4 mm high, that no bow follows; both sides of a plate."""
    board = scene.board
    shape = board.shape or BoardShape(board.corners_m(), None)

    def bent(corners: FloatArray | None) -> FloatArray | None:
        if corners is None:
            return None
        x = corners[:, 0] / ((board.cols - 1) * board.square_m) * 2 - 1
        return corners + np.outer(0.004 * np.sin(np.pi * x), [0, 0, 1])

    made = replace(board, shape=replace(shape, front_m=bent(shape.front_m), back_m=bent(shape.back_m)))
    return film(replace(scene, board=made), None)


def odd_lens(scene: TrueScene, film: Film) -> WaveSession:
    """A window before the camera: half a pixel of a pattern that no lens has."""
    K = scene.rig.cameras[SPOILED].intrinsics

    def change(v: BoardView) -> BoardView:
        x, y = (v.corners_px / [K.width, K.height] * 2 - 1).T
        return (
            replace(v, corners_px=v.corners_px + np.column_stack([x**3 * y, x * y**3 - x**2]))
            if v.camera == SPOILED
            else v
        )

    return each_view(film(scene, None), change)


def host_stamps(scene: TrueScene, film: Film) -> WaveSession:
    """Stamps of the host: 6 ms of jitter."""
    session, rng = film(scene, None), np.random.default_rng(1)
    noisy = {f: (s + e, d + e) for (f, (s, d)), e in zip(
        session.stamps_us[SPOILED].items(), 6e3 * rng.standard_normal(len(session.stamps_us[SPOILED])), strict=True)}  # fmt: skip
    return replace(session, stamps_us={**session.stamps_us, SPOILED: noisy})


KINDS: Mapping[str, Callable[[TrueScene, Film], WaveSession]] = {
    "none": lambda scene, film: film(scene, None),
    "camera moved half-way": moved,
    "lens refocused half-way": refocused,
    "square stated 5 % too large": wrong_square,
    "clock jumps by 12 ms half-way": clock_jumps,
    "depth offset +12 mm half-way": depth_drifts,
    "depth of one camera 2 % too long": depth_scaled,
    "board bent to an S of 4 mm": bent_board,
    "corners off by a smooth field": odd_lens,
    "host timestamps, 6 ms of jitter": host_stamps,
}


def parts_mm(rig: Rig, session: WaveSession) -> dict[str, float]:
    """Alignment where the board went and over the volume, with the true poses, intrinsics or depth in place of the estimate's."""
    truth, out = session.truth, {}
    T_truth_found = truth.cameras[rig.reference].T_world_color @ se3.inverse(rig.cameras[rig.reference].T_world_color)
    for name, keys in PARTS.items():
        cameras = {}
        for c, own in rig.cameras.items():
            true = {k: getattr(truth.cameras[c], k) for k in keys}
            if "T_world_color" in true:
                true["T_world_color"] = se3.inverse(T_truth_found) @ true["T_world_color"]
            cameras[c] = replace(own, **true)
        mixed = replace(rig, cameras=cameras)
        out[f"true {name}"] = alignment_mm(mixed, truth, session)
        out[f"true {name}, 1 to 3 m"] = alignment_mm(mixed, truth)
    return out


def at_corners_mm(rig: Rig, session: WaveSession) -> float:
    """Mean alignment of two cameras at the places of the board's corners, not over the box about them."""
    truth, board = session.truth, session.board
    points = np.concatenate([se3.transform(session.T_world_board(v), board.corners_m()) for v in session.views[::5]])
    seen = {name: uncertainty.observe(truth, name, points) for name in truth.cameras}
    out = []
    for a, b in combinations(truth.cameras, 2):
        both = seen[a].seen & seen[b].seen
        if both.any():
            p, q = (uncertainty.place(rig, name, seen[name].only(both)) for name in (a, b))
            out.append(np.linalg.norm(p - q, axis=1))
    return 1e3 * float(np.concatenate(out).mean())


def study(kind: str, seed: int, cameras: int, args: argparse.Namespace) -> str:
    rng = np.random.default_rng(seed)
    scene = draw_scene(cameras, "arc", 30, 0, rng, realism=Realism().without(*args.without))
    params = WaveParams(seconds=args.seconds, rate_hz=args.rate, offset_s=45.0, lost=0.1)

    def film(own: TrueScene, stated: Board | None) -> WaveSession:
        return film_wave(own, params, np.random.default_rng(seed + 1000), stated=stated)

    session, begin = KINDS[kind](scene, film), time.process_time()
    head = f"{kind} | {cameras} | {seed} | "
    with tempfile.TemporaryDirectory() as name:
        write_wave(session, Path(name))
        try:
            found = calibrate_carried(
                open_recording(Path(name) / "wave"), load_config(None), detections=Detections(session.views, ())
            ).rig
        except CalibrationError as error:
            return f"{head}refused: {error}"
    seconds, quality = time.process_time() - begin, found.quality
    errors = alignment_mm(found, session.truth, session), alignment_mm(found, session.truth)
    stated = quality.expected_mm or float("nan")
    lines = [
        f"{head}{judge(quality, []).level} | {errors[0]:.2f} mm where the board went, stated {stated:.2f}; {errors[1]:.2f} mm over 1 "
        f"to 3 m; {at_corners_mm(found, session):.2f} mm at the corners' own places; {seconds:.0f} s"
    ]
    checks = quality.self_check
    tests = [t for t in checks.tests or () if t.dof]
    mean = np.mean([t.chi2 / t.dof for t in tests]) if tests else float("nan")
    lines += [
        f"    {len(checks.findings)} findings of {checks.tested} tests, chi2/dof of the best of each kind {mean:.2f}"
    ]
    lines += [f"    {f.level}: {f.text} (p {f.p}, {f.effect_mm} mm)" for f in checks.findings]
    if args.parts:
        lines.append("    " + ", ".join(f"{key} {value:.2f}" for key, value in parts_mm(found, session).items()))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=[kind for kind in KINDS if kind != "none"], choices=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 2), metavar=("FIRST", "END"))
    parser.add_argument("--cameras", type=int, nargs="+", default=[2])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--without", nargs="*", default=[], choices=["print", "depth_field", "registration", "images"])
    parser.add_argument("--parts", action="store_true", help="which part carries the error, too")
    args = parser.parse_args()
    for cameras in args.cameras:
        for kind in args.kinds:
            for seed in range(*args.seeds):
                print(study(kind, seed, cameras, args), flush=True)


if __name__ == "__main__":
    main()
