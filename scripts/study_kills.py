"""Kill `calibrate`, `correct` and `detect` at random moments: is the output whole, and does the next run give the same?"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
from fuzz_parsers import scratch

SIGNALS = (signal.SIGKILL,) * 6 + (signal.SIGTERM,) * 2 + (signal.SIGINT,) * 2
KEPT_CACHE = 5
"""Kills after which the cache of detections is emptied, so that there is something to detect again."""


@dataclass
class Study:
    """One command, what it replaces, and what it makes when it is left alone."""

    name: str
    args: list[str]
    old: dict[str, bytes]
    new: dict[str, bytes]
    seconds: float
    writing_s: float
    """From the first temporary file in the folder to the end."""
    counts: Counter[str] = field(default_factory=Counter)


@click.command()
@click.argument("recording", type=click.Path(exists=True, path_type=Path))
@click.option(
    "--kills",
    default=200,
    show_default=True,
    help="0.3 of calibrate, 0.3 of correct, 0.3 of detect, 0.1 of detect by two.",
)
@click.option("--frames", default=10, show_default=True, help="Of the recording that are used.")
@click.option("--seed", default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def main(recording: Path, kills: int, frames: int, seed: int, as_json: bool) -> None:
    """Kill the commands on RECORDING, of a board, and print how often each outcome was seen; the last two must be 0.

    `detect` runs in one process, and now and then in two. `correct` replaces a folder, in which somebody else's file lies.
    """
    folder = scratch()
    small, out = _small_copy(recording, folder / "recording", frames), folder / "out"
    os.environ["RGBD_CALIB_CACHE"] = str(folder / "cache")
    _import_all()
    corners, table = folder / "corners.csv", out / "corners.csv"
    _end(_start(["detect", str(small), "-o", str(corners)]))
    calibrate = ["calibrate", str(small), "--corners", str(corners), "-o", str(out / "rig.yaml"), "--overwrite"]
    detect = ["detect", str(small), "-o", str(table), "--overwrite", "--jobs"]
    rig = folder / "rig.yaml"
    _end(_start(["calibrate", str(small), "--corners", str(corners), "-o", str(rig)]))
    correct = ["correct", str(small), "--rig", str(rig), "-o", str(out / "corrected"), "--overwrite"]
    shutil.rmtree(folder / "cache")
    studies = [
        _study("calibrate", out, calibrate, {}, [*calibrate, "--method", "ba"]),
        _study("correct", out, [*correct, "--undistort"], {}, correct, {"corrected/own/notes.txt": b"somebody's"}),
    ]
    for jobs in ("1", "2"):
        studies.append(_study(f"detect by {jobs}", out, [*detect, jobs], {"corners.csv": b"camera,frame\n"}, None))
        shutil.rmtree(folder / "cache")
    rng = random.Random(seed)
    for study, share in zip(studies, (0.3, 0.3, 0.3, 0.1), strict=True):
        while (i := study.counts["kills"]) < round(share * kills):
            if i % KEPT_CACHE == 0:
                shutil.rmtree(folder / "cache", ignore_errors=True)
            _one(study, out, rng, aimed=i % 2 == 1)
    rows = [
        {"command": s.name, "seconds": f"{s.seconds:.2f}", "writing, s": f"{s.writing_s:.3f}"}
        | {k: s.counts[k] for k in KEYS}
        for s in studies
    ]
    shutil.rmtree(folder)
    click.echo(json.dumps(rows, indent=1) if as_json else _table(rows))
    sys.exit(any(row[key] for row in rows for key in KEYS[-2:]))


KEYS = ("too late", "kills", "old", "new", "parted pair, refused", "leftovers", "broken", "rerun differs")
"""Too late: the command had ended; not counted as a kill. Parted pair: the rig of one run beside the residuals of another, which the reader refuses. Leftovers: hidden files."""


def _one(study: Study, out: Path, rng: random.Random, aimed: bool) -> None:
    """Put the old result there, run, kill, look, and run again."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    _fill(out, study.old)
    number, counts = rng.choice(SIGNALS), study.counts
    pid = _start(study.args)
    if aimed:
        _await_writing(pid, out)
        time.sleep(rng.uniform(0, study.writing_s))
    else:
        time.sleep(rng.uniform(0, study.seconds))
    if _kill(pid, number):
        counts["too late"] += 1
        return
    counts["kills"] += 1
    seen = _content(out)
    hidden = [p for p in out.iterdir() if p.name.startswith(".")]
    counts["leftovers"] += bool(hidden)
    if seen == study.new:
        counts["new"] += 1
    elif seen == study.old:
        counts["old"] += 1
    elif _is_parted(study, seen) and _is_refused(out / "rig.yaml"):
        counts["parted pair, refused"] += 1
    else:
        counts["broken"] += 1
    if hidden and number != signal.SIGKILL:
        counts["broken"] += 1
    _end(_start(study.args))
    counts["rerun differs"] += any(p.name.startswith(".") for p in out.iterdir()) or _content(out) != study.new


