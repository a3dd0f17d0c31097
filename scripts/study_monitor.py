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

RGBD_CALIB = [sys.executable, "-m", "rgbd_calib"]


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
    made = args.work / "snapshots"
    if not made.exists():
        size = ["--cameras", str(args.cameras), "--width", str(args.width)]
        subprocess.run([*RGBD_CALIB, "simulate", made, "--snapshot", *size], check=True)
    ended = threading.Event()
    threading.Thread(target=touch, args=(sorted((made / "new").rglob("*.png")), ended), daemon=True).start()
    command = [*RGBD_CALIB, "monitor", made / "truth.yaml", made / "new", "--snapshot", made / "old"]
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
