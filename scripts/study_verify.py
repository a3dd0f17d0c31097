"""Does `verify` name the camera that moved by 5 mm or 0.3 degrees, and pass where nothing moved? New frames, 10 seeds each.

Frames are simulated as corners (0.1 px, depth noise), through the truth with one camera moved, and judged by a rig that
was calibrated before. With --render one case of each kind is rendered as images too, and its corners are detected.

    rgbd-calib simulate demo && rgbd-calib calibrate demo/extrinsic --intrinsics demo/intrinsic \\
        --depth-bias demo/depth_bias -o demo/rig.yaml
    python scripts/study_verify.py demo/rig.yaml demo/truth.yaml --render /tmp/rendered
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import detect, silent
from rgbd_calib.pipeline.verify import Verification, verify, verify_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.simulation import recording as simulated
from rgbd_calib.simulation.views import ViewNoise, near_poses, true_views
from rgbd_calib.trust.displacement import VerdictParams
from rgbd_calib.types import Board, Rig
from rgbd_calib.views.detect import DetectParams

KINDS = {"nothing": (0.0, 0.0), "5 mm": (0.0, 0.005), "0.3 deg": (np.radians(0.3), 0.0)}


def moved(truth: Rig, name: str, kind: str, rng: np.random.Generator) -> Rig:
    """The truth with one camera moved about its own centre, in a random direction."""
    turn, shift = KINDS[kind]
    ways = rng.normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    T = truth.cameras[name].T_world_color
    T = T @ se3.retract(np.eye(4), np.concatenate([turn * ways[0], shift * ways[1]]))
    return replace(truth, cameras=truth.cameras | {name: replace(truth.cameras[name], T_world_color=T)})


def row(kind: str, name: str, frames: int, results: list[Verification]) -> str:
    still = kind.startswith("nothing")
    expected = () if still else (name,)
    right = sum(r.verdict.moved == expected and r.verdict.holds == still for r in results)
    alone = sum(not r.verdict.rivals for r in results)
    worst = [1e3 * max(p.error_m for p in r.verdict.pairs) for r in results]
    noise = [1e3 * np.median([p.noise_m for p in r.verdict.pairs]) for r in results]
    return (
        f"| {kind} | {name or '-'} | {frames} | {right} of {len(results)} | {alone} | "
        f"{min(worst):.2f} ... {max(worst):.2f} | {np.median(noise):.2f} |"
    )


def rendered(rig: Rig, kind: str, name: str, out: Path) -> str:
    """One case as images: new board poses in the simulated room, one camera moved."""
    params = simulated.SimulationParams(frames=6, intrinsic_views=0, distances_m=())
    truth = simulated.true_rig_of(params)
    turn, shift = KINDS[kind]
    step = np.concatenate([turn * np.array([0.6, 0.8, 0.0]), shift * np.array([0.6, 0.0, 0.8])])
    pose = truth.T_room_color[name] @ se3.retract(np.eye(4), step)
    changed = replace(truth, T_room_color=truth.T_room_color | {name: pose})
    out.mkdir(parents=True)
    with mock.patch.object(simulated, "true_rig_of", lambda _: changed):
        # another seed draws other board poses and noise; the rig is the given one
        simulated.simulate(out, replace(params, seed=77), 1, silent)
    recording = open_recording(out / "extrinsic")
    found = detect(recording, DetectParams(), Workers(1))
    return row(kind + ", rendered", name, 6, [verify(rig, recording, found.views, Config(), VerdictParams())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--frames", type=int, nargs="+", default=[5, 8])
    parser.add_argument("--render", type=Path, help="folder for rendered cases (some minutes)")
    given = parser.parse_args()
    rig, truth = read_rig(given.rig), read_rig(given.truth)
    shared = {f: T for f, T in read_boards(given.truth).items() if f < "1"}
    board = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
    print("| moved | camera | frames | right | no rival | worst pair, mm | noise, mm |\n|---|---|---|---|---|---|---|")
    for frames in given.frames:
        for kind in KINDS:
            for name in truth.cameras if kind != "nothing" else [""]:
                results = []
                for seed in range(given.seeds):
                    rng = np.random.default_rng([seed, frames, *map(ord, kind + name)])
                    now = moved(truth, name, kind, rng) if name else truth
                    views = true_views(now, near_poses(shared, board, frames, rng), board, ViewNoise(), rng)
                    results.append(verify_views(rig, views, board, tuple(rig.cameras), Config(), VerdictParams()))
                print(row(kind, name, frames, results), flush=True)
    if given.render:
        for kind, name in (("nothing", "C1"), ("5 mm", "C3"), ("0.3 deg", "C1")):
            print(rendered(rig, kind, name, given.render / kind.replace(" ", "_")), flush=True)


if __name__ == "__main__":
    main()
