"""Four virtual cameras at 30 fps through the real runtime: frames lost, wrong pairs, processor share, memory over time.

    python scripts/benchmark_capture.py --seconds 60

Reads and pairs all frames of both streams, without detection or writing. The virtual driver of the tests writes the true
number of each exposure into its pictures, so that every pair can be checked.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cameras", type=int, default=4)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure(Path(folder), arguments.cameras, arguments.seconds)


def measure(folder: Path, cameras: int, seconds: float) -> None:
    """Run the rig for `seconds`, and print one line every tenth of it and a summary."""
    from small_recording import draw_recording
    from virtual_rig import build_redist, feed

    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.sensors.discover import find_cameras
    from rgbd_calib.sensors.driver import Drivers
    from rgbd_calib.sensors.openni2 import load_runtime
    from rgbd_calib.sensors.rig import SensorRig

    feed(open_recording(draw_recording(folder / "drawn", cameras, 6)), folder / "raw")
    settings = {"DEVICES": cameras, "DATA": folder / "raw", "STAMP": 1, "COLOR_LAG_US": 8000, "JITTER_US": 3000}
    settings |= {"PHASE_US": "0,9000,17000,25000", "DRIFT_PPM": "0,40,-60,100"}
    os.environ.update({f"VXTION_{key}": str(value) for key, value in settings.items()})
    runtime = Drivers([load_runtime(build_redist(folder / "redist"))])
    found = find_cameras(runtime)
    with SensorRig(runtime, found.assign({}), lambda camera, text: print(camera, text), settle_s=2.0) as rig:
        checks = [_PairCheck(rig, camera) for camera in rig.cameras]
        before, cpu_s, start_s = rig.counts(), time.process_time(), time.monotonic()
        sets, spreads_ms = 0, []
        print("   s   resident MB   frames/s")
        for step in range(1, 11):
            while time.monotonic() < start_s + step * seconds / 10:
                frame_set = rig.next_frame_set(time.monotonic(), 3.0)
                if frame_set is not None:
                    sets += 1
                    spreads_ms.append(frame_set.spread_s * 1e3)
                time.sleep(0.05)
            frames = sum(sum(c.frames.values()) for c in rig.counts().values())
            frames -= sum(sum(c.frames.values()) for c in before.values())
            print(
                f"{time.monotonic() - start_s:4.0f}   {_resident_mb():11.1f}   {frames / (time.monotonic() - start_s):8.1f}",
                flush=True,
            )
        elapsed_s, cpu_s, after = time.monotonic() - start_s, time.process_time() - cpu_s, rig.counts()
        for check in checks:
            check.stop()
    lost = {c: {k: after[c].lost[k] - before[c].lost[k] for k in ("color", "depth")} for c in after}
    offered = round(elapsed_s * 30) * 2 * cameras
    print(
        f"{cameras} cameras, {elapsed_s:.1f} s, about {offered} frames offered; lost: {sum(sum(n.values()) for n in lost.values())} {lost}"
    )
    print(f"pairs checked {sum(c.checked for c in checks)}, of two exposures: {sum(c.wrong for c in checks)}")
    print(
        f"processor: {cpu_s / elapsed_s:.0%} of one core, virtual driver included; load average {os.getloadavg()[0]:.1f}"
    )
    print(f"frame sets {sets}, spread median {sorted(spreads_ms)[sets // 2]:.1f} ms, largest {max(spreads_ms):.1f} ms")


class _PairCheck:
    """Compares the true numbers in colour and depth of every pair that a camera's reader makes."""

    def __init__(self, rig, camera: str) -> None:  # type: ignore[no-untyped-def]
        self.checked = self.wrong = 0
        self._reader = rig.reader(camera)
        self._seen = -1
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.1):  # the reader keeps 8 pairs: 0.27 s
            for pair in self._reader.pairs():
                if pair.color.device_us > self._seen:
                    self._seen = pair.color.device_us
                    self.checked += 1
                    self.wrong += bytes(pair.color.pixels[0].ravel()[:8]) != bytes(pair.depth.pixels[0].view("u1")[:8])


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
