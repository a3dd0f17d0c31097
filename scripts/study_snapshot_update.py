"""Is a rig that snapshots corrected as good as it was? The figures of docs/guides/drift.md.

    python scripts/study_snapshot_update.py --work DIR --seeds 0 1 2 3

Simulated rigs of 4 cameras on an arc with the errors of real ones are calibrated; one camera moves, by up to 30 mm and 2 degrees; the
rig is corrected by `calibrate NEW --update RIG --snapshot OLD`. Both are compared with the truth. What is in DIR already is not made
again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from study_clouds import made
from study_snapshot import draw_twist

from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.pipeline.evaluate import against_truth


def study(folder: Path, seed: int, width: int) -> dict[str, float | str]:
    rng = np.random.default_rng([seed, 78])
    camera, twist = f"C{rng.integers(2, 5)}", draw_twist(rng)
    common = "--seed", seed, "--width", width, "--height", width * 3 // 4, "--jobs", 1
    full, bumped, before, after = (folder / name for name in ("full", "bumped", "before.yaml", "after.yaml"))
    if not full.exists():
        made("simulate", full, *common)
    if not before.exists():
        sources = "--intrinsics", full / "intrinsic", "--depth-bias", full / "depth_bias"
        made("calibrate", full / "extrinsic", *sources, "-o", before)
    if not bumped.exists():
        move = ",".join(f"{x:.6f}" for x in (*(1e3 * twist[3:]), *np.degrees(twist[:3])))
        made("simulate", bumped, "--snapshot", *common, "--move", f"{camera}:{move}")
    if not after.exists():
        made("calibrate", bumped / "new", "--update", before, "--snapshot", bumped / "old", "-o", after)
    truth, boards, board = (
        read_rig(full / "truth.yaml"),
        read_boards(full / "truth.yaml"),
        open_recording(full / "extrinsic").board,
    )
    own = truth.cameras[camera]
    T = own.T_world_color @ se3.retract(np.eye(4), twist)
    moved = replace(truth, cameras=truth.cameras | {camera: replace(own, T_world_color=T)})
    rigs = {"before": (before, truth), "uncorrected": (before, moved), "corrected": (after, moved)}
    errors = {
        name: against_truth(read_rig(path), true, boards, board).summary().all for name, (path, true) in rigs.items()
    }
    return {"camera": camera} | {name: error.mean_mm for name, error in errors.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(4)))
    parser.add_argument("--width", type=int, default=320)
    args = parser.parse_args()
    print("| seed | moved | as calibrated, mm | not corrected | corrected |\n|---|---|---|---|---|", flush=True)
    for seed in args.seeds:
        row = study(args.work / str(seed), seed, args.width)
        numbers = " | ".join(f"{row[name]:.2f}" for name in ("before", "uncorrected", "corrected"))
        print(f"| {seed} | {row['camera']} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
