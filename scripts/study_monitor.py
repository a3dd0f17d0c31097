"""Memory and descriptors of `rgbd-calib monitor` over many rounds, for docs/guides/drift.md.

    python scripts/study_monitor.py WORK --rounds 10000

A folder of simulated images whose files are touched all the time, as if another program wrote them anew: each round reads,
averages and compares them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

from study_clouds import made


def touch(files: list[Path], ended: threading.Event) -> None:
    while not ended.wait(0.01):
        for file in files:
            os.utime(file)


def measured(pid: int) -> tuple[int, float, int, int]:
    """Descriptors, resident memory (MB), its greatest (MB), and threads of a process."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    resident, most = (int(status[key].split()[0]) / 1000 for key in ("VmRSS", "VmHWM"))
    return len(os.listdir(f"/proc/{pid}/fd")), resident, most, int(status["Threads"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--rounds", type=int, default=10000)
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--width", type=int, default=160)
    args = parser.parse_args()
    folder = args.work / "snapshots"
    if not folder.exists():
        made("simulate", folder, "--snapshot", "--cameras", args.cameras, "--width", args.width)
    ended = threading.Event()
    threading.Thread(target=touch, args=(sorted((folder / "new").rglob("*.png")), ended), daemon=True).start()
    command = [
        sys.executable,
        "-m",
        "rgbd_calib",
        "monitor",
        folder / "truth.yaml",
        folder / "new",
        "--snapshot",
        folder / "old",
    ]
    options = f"--every 0 --rounds {args.rounds} --frames 2 --json".split()
    command += [*options, "--metrics", args.work / "rig.prom"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        print("| round | resident, MB | at most, MB | descriptors | threads | failed so far |")
        print("|---|---|---|---|---|---|", flush=True)
        failed, seconds, number = 0, 0.0, 0
        for line in process.stdout:
            row = json.loads(line)
            number, failed, seconds = row["round"], failed + (row["status"] == "failed"), seconds + row["seconds"]
            if number in (1, 10, 100) or number % 1000 == 0:
                descriptors, resident, most, threads = measured(process.pid)
                print(f"| {number} | {resident:.1f} | {most:.1f} | {descriptors} | {threads} | {failed} |", flush=True)
    ended.set()
    print(f"\n{number} rounds, {seconds / max(number, 1):.2f} s each; exit status {process.returncode}")


if __name__ == "__main__":
    main()
