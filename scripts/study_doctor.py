"""Does `doctor` find each fault in turn, name the views that have it and no other, and say nothing of a good recording?

Copies of a simulated recording are spoiled one way each (a tenth of the views, or one camera); corners of the untouched
images are taken from a corners.csv, so that only the spoiled images are searched again.

    rgbd-calib simulate demo && rgbd-calib detect demo/extrinsic -o corners.csv
    python scripts/study_doctor.py demo corners.csv
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.correspondences import read_corners, write_corners
from rgbd_calib.io.recording import Recording, open_recording, save_color, save_depth, write_table
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.doctor import Examination, examine
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.simulation.spoil import spoil, true_corners
from rgbd_calib.types import BoardView
from rgbd_calib.views.detect import DetectParams, detect_view
from rgbd_calib.views.doctor import hull_mask

Key = tuple[str, str]
Views = dict[Key, BoardView]

EXPECTED = {
    "clutter": {"not the board"},
    "turned": {"not the board"},
    "hand": {"covered"},
    "blurred": {"blurred"},
    "late_depth": {"depth late", "covered", "no depth"},
    "moved": {"moved", "not the board"},
    "frames missing": {"missing"},
    "depth missing": {"missing"},
    "no depth on board": {"no depth"},
    "unsynchronised": {"unsynchronised"},
    "overexposed": {"overexposed"},
    "underexposed": {"underexposed"},
    "wrong size": {"damaged"},
    "damaged": {"damaged"},
    "not joined": {"not joined"},
    "one distance": {"coverage"},
}


def frames_missing(r: Recording, some: list[Key], views: Views) -> list[Key]:
    lost = [(c, f) for c, f in r_keys(r) if c == "C2"][::4]
    for c, f in lost:
        r.color_files[c][f].unlink()
        r.depth_files[c][f].unlink()
    return lost


def depth_missing(r: Recording, some: list[Key], views: Views) -> list[Key]:
    lost = [(c, f) for c, f in r_keys(r) if c == "C3"][::4]
    for c, f in lost:
        r.depth_files[c][f].unlink()
    return lost


def no_depth(r: Recording, some: list[Key], views: Views) -> list[Key]:
    for key in some:
        hull = hull_mask(r.depth_m(*key).shape, views[key].corners_px)
        change_depth(r, key, np.where(hull, 0.0, np.nan_to_num(r.depth_m(*key))))
    return some


def unsynchronised(r: Recording, some: list[Key], views: Views) -> list[Key]:
    rng = np.random.default_rng(1)
    late = {f for _, f in some}
    for c in r.cameras:
        rows = []
        for i, f in enumerate(r.color_files[c]):
            t = 1_000_000 * i + rng.integers(-8000, 8000) + (60_000 if c == "C4" and f in late else 0)
            rows.append((f, t, t + 5000))
        write_table(r.path / c / "timestamps.csv", ("frame", "color_us", "depth_us"), rows)
    return [("C4", f) for f in sorted(late)]


def exposed(gain: float) -> Callable[[Recording, list[Key], Views], list[Key]]:
    def change(r: Recording, some: list[Key], views: Views) -> list[Key]:
        for key in some:
            save_color(r.path, *key, np.clip(r.color(*key) * gain, 0, 255).astype(np.uint8))
        return some

    return change


def wrong_size(r: Recording, some: list[Key], views: Views) -> list[Key]:
    for key in some:
        save_color(r.path, *key, cv2.resize(r.color(*key), (320, 240)))
    return some


def damaged(r: Recording, some: list[Key], views: Views) -> list[Key]:
    for c, f in some:
        data = r.depth_files[c][f].read_bytes()
        r.depth_files[c][f].write_bytes(data[: len(data) // 2])
    return some


def not_joined(r: Recording, some: list[Key], views: Views) -> list[Key]:
    """C4 only keeps frames in which it alone sees the board; the others keep all."""
    for c, f in r_keys(r):
        if c == "C4" and (c, f) in views and any(v != "C4" and g == f for v, g in views):
            save_color(r.path, c, f, np.full_like(r.color(c, f), 90))
    return []


def one_distance(r: Recording, some: list[Key], views: Views) -> list[Key]:
    """C1 keeps only the views with squares of about one size."""
    side = {k: np.ptp(v.corners_px[:, 1]) for k, v in views.items() if k[0] == "C1"}
    middle = np.median(list(side.values()))
    far = [k for k, s in side.items() if abs(s / middle - 1) > 0.10]
    for key in far:
        save_color(r.path, *key, np.full_like(r.color(*key), 90))
    return []


CHANGES: dict[str, Callable[[Recording, list[Key], Views], list[Key]]] = {
    "frames missing": frames_missing,
    "depth missing": depth_missing,
    "no depth on board": no_depth,
    "unsynchronised": unsynchronised,
    "overexposed": exposed(3.0),
    "underexposed": exposed(0.1),
    "wrong size": wrong_size,
    "damaged": damaged,
    "not joined": not_joined,
    "one distance": one_distance,
}


def r_keys(r: Recording) -> list[Key]:
    return [(c, f) for c, files in r.color_files.items() for f in files]


def change_depth(r: Recording, key: Key, depth_m: np.ndarray) -> None:
    save_depth(r.path, *key, np.round(depth_m / r.cameras[key[0]].depth_scale).astype(np.uint16))


def search_again(source: Recording, r: Recording, views: Views, out: Path) -> None:
    """corners.csv of the spoiled copy."""
    kept = []
    for key in r_keys(r):
        same = r.color_files[key[0]][key[1]].read_bytes() == source.color_files[key[0]][key[1]].read_bytes()
        depths = [x.depth_files[key[0]].get(key[1]) for x in (source, r)]
        same &= (depths[0] and depths[0].read_bytes()) == (depths[1] and depths[1].read_bytes())
        if same:
            kept += [views[key]] if key in views else []
            continue
        try:
            depth = r.depth_m(*key) if r.has_depth(*key) else None
            view = detect_view(*key, r.color(*key), depth, r.board, DetectParams())
        except ConfigError:  # damaged: doctor will say so
            view = None
        kept += [] if view is None else [view]
    write_corners(out, kept)


def row(name: str, spoiled: list[Key], result: Examination) -> str:
    right = [f for f in result.findings if f.kind in EXPECTED.get(name, set())]
    named = {(c, f) for x in right for c in x.cameras for f in x.frames}
    anywhere = {(c, f) for x in result.findings if x.matters for c in x.cameras for f in x.frames}
    found = f"{len(named & set(spoiled))} of {len(spoiled)}" if spoiled else ("yes" if right else "no")
    any_ = f"{len(anywhere & set(spoiled))} of {len(spoiled)}" if spoiled else "-"
    false = len(anywhere - set(spoiled))
    text = max((x.sentence for x in right), key=len, default="(silent)" if not result.findings else "")
    return f"| {name} | {found} | {any_} | {false} | {int(not result.healthy)} | {text[:150]} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path)
    parser.add_argument("corners", type=Path)
    parser.add_argument("--share", type=float, default=0.1)
    parser.add_argument("--only", nargs="+", help="some of the faults")
    given = parser.parse_args()
    source = open_recording(given.demo / "extrinsic")
    views = {(v.camera, v.frame): v for v in read_corners(given.corners)}
    true = {k: px for k, px in true_corners(given.demo / "true_corners.csv").items() if k in views}
    print(
        "| fault | found as such | named at all | others named | exit | sentence |\n|---|---|---|---|---|---|",
        flush=True,
    )
    if not given.only:
        print(row("none", [], examine(source, Config(), corners=given.corners, workers=Workers(1))), flush=True)
    for name in given.only or EXPECTED:
        with tempfile.TemporaryDirectory() as folder:
            out, rng = Path(folder) / "spoiled", np.random.default_rng(3)
            if name in CHANGES:
                shutil.copytree(source.path, out)
                keys = sorted(views)
                some = [keys[i] for i in rng.choice(len(keys), max(1, round(given.share * len(keys))), replace=False)]
                spoiled = CHANGES[name](open_recording(out), some, views)
            else:
                spoiled = list(spoil(source.path, out, name, true, given.share, rng))
            search_again(source, open_recording(out), views, Path(folder) / "corners.csv")
            result = examine(open_recording(out), Config(), corners=Path(folder) / "corners.csv", workers=Workers(1))
            print(row(name, spoiled, result), flush=True)


if __name__ == "__main__":
    main()
