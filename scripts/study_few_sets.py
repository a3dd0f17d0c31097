"""How many frame sets a rig needs without any other recording: true and stated error against their number, over drawn rigs."""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from study_silent_failures import calibrate_session

from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.session import draw_scene, film
from rgbd_calib.trust.verdict import judge


def errors_mm(sets: int, cameras: int, seed: int) -> tuple[float, float, str]:
    """True and stated mean alignment over the boards' volume, and the verdict, of one rig's recording alone."""
    scene = draw_scene(cameras, "arc", sets, 1, np.random.default_rng([seed, 0]), realism=Realism())
    session = replace(film(scene, np.random.default_rng([seed, 1])), close=None, walls=None, wall_cells=None)
    with tempfile.TemporaryDirectory() as folder:
        rig = calibrate_session(session, Path(folder)).rig
    true_m = against_truth(rig, session.truth, session.boards, session.board).distance_m.mean()
    stated_mm = rig.quality.expected_mm
    assert stated_mm is not None  # all cameras have depth
    return 1e3 * float(true_m), stated_mm, judge(rig.quality, ()).level


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, nargs="+", default=[5, 8, 12, 20, 40])
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=8)
    args = parser.parse_args()
    print("| sets | true, mm: mean (worst) | stated, mm | stated / true: least to most | verdicts |")
    print("|---|---|---|---|---|")
    for sets in args.sets:
        found, refused = [], 0
        for seed in range(args.seeds):
            try:
                found.append(errors_mm(sets, args.cameras, seed))
            except RgbdCalibError:
                refused += 1
        true, stated = (np.array([own[i] for own in found], float) for i in (0, 1))
        levels = [own[2] for own in found] + ["refused"] * refused
        told = ", ".join(f"{levels.count(level)} {level}" for level in dict.fromkeys(levels))
        ratio = stated / true
        print(
            f"| {sets} | {true.mean():.1f} ({true.max():.1f}) | {stated.mean():.1f} | "
            f"{np.sqrt(np.mean(stated**2) / np.mean(true**2)):.2f}: {ratio.min():.2f} to {ratio.max():.2f} | {told} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
