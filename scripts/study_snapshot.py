"""How well snapshots of the empty scene tell which camera moved: the table of docs/guides/drift.md.

    python scripts/study_snapshot.py --scenes 20 --width 320 --jobs 2

Each scene is a rig of its own with 4 cameras in the furnished room, and is changed in several ways. The rig that is used is the true
one with the errors that a calibration leaves.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from multiprocessing import get_context
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.depth_error import GridField
from rgbd_calib.io.snapshot import averaged
from rgbd_calib.simulation.changes import SceneChange, scenes
from rgbd_calib.simulation.depth_field import structured_light
from rgbd_calib.simulation.params import SimulationParams, generator
from rgbd_calib.simulation.recording import true_rig_of
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.snapshot import IdealSnapshot, changed_share, look, take
from rgbd_calib.trust.displacement import VerdictParams
from rgbd_calib.trust.snapshot import Before, RigVerdict, SnapshotParams, camera_motion, judge_motions
from rgbd_calib.trust.snapshot.determined import working_points
from rgbd_calib.types import CameraSnapshot, Rig, RigCamera

STUDY = 77
"""Of the keys of the random generators."""
ALLOWED_M = 0.003
QUIET_ROUNDS = 5
"""New snapshots of the unchanged scene for each rig."""


@dataclass(frozen=True)
class Setup:
    width: int
    frames: int
    sensor: str
    layout: str


def as_calibrated(rig: Rig, params: SimulationParams, rng: np.random.Generator) -> Rig:
    """The rig with the errors that a calibration leaves: 0.03 % in the focal length, 0.3 px in the centre, 0.1 % in the depth's
    scale, 0.6 mm in its field (docs/accuracy.md)."""
    out: dict[str, RigCamera] = {}
    for name, own in rig.cameras.items():
        lens = own.intrinsics
        grown = 1 + rng.normal(0, 3e-4, 2)
        moved = rng.normal(0, 0.3, 2) * params.width / 640
        lens = replace(lens, fx=lens.fx * grown[0], fy=lens.fy * grown[1], cx=lens.cx + moved[0], cy=lens.cy + moved[1])
        assert own.depth_bias is not None
        c = np.array([*own.depth_bias.coefficients, 0.0, 0.0])
        c[1] += rng.normal(0, 1e-3)
        bias, field = replace(own.depth_bias, coefficients=tuple(c.tolist())), own.depth_field
        if isinstance(field, GridField):
            left = structured_light(params.width, params.height, 0.0006, rng).grid
            if left.error.shape == field.error.shape:
                field = replace(field, error=field.error + left.error)
        out[name] = replace(own, intrinsics=lens, depth_bias=bias, depth_field=field)
    return replace(rig, cameras=out)


def draw_twist(rng: np.random.Generator, most_m: float = 0.030, most_rad: float = float(np.radians(2.0))) -> np.ndarray:
    """A motion (6,) of up to this length and angle, in any direction."""
    turn, shift = rng.standard_normal(3), rng.standard_normal(3)
    turn *= rng.uniform(0, most_rad) / np.linalg.norm(turn)
    shift *= rng.uniform(0, most_m) / np.linalg.norm(shift)
    return np.concatenate([turn, shift])


def small_twist(rng: np.random.Generator) -> np.ndarray:
    """5 mm or 0.2 degrees, in any direction."""
    way = rng.standard_normal(3)
    way /= np.linalg.norm(way)
    return np.concatenate([np.zeros(3), 0.005 * way] if rng.random() < 0.5 else [np.radians(0.2) * way, np.zeros(3)])


def rms(displacements_m: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(displacements_m**2, axis=1))))


class SceneStudy:
    """One rig in one room."""

    def __init__(self, setup: Setup, seed: int) -> None:
        self.params = SimulationParams(
            layout=setup.layout, width=setup.width, height=setup.width * 3 // 4, seed=seed, sensor=setup.sensor
        )  # type: ignore[arg-type]
        if setup.sensor == "tof":
            from rgbd_calib.simulation.time_of_flight import TimeOfFlight

            self.params = replace(self.params, depth_noise=TimeOfFlight())
        self.setup, self.rng = setup, generator(seed, STUDY)
        self.truth: TrueRig = true_rig_of(self.params)
        true = Rig(self.truth.cameras[0], self.truth.rig_cameras)
        self.rig = as_calibrated(true, self.params, self.rng)
        self.seconds: list[float] = []

    @cached_property
    def room(self) -> Caster:
        return Caster(scenes(SceneChange(), self.rng)[0])

    @cached_property
    def sights(self) -> dict[str, IdealSnapshot]:
        return {c: self.look(c, self.room) for c in self.truth.cameras}

    @cached_property
    def before(self) -> dict[str, Before]:
        return {c: Before(self.rig.cameras[c], self.take(c, self.sights[c])) for c in self.truth.cameras}

    def look(self, camera: str, caster: Caster, T_old_new: np.ndarray | None = None) -> IdealSnapshot:
        T = self.truth.T_room_color[camera]
        return look(self.truth, self.params, camera, T if T_old_new is None else T @ T_old_new, caster, self.rng)

    def take(self, camera: str, sight: IdealSnapshot, change: SceneChange | None = None) -> CameraSnapshot:
        taken = take(sight, self.truth, self.params, camera, self.setup.frames, self.rng, change)
        stack = np.where(taken.depth_raw > 0, taken.depth_raw / 1000, np.nan).astype(np.float32)
        return CameraSnapshot(camera, taken.color, averaged(stack), self.setup.frames)

    def compare(
        self, what: str, change: SceneChange, sights: dict[str, IdealSnapshot], before: dict[str, Before] | None = None
    ) -> dict[str, Any]:
        """One round of `verify --snapshot`, against the truth."""
        begin = process_time()
        found = {c: camera_motion(c, (before or self.before)[c], self.take(c, s, change)) for c, s in sights.items()}
        rig = replace(self.rig, cameras={c: self.rig.cameras[c] for c in sights})
        verdict = judge_motions(rig, found, SnapshotParams(pairs=VerdictParams(max_m=ALLOWED_M)))
        self.seconds.append(process_time() - begin)
        return self._row(what, change, verdict)

    def _row(self, what: str, change: SceneChange, verdict: RigVerdict) -> dict[str, Any]:
        cameras = {}
        for c, own in verdict.cameras.items():
            T_true, estimate = change.T_old_new(c), own.motion.motion
            e = se3.difference(T_true, estimate.T_old_new)
            points = working_points(self.rig.cameras[c].intrinsics, verdict.params.distance_m)
            apart = se3.transform(T_true, points) - se3.transform(estimate.T_old_new, points)
            cameras[c] = {
                "true_mm": 1e3 * rms(se3.transform(T_true, points) - points),
                "error_mm": 1e3 * rms(apart),
                "turn_error_deg": float(np.degrees(so3.angle_rad(T_true[:3, :3].T @ estimate.T_old_new[:3, :3]))),
                "nees": float(e @ np.linalg.solve(estimate.covariance, e)) / 6,
                "sd_mm": 1e3 * own.displacement_sd_m,
                "unchanged": own.motion.unchanged_share,
                "drift": estimate.drift.tolist(),
            }
        return {
            "what": what,
            "seed": self.params.seed,
            "truly_moved": sorted(change.twists),
            "moved": sorted(verdict.moved),
            "whole_rig": verdict.T_world_moved is not None,
            "refused": verdict.undetermined,
            "cameras": cameras,
        }

    def rounds(self, only: str) -> list[dict[str, Any]]:
        """Those whose name this regular expression finds; others draw no random numbers."""
        warm = SceneChange(depth_scale=0.003, depth_offset_m=0.003)
        every: list[tuple[str, Callable[[str], dict[str, Any]]]] = [
            *[("nothing", lambda what: self.compare(what, SceneChange(), self.sights))] * QUIET_ROUNDS,
            ("warm-up", lambda what: self.compare(what, warm, self.sights)),
            ("moved", lambda what: self._moved(what, SceneChange({self._any(): draw_twist(self.rng)}))),
            (
                "moved by 5 mm or 0.2 deg",
                lambda what: self._moved(what, SceneChange({self._any(): small_twist(self.rng)})),
            ),
            (
                "moved, warm-up",
                lambda what: self._moved(what, replace(warm, twists={self._any(): draw_twist(self.rng)})),
            ),
            ("whole rig", self._shifted),
            ("changed, dim, moved", self._changed),
            ("wall", self._flat),
            ("floor", self._flat),
        ]
        return [make(what) for what, make in every if re.search(only, what)]

    def _any(self) -> str:
        return str(self.rng.choice(self.truth.cameras))

    def _moved(self, what: str, change: SceneChange) -> dict[str, Any]:
        moved = {c: self.look(c, self.room, change.T_old_new(c)) for c in change.twists}
        return self.compare(what, change, self.sights | moved)

    def _shifted(self, what: str) -> dict[str, Any]:
        """All cameras by the same motion in the room, 10 mm and 0.5 degrees."""
        D = se3.retract(np.eye(4), draw_twist(self.rng, 0.010, np.radians(0.5)))
        twists = {}
        for c in self.truth.cameras:
            T = self.truth.T_room_color[c]
            twists[c] = se3.difference(se3.inverse(T) @ D @ T, np.eye(4))
        return self._moved(what, SceneChange(twists))

    def _changed(self, what: str) -> dict[str, Any]:
        """About 40 % of the scene changed, light halved, one camera moved."""
        change = SceneChange({self._any(): draw_twist(self.rng)}, objects=6, people=4, light=0.5)
        old, new = scenes(change, self.rng)
        caster = Caster(new)
        sights = {c: self.look(c, caster, change.T_old_new(c)) for c in self.truth.cameras}
        row = self.compare(what, change, sights)
        shares = {c: changed_share(self.truth, c, {"old": old, "new": new}) for c in self.truth.cameras}
        return row | {"changed": shares}

    def _flat(self, flat: str) -> dict[str, Any]:
        """One camera before a wall, or above a floor, moved."""
        camera = self._any()
        change = SceneChange({camera: draw_twist(self.rng)}, surroundings=flat)  # type: ignore[arg-type]
        caster = Caster(scenes(change, self.rng)[0])
        first = Before(self.rig.cameras[camera], self.take(camera, self.look(camera, caster)))
        return self.compare(
            flat, change, {camera: self.look(camera, caster, change.T_old_new(camera))}, {camera: first}
        )


def study(seed: int, setup: Setup, only: str) -> tuple[list[dict[str, Any]], list[float]]:
    one = SceneStudy(setup, seed)
    return one.rounds(only), one.seconds


def _displaced(row: dict[str, Any]) -> list[str]:
    """The cameras that moved by more than is allowed."""
    return [c for c in row["truly_moved"] if row["cameras"][c]["true_mm"] > 1e3 * ALLOWED_M]


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each kind of change."""
    lines = [
        "| change | rounds | refused | error at 2 m, mm: median, worst | turn, deg: median, worst | NEES | right verdict | unchanged |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for what in dict.fromkeys(row["what"] for row in rows):
        mine = [row for row in rows if row["what"] == what]
        cameras = [c for row in mine for c in row["cameras"].values()]
        refused = sum(bool(row["refused"]) for row in mine)
        judged = [row for row in mine if not row["refused"]]
        expected = [[] if row["what"] == "whole rig" else _displaced(row) for row in judged]
        right = sum(row["moved"] == want for row, want in zip(judged, expected, strict=True))
        cells = ["-", "-", "-", "-"]
        if cameras:
            e, t, n, u = (
                np.array([c[k] for c in cameras]) for k in ("error_mm", "turn_error_deg", "nees", "unchanged")
            )
            cells = [
                f"{np.median(e):.2f}, {e.max():.2f}", f"{np.median(t):.4f}, {t.max():.4f}", f"{n.mean():.2f} ({np.median(n):.2f})",
                f"{100 * np.median(u):.0f} %",
            ]  # fmt: skip
        lines.append(
            f"| {what} | {len(mine)} | {refused} | {cells[0]} | {cells[1]} | {cells[2]} | {right} of {len(judged)} | {cells[3]} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--sensor", default="structured-light")
    parser.add_argument("--layout", default="arc")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="changes whose name matches this regular expression")
    parser.add_argument("--out", type=Path, help="write all rows as JSON")
    args = parser.parse_args()
    setup = Setup(args.width, args.frames, args.sensor, args.layout)
    seeds = range(args.first, args.first + args.scenes)
    rows, seconds = [], []
    with get_context("spawn").Pool(args.jobs) as pool:
        for found, took in pool.imap(partial(study, setup=setup, only=args.only), seeds):
            rows += found
            seconds += took
            if args.out:  # after each scene: a study takes long
                args.out.write_text(json.dumps(rows, indent=1))
    print(table(rows))
    print(f"\nmedian CPU time of a comparison of 4 cameras, averaging of depth included: {np.median(seconds):.1f} s")


if __name__ == "__main__":
    main()
