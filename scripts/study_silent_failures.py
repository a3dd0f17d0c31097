"""Is a spoiled recording ever calibrated wrongly without a word? Each way to spoil one in turn, against the truth.

    python scripts/study_silent_failures.py [--json] [--seeds 3] [--only PATTERN]
    python scripts/study_silent_failures.py --false-alarms 100

A row is right where both errors, two cameras' places of one point against each other and against the truth, are within
three times the expected error that the result states, or within 1.5 times those of the same session unspoiled (and half a
millimetre, below which the studies' own draw decides); else it must have ended in an error, or in a verdict that
says not to trust it or by how much the stated error is too small. What is left is SILENT.
"""

from __future__ import annotations

import json
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from rgbd_calib.cameras.depth_bias import fit_with_data
from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.geometry import align, se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import write_depth_bias, write_intrinsics
from rgbd_calib.pipeline.calibrate import Calibration, calibrate
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import detections_from, silent
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.simulation.faults import FAULTS, RINGS
from rgbd_calib.simulation.session import Session, draw_scene, film, write_session
from rgbd_calib.trust import uncertainty
from rgbd_calib.trust.self_check import SelfCheckParams
from rgbd_calib.trust.verdict import judge
from rgbd_calib.types import Rig
from rgbd_calib.views.detect import DetectParams

CLEAN_FACTOR, STATED_FACTOR, FLOOR_MM = 1.5, 3.0, 0.5


@dataclass(frozen=True)
class Row:
    """What came of one spoiled session."""

    fault: str
    seed: int
    alignment_mm: float | None
    """Two cameras' places of one point, mean over the volume where the board was."""
    place_mm: float | None
    """Cameras' places of points against the truth, the world laid on the true one: what distances are off by."""
    stated_mm: float | None
    """Expected distance of two cameras' places of one point."""
    scale_mm: float
    """One sigma of distances as such, from the board's size by the depth, at the usual distance."""
    level: str
    says: str
    seconds: float

    def judged(self, clean: Row) -> str:
        """right, clear error, warned or SILENT."""
        if self.level == "error":
            return "clear error"
        assert self.alignment_mm is not None and self.place_mm is not None
        assert clean.alignment_mm is not None and clean.place_mm is not None
        errors, usual = (self.alignment_mm, self.place_mm), (clean.alignment_mm, clean.place_mm)
        stated = self.stated_mm or 0.0
        allowed = STATED_FACTOR * stated, STATED_FACTOR * float(np.hypot(stated, self.scale_mm))
        as_good = all(e <= max(CLEAN_FACTOR * u, FLOOR_MM) for e, u in zip(errors, usual, strict=True))
        as_stated = all(e <= max(a, FLOOR_MM) for e, a in zip(errors, allowed, strict=True))
        if self.level in ("untrusted", "poor") or "Self-check (" in self.says:
            return "right, warned" if as_good else "warned"
        return "right" if as_good or as_stated else "SILENT"


def try_fault(fault: str, seed: int, cameras: int = 3, frames: int = 24, close: int = 14) -> Row:
    """Spoil a drawn session in one way, and calibrate it."""
    layout, n = ("ring", max(cameras, 4)) if fault in RINGS else ("arc", cameras)
    rng = np.random.default_rng([seed, zlib.crc32(fault.encode())])
    scene = draw_scene(n, layout, frames, close, np.random.default_rng(seed))  # type: ignore[arg-type]
    session = FAULTS[fault](scene, rng)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            result = calibrate_session(session, Path(folder))
        except RgbdCalibError as error:
            said = str(error).replace(folder, "DIR")
            return Row(fault, seed, None, None, None, 0.0, "error", said, time.perf_counter() - start)
    seconds = time.perf_counter() - start
    quality = result.rig.quality
    verdict = judge(quality, ())
    rig = with_true_depth(result.rig, session)
    scale = quality["self_check"].get("scale", {})
    return Row(
        fault,
        seed,
        1e3 * float(against_truth(rig, session.truth, session.boards, session.board).distance_m.mean()),
        place_error_mm(rig, session),
        quality.get("expected_alignment", {}).get("mean_mm"),
        10 * scale.get("sd_percent", 0.0) * scale.get("distance_m", 0.0),
        verdict.level,
        " | ".join([verdict.headline, *verdict.reasons]),
        seconds,
    )


def calibrate_session(session: Session, folder: Path) -> Calibration:
    """The whole calibration of a session, from its corners."""
    write_session(session, folder)
    for dataset in folder.glob("*/dataset.yaml"):  # as written by hand: the program itself refuses to write such sizes
        if session.board.square_m > 1:
            dataset.write_text(dataset.read_text().replace("square: 1.0", f"square: {session.board.square_m}"))
    recording = open_recording(folder / "extrinsic")
    found = detections_from(recording, folder / "extrinsic.csv", DetectParams(), None, silent)
    lenses, bias, close = None, None, None
    if session.lenses:
        lenses = folder / "intrinsics.yaml"
        write_intrinsics(lenses, session.lenses, {}, {}, {})
    elif session.close is not None:
        lenses = folder / "intrinsic"
        close = detections_from(open_recording(lenses), folder / "intrinsic.csv", DetectParams(), None, silent)
    if session.walls is not None:
        bias = folder / "depth_bias.yaml"
        fits = {
            c: fit_with_data(rows[:, 0], rows[:, 1], camera=c, sigma_m=rows[:, 2]) for c, rows in session.walls.items()
        }
        write_depth_bias(bias, {c: fit.bias for c, fit in fits.items()}, {}, {}, {})
    return calibrate(
        recording, Config(), intrinsics=lenses, depth_bias=bias, detections=found, intrinsic_detections=close
    )


