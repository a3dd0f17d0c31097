"""Does `refine --clouds` make a rig better, and does it say so? The table of docs/guides/drift.md.

    python scripts/study_clouds.py --work DIR --seeds 4

Rigs of 4 cameras on an arc and in a ring, in the furnished room, simulated with the errors of real ones: as calibrated; from 6 sets
of images alone; with poses spoiled by some mm, that is stated (--pose-sd); and spoiled without a word. Clouds are those of the empty room
(mean of 30 frames), and of a recording of the board that the rig was not made from (5 single frames). What is in DIR already is not
made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig, write_rig
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.pipeline.refine_clouds import refine_by_clouds

SPOILED_MM = 5.0
"""RMS displacement of points at 2 m."""
KINDS = {
    "calibrated": None,
    "6 sets": None,
    f"spoiled by {SPOILED_MM:g} mm, stated": SPOILED_MM,
    f"spoiled by {SPOILED_MM:g} mm, not stated": None,
}
"""And what is given as --pose-sd."""


def made(*words: object) -> None:
    """Run a command of rgbd-calib."""
    result = subprocess.run([sys.executable, "-m", "rgbd_calib", *map(str, words)], capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(map(str, words))}: {result.stderr[-500:]}")


def recordings(folder: Path, layout: str, seed: int, width: int) -> None:
    """The same rig and room three times: to calibrate well and by little, and empty."""
    common = "--layout", layout, "--seed", seed, "--width", width, "--height", width * 3 // 4, "--jobs", 1
    for name, own in (("full", ()), ("few", ("--frames", 6, "--intrinsic-views", 0)), ("empty", ("--snapshot",))):
        if not (folder / name).exists():
            made("simulate", folder / name, *common, *own)


def rigs(folder: Path, seed: int) -> list[Path]:
    """Rig files of each kind."""
    paths = [folder / f"{name}.yaml" for name in ("full", "few", "stated", "unstated")]
    full, few = folder / "full", folder / "few"
    if not paths[0].exists():
        sources = "--intrinsics", full / "intrinsic", "--depth-bias", full / "depth_bias"
        made("calibrate", full / "extrinsic", *sources, "-o", paths[0])
    if not paths[1].exists():
        made("calibrate", few / "extrinsic", "-o", paths[1])
    for k, path in enumerate(paths[2:]):
        if not path.exists():
            write_rig(path, spoiled(paths[0], np.random.default_rng([seed, k])))
    return paths


def spoiled(path: Path, rng: np.random.Generator) -> Any:
    """The rig with poses that move points at 2 m by `SPOILED_MM` (RMS), half of it by turning."""
    rig, sd_m = read_rig(path), SPOILED_MM / 1e3
    sd = np.repeat([sd_m / 4, sd_m / np.sqrt(6)], 3)
    cameras = {
        name: replace(own, T_world_color=se3.retract(own.T_world_color, sd * rng.standard_normal(6)))
        for name, own in rig.cameras.items()
        if name != rig.reference
    }
    return replace(rig, cameras=rig.cameras | cameras)


def refined(folder: Path, path: Path, clouds: Path, pose_sd_mm: float | None) -> dict[str, Any]:
    """Errors against the truth before and after, as stated, and why it was refused."""
    rig, truth = read_rig(path), folder / "full" / "truth.yaml"
    found = refine_by_clouds(rig, open_recording(clouds), None if pose_sd_mm is None else pose_sd_mm / 1e3)
    board = open_recording(folder / "full" / "extrinsic").board
    errors = [against_truth(r, read_rig(truth), read_boards(truth), board).summary().all for r in (rig, found.rig)]
    return {
        "true_mm": [e.mean_mm for e in errors],
        "stated_mm": [found.before.mean_mm, found.after.mean_mm],
        "surprise": found.surprise,
        "refused": found.refused,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each layout and kind."""
    lines = [
        "| rig | error before, mm: true, stated | with clouds, mm: true, stated | refused | written: better, worse |",
        "|---|---|---|---|---|",
    ]
    for key in sorted({tuple(row[k] for k in ("layout", "kind", "clouds")) for row in rows}):
        mine = [row for row in rows if tuple(row[k] for k in ("layout", "kind", "clouds")) == key]
        before, after = np.array([row["true_mm"] for row in mine]).T
        stated = np.mean([row["stated_mm"] for row in mine], axis=0)
        written = np.array([not row["refused"] for row in mine])
        better = int(np.sum(written & (after < before)))
        lines.append(
            f"| {', '.join(key)} | {before.mean():.2f}, {stated[0]:.2f} | {after.mean():.2f}, {stated[1]:.2f} | "
            f"{np.sum(~written)} of {len(mine)} | {better}, {written.sum() - better} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--width", type=int, default=640)
    args = parser.parse_args()
    rows = []
    for seed in range(args.first, args.first + args.seeds):
        for layout in ("arc", "ring"):
            folder = args.work / f"{layout}{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            recordings(folder, layout, seed, args.width)
            for (kind, pose_sd_mm), rig in zip(KINDS.items(), rigs(folder, seed), strict=True):
                other = folder / ("full" if kind == "6 sets" else "few") / "extrinsic"
                for what, clouds in (("empty room", folder / "empty" / "old"), ("room with a board", other)):
                    key = {"layout": layout, "seed": seed, "kind": kind, "clouds": what}
                    rows.append(key | refined(folder, rig, clouds, pose_sd_mm))
                    print(rows[-1], file=sys.stderr, flush=True)
    (args.work / "rows.json").write_text(json.dumps(rows, indent=1))
    print(table(rows))


if __name__ == "__main__":
    main()