def _content(folder: Path) -> dict[str, bytes]:
    """Files by relative path, without what is hidden at the top."""
    files = (p for p in folder.rglob("*") if p.is_file())
    named = {p.relative_to(folder).as_posix(): p for p in files}
    return {name: path.read_bytes() for name, path in named.items() if not name.startswith(".")}


def _fill(folder: Path, content: dict[str, bytes]) -> None:
    for name, data in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def _await_writing(pid: int, out: Path) -> None:
    while not any(".partial-" in name for name in os.listdir(out)) and not _ended(pid):
        time.sleep(0.0002)


def _is_parted(study: Study, seen: dict[str, bytes]) -> bool:
    return seen.keys() == study.new.keys() and all(seen[k] in (study.old[k], study.new[k]) for k in seen)


def _is_refused(rig: Path) -> bool:
    from rgbd_calib.errors import ConfigError
    from rgbd_calib.io.residuals import read_residuals_of
    from rgbd_calib.io.rig import read_rig

    try:
        read_residuals_of(rig, read_rig(rig))
    except ConfigError as error:
        return "different calibrations" in str(error)
    return False


def _study(
    name: str,
    out: Path,
    args: list[str],
    old: dict[str, bytes],
    makes_old: list[str] | None,
    foreign: dict[str, bytes] | None = None,
) -> Study:
    """`makes_old` is the command whose result stands there before; `foreign` is in it, and must stay."""

    def run(command: list[str], before: dict[str, bytes]) -> tuple[dict[str, bytes], float, float]:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        _fill(out, before)
        start = time.monotonic()
        pid = _start(command)
        _await_writing(pid, out)
        writing = time.monotonic()
        status = _end(pid)
        if status != 0:
            raise SystemExit(f"{' '.join(command)}: exit status {status}")
        end = time.monotonic()
        return _content(out), end - start, end - writing

    if makes_old is not None:
        old, _, _ = run(makes_old, {})
    old = old | (foreign or {})
    new, seconds, writing_s = run(args, old)
    return Study(name, args, old, new, seconds, writing_s)


def _start(args: list[str]) -> int:
    """Fork a process that runs the command: the modules are there already."""
    pid = os.fork()
    if pid:
        return pid
    os.setpgid(0, 0)
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    from rgbd_calib.cli.main import main as entry

    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["rgbd-calib", *args]
    try:
        entry()
    except SystemExit as stop:
        os._exit(stop.code if isinstance(stop.code, int) else 1)
    finally:
        os._exit(70)
    return 0


def _end(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _ended(pid: int) -> bool:
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _kill(pid: int, number: int) -> bool:
    """Kill it with all its processes, as a terminal or a scheduler does; True where it had ended."""
    ended = _ended(pid)
    if not ended:
        try:
            os.killpg(pid, number)
        except ProcessLookupError:  # so early that it has no group of its own yet
            os.kill(pid, number)
    _end(pid)
    return ended


def _small_copy(recording: Path, folder: Path, frames: int) -> Path:
    """The first frames of a recording, their images as links."""
    from rgbd_calib.io.recording import open_recording

    opened = open_recording(recording)
    for files in (opened.color_files, opened.depth_files):
        for of_camera in files.values():
            for frame in opened.frames[:frames]:
                if frame in of_camera:
                    link = folder / of_camera[frame].relative_to(recording)
                    link.parent.mkdir(parents=True, exist_ok=True)
                    link.symlink_to(of_camera[frame].absolute())
    shutil.copy(recording / "dataset.yaml", folder / "dataset.yaml")
    return folder


def _import_all() -> None:
    """What the commands import late: 3 s, once instead of 400 times."""
    import importlib

    import cv2

    cv2.setNumThreads(1)  # a pool of threads does not survive a fork
    for name in (
        "pipeline.calibrate",
        "pipeline.config",
        "pipeline.detection",
        "pipeline.world",
        "io.residuals",
        "cli.calibrate",
        "cli.correct",
        "cli.detect",
        "pipeline.correct",
    ):
        importlib.import_module(f"rgbd_calib.{name}")


def _table(rows: list[dict[str, Any]]) -> str:
    lines = [f"{'':24}" + "".join(f"{row['command']:>12}" for row in rows)]
    return "\n".join(
        lines + [f"{key:24}" + "".join(f"{row[key]:>12}" for row in rows) for key in ("seconds", "writing, s", *KEYS)]
    )


if __name__ == "__main__":
    main()
