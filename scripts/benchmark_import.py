"""Import of a large recording: MB/s against plain copying, peak memory, and what a kill half way costs.

    python scripts/benchmark_import.py WORK --gib 10
    python scripts/benchmark_import.py WORK --gib 10 --kind folder

Makes a ROS 2 bag (uncompressed images), or a folder of PNG files, in WORK: two cameras, colour and depth 640x480, each picture with
its number in its first pixels. Copies it, imports it, kills the import at half, gives the same command again, and compares all
pictures with what was made. Before each reading the pages of the source are dropped from the memory of the system, and each
writing ends when it is on the disk. WORK needs three times the size, and is emptied at the end.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

PAIR_BYTES = 640 * 480 * 5
CAMERAS = ("C1", "C2")
KINDS = ("color", "depth")


class Pictures:
    """A few rendered pictures of each stream, over and over, each with its number."""

    def __init__(self, folder: Path) -> None:
        from rgbd_calib.io.recording import open_recording
        from rgbd_calib.simulation.recording import SimulationParams, simulate
        from rgbd_calib.types import Board

        folder.mkdir()
        board = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
        params = SimulationParams(cameras=2, frames=6, intrinsic_views=0, distances_m=(), board=board)
        simulate(folder, params, 2, lambda items, total, what: iter(items))
        recording = open_recording(folder / "extrinsic")
        self._images = {}
        for camera in CAMERAS:
            for kind, files in (("color", recording.color_files), ("depth", recording.depth_files)):
                read = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in files[camera].values()]
                self._images[camera, kind] = read
        shutil.rmtree(folder)

    def numbered(self, camera: str, kind: str, n: int) -> np.ndarray:
        """Picture `n` of a stream."""
        own = self._images[camera, kind]
        image = own[n % len(own)].copy()
        image.reshape(-1)[: 4 * 3] = np.repeat(np.frombuffer(n.to_bytes(4, "little"), np.uint8), 3)
        return image


def make_bag(pictures: Pictures, path: Path, frames: int) -> None:
    from foreign_files import bag2

    with bag2(path) as bag:
        for n in range(frames):
            for camera in CAMERAS:
                for kind, form in (("color", "bgr8"), ("depth", "16UC1")):
                    topic = f"/{camera}/{kind}/image_raw"
                    bag.image(topic, 1_000_000 + n * 33_333, pictures.numbered(camera, kind, n), form)


def make_folder(pictures: Pictures, path: Path, frames: int) -> None:
    for camera in CAMERAS:
        for kind in KINDS:
            (path / camera / kind).mkdir(parents=True)
            for n in range(frames):
                image = pictures.numbered(camera, kind, n)
                cv2.imwrite(str(path / camera / kind / f"{n:06d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def files_of(path: Path) -> list[Path]:
    return [p for p in sorted(path.rglob("*")) if p.is_file()]


def forget(path: Path) -> None:
    """Drop the pages of all files from the memory of the system."""
    for file in files_of(path):
        with file.open("rb") as stream:
            os.fsync(stream.fileno())
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def import_once(source: Path, out: Path, kill_at: int | None) -> tuple[float, list[tuple[int, float]], str]:
    """Seconds, (pictures, resident MB) over time, and what was said. `kill_at`: so many pictures."""
    command = [sys.executable, "-m", "rgbd_calib", "import", source, "-o", out, "--depth-scale", "0.001", "--yes"]
    start_s, seen = time.monotonic(), []
    hidden = out.with_name(f".{out.name}.importing")
    with subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        while run.poll() is None:
            time.sleep(0.5)
            n = sum(len(os.listdir(p)) for p in hidden.glob("*/*") if p.is_dir()) if hidden.exists() else 0
            if (resident := resident_mb(run.pid)) is not None:
                seen.append((n, resident))
            if kill_at is not None and n >= kill_at:
                run.send_signal(signal.SIGKILL)
                run.wait()
        assert run.stdout is not None
        said = run.stdout.read()
    os.sync()
    return time.monotonic() - start_s, seen, said


def resident_mb(pid: int) -> float | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) * 1024 / 1e6
    except (OSError, StopIteration):
        return None  # it has ended


def differing(pictures: Pictures, out: Path, frames: int) -> int:
    """How many of the pictures that were made are missing in the recording, or differ."""
    from rgbd_calib.io.recording import open_recording

    recording, wrong = open_recording(out), 0
    for camera in recording.cameras:
        color, depth = recording.color_files[camera], recording.depth_files[camera]
        for n, name in enumerate(recording.frames):
            for kind, files in (("color", color), ("depth", depth)):
                path = files.get(name)
                image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path else None
                wrong += not np.array_equal(image, pictures.numbered(camera, kind, n))
    return wrong + (frames - len(recording.frames)) * 4


@click.command(help=__doc__)
@click.argument("work", type=click.Path(path_type=Path))
@click.option("--gib", type=float, default=10.0, show_default=True)
@click.option("--kind", type=click.Choice(["bag", "folder"]), default="bag", show_default=True)
def main(work: Path, gib: float, kind: str) -> None:
    work.mkdir(parents=True)
    try:
        measure(work, gib, kind)
    finally:
        shutil.rmtree(work)


def measure(work: Path, gib: float, kind: str) -> None:
    source, copy, out = work / kind, work / "copy", work / "recording"
    pictures = Pictures(work / "rendered")
    pair_bytes = PAIR_BYTES
    if kind == "folder":
        make_folder(pictures, work / "few", 6)
        pair_bytes = sum(f.stat().st_size for f in files_of(work / "few")) // (6 * len(CAMERAS))
        shutil.rmtree(work / "few")
    frames = round(gib * 2**30 / pair_bytes / len(CAMERAS))
    (make_bag if kind == "bag" else make_folder)(pictures, source, frames)
    mb = sum(f.stat().st_size for f in files_of(source)) / 1e6
    print(f"{kind}: {mb / 1e3:.2f} GB, {frames} frames of 2 cameras, {4 * frames} pictures", flush=True)

    forget(source)
    start_s = time.monotonic()
    shutil.copytree(source, copy)
    os.sync()
    copy_s = time.monotonic() - start_s
    shutil.rmtree(copy)
    print(f"copied in {copy_s:.0f} s: {mb / copy_s:.0f} MB/s", flush=True)

    forget(source)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    first_s, before, _ = import_once(source, out, 2 * frames)
    print(f"import killed after {first_s:.0f} s, at {before[-1][0]} pictures", flush=True)
    forget(source)
    second_s, after, said = import_once(source, out, None)
    print(said.strip())
    import_s, now = first_s + second_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    print(f"import in {first_s:.0f} + {second_s:.0f} s: {mb / import_s:.0f} MB/s, {copy_s / import_s:.2f} of copying")
    print(f"CPU {cpu_s:.0f} s: {mb / cpu_s:.0f} MB a second of one core; load average {os.getloadavg()[0]:.1f}")
    for what, seen in (("first half", before), ("second half", after)):
        early = max(r for n, r in seen if n <= seen[-1][0] * 0.55 + 200 or n == 0)
        print(f"resident, {what}: at most {max(r for _, r in seen):.0f} MB ({early:.0f} MB in its earlier part)")
    print(f"pictures that are missing or differ: {differing(pictures, out, frames)} of {4 * frames}")


if __name__ == "__main__":
    main()