def with_true_depth(rig: Rig, session: Session) -> Rig:
    """Cameras that had no depth are judged by their pose and lens alone."""
    blind = {c for c in rig.cameras if not any(np.isfinite(v.depth_m).any() for v in session.views if v.camera == c)}
    cameras = {
        c: replace(own, depth_bias=session.truth.cameras[c].depth_bias) if c in blind else own
        for c, own in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def place_error_mm(rig: Rig, session: Session) -> float:
    """Mean distance of where each camera puts points of the boards' box from where they are.

    The world is laid on the true one: where the reference camera's axis is within it is nobody's concern.
    """
    truth = session.truth
    corners = np.concatenate([se3.transform(T, session.board.corners_m()) for T in session.boards.values()])
    points = uncertainty.volume(corners, 8)
    places, true = [], []
    for name in rig.cameras:
        seen = uncertainty.observe(truth, name, points)
        at = uncertainty.place(rig, name, seen)
        kept = seen.seen & np.isfinite(at).all(axis=1)
        places.append(at[kept])
        true.append(points[kept])
    put, meant = np.concatenate(places), np.concatenate(true)
    return 1e3 * float(np.linalg.norm(se3.transform(align.rigid(meant, put), put) - meant, axis=1).mean())


def rows_of(faults: list[str], seeds: int) -> Iterator[tuple[Row, str]]:
    """Every fault with every seed, and what it is judged to be."""
    clean: dict[tuple[bool, int], Row] = {}
    for fault in faults:
        for seed in range(seeds):
            ring = fault in RINGS
            if (ring, seed) not in clean:
                if ring:
                    FAULTS["nothing, in a ring"] = FAULTS["nothing"]
                    RINGS.add("nothing, in a ring")
                clean[ring, seed] = try_fault("nothing, in a ring" if ring else "nothing", seed)
            row = clean[ring, seed] if fault == "nothing" else try_fault(fault, seed)
            yield row, row.judged(clean[ring, seed])


def false_alarms(sessions: int) -> list[dict[str, Any]]:
    """What is said of sessions in which nothing is wrong: arcs and rings of two to five cameras, with and without walls."""
    rows = []
    for seed in range(sessions):
        rng = np.random.default_rng([seed, 7])
        n, ring = int(rng.integers(2, 6)), seed % 3 == 2
        n = max(n, 4) if ring else n
        session = film(draw_scene(n, "ring" if ring else "arc", int(rng.integers(16, 40)), 14, rng), rng)
        if seed % 4 == 3:
            session = replace(session, walls=None)
        with tempfile.TemporaryDirectory() as folder:
            quality = calibrate_session(session, Path(folder)).rig.quality
        own = quality["self_check"]
        rows.append(
            {
                "seed": seed,
                "cameras": n,
                "trusted": own["trusted"],
                "said": [f["text"] for f in own["findings"]],
                "smallest_p": min(t["p"] for t in own["tests"]),
                "tested": own["tested"],
            }
        )
        click.echo(json.dumps(rows[-1]), err=True)
    return rows


@click.command()
@click.option("--false-alarms", "clean", type=int, help="Try this many unspoiled sessions instead.")
@click.option("--seeds", default=1, show_default=True)
@click.option("--only", default="", help="Faults whose name contains this.")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(clean: int | None, seeds: int, only: str, as_json: bool) -> None:
    if clean:
        found = false_alarms(clean)
        if as_json:
            click.echo(json.dumps(found, indent=1))
            return
        said, untrusted = sum(bool(r["said"]) for r in found), sum(not r["trusted"] for r in found)
        below = sum(r["smallest_p"] < SelfCheckParams().significance / r["tested"] for r in found)
        click.echo(
            f"{len(found)} unspoiled sessions, {sum(r['tested'] for r in found)} tests: {untrusted} not trusted, {said} with a "
            f"sentence; in {below} a test was significant, its effect too small to matter"
        )
        return
    rows = []
    for row, judged in rows_of([f for f in FAULTS if only in f], seeds):
        rows.append({**asdict(row), "judged": judged})
        errors = "" if row.alignment_mm is None else f"{row.alignment_mm:.2f} / {row.place_mm:.2f}"
        click.echo(
            f"{judged:14s} {row.fault}: {errors} stated {row.stated_mm} {row.level}: {row.says[:700]} ({row.seconds:.1f} s)",
            err=True,
        )
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo("| what was spoiled | alignment / place error, mm | stated, mm | judged | what is said |")
    click.echo("|---|---|---|---|---|")
    for r in rows:
        errors = "" if r["alignment_mm"] is None else f"{r['alignment_mm']:.2f} / {r['place_mm']:.2f}"
        click.echo(f"| {r['fault']} | {errors} | {r['stated_mm'] or ''} | {r['judged']} | {r['says'][:160]} |")


if __name__ == "__main__":
    main()
