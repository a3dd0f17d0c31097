"""Two RealSense software devices and one OpenNI2 device recorded at once, 30 frames a second: is each frame on disk as it was sent?

    python scripts/study_mixed_capture.py --seconds 60

`capture --wave` writes every frame of every camera. Each frame that is sent has its number in its first pixels; afterwards all
images on disk are compared with what was sent, and what is missing with what the program said of it. The SDKs are the makers' own:
librealsense's software devices, and Debian's OpenNI2 runtime with a virtual driver.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock

import click
import cv2
import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

NUMBERED = 4
"""Pixels at the beginning of a frame, for the bytes of its number."""


def numbered(image: np.ndarray, n: int) -> np.ndarray:
    out = image.copy()
    out[0, :NUMBERED] = np.frombuffer(n.to_bytes(NUMBERED, "little"), np.uint8).reshape(-1, *[1] * (image.ndim - 2))
    return out


def number_of(image: np.ndarray) -> int:
    return int.from_bytes(bytes(image[0, :NUMBERED].reshape(NUMBERED, -1)[:, 0].astype(np.uint8)), "little")


def cameras(folder: Path) -> list[Any]:
    """Soft cameras that send drawn pictures, numbered."""
    from small_recording import draw_recording
    from soft_openni2 import SoftOpenNi2, use
    from soft_realsense import SoftRealSense
    from virtual_rig import build_redist

    from rgbd_calib.io.recording import open_recording

    use(build_redist(folder / "redist"))
    drawn = open_recording(draw_recording(folder / "drawn", cameras=3, frames=4))
    made = [SoftRealSense("111"), SoftRealSense("222"), SoftOpenNi2("333")]
    for camera, files in zip(
        made, zip(drawn.color_files.values(), drawn.depth_files.values(), strict=True), strict=True
    ):
        bank = {}
        for kind, own in zip(("color", "depth"), files, strict=True):
            read = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in own.values()]
            read = [cv2.resize(image, camera.sizes[kind], interpolation=cv2.INTER_NEAREST) for image in read]
            bank[kind] = [np.ascontiguousarray(image[..., ::-1]) if kind == "color" else image for image in read]
        camera.pixels = lambda kind, n, bank=bank: numbered(bank[kind][n % len(bank[kind])], n)
    return made


def record(made: list[Any], out: Path, seconds: float) -> dict[str, Any]:
    """Play and record the cameras; what the program says in capture.yaml, and the seconds of CPU."""
    from soft_cameras import Player

    from rgbd_calib.capture import session
    from rgbd_calib.io.files import load_yaml
    from rgbd_calib.sensors.driver import Drivers

    drivers = Drivers([type(made[0]).driver(made[:2]), type(made[2]).driver(made[2:])])
    params = session.CaptureParams(out, "wave", wave_s=seconds, settle_s=1.0, allow_unregistered=True)
    cpu_s = time.process_time()
    with closing(Player(made)), mock.patch.object(session, "load_drivers", return_value=drivers):
        session.capture(params, Console(stderr=True), lambda camera, proposed: None)
    return load_yaml(out / "capture.yaml")["sessions"][-1] | {"cpu_s": time.process_time() - cpu_s}


def compare(made: list[Any], out: Path, session: dict[str, Any]) -> dict[str, Any]:
    """By camera: frames on disk, images that differ from what was sent, and frames between the first and the last that are missing."""
    from rgbd_calib.io.recording import open_recording

    recording, result = open_recording(out), {}
    for camera in recording.cameras:
        serial = session["cameras"][camera]["serial"]
        sent = next(one for one in made if one.serial == serial)
        numbers, differ = [], 0
        for frame, path in recording.color_files[camera].items():
            color = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
            depth = cv2.imread(str(recording.depth_files[camera][frame]), cv2.IMREAD_UNCHANGED)
            numbers.append(number_of(color))
            for kind, image in (("color", color), ("depth", depth)):
                differ += not np.array_equal(image, sent.pixels(kind, numbers[-1]))
        missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
        twice = len(numbers) - len(set(numbers))
        result[camera] = {
            "make": type(sent).__name__.removeprefix("Soft"),
            "frames": len(numbers),
            "differ": differ,
            "twice": twice,
            "missing": missing,
        }
    return result


@click.command(help=__doc__)
@click.option("--seconds", type=float, default=60.0, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def main(seconds: float, as_json: bool) -> None:
    with tempfile.TemporaryDirectory(prefix="mixed-") as work:
        made = cameras(Path(work))
        out = Path(work) / "recording"
        start_s = time.monotonic()
        session = record(made, out, seconds)
        elapsed_s = time.monotonic() - start_s
        result = compare(made, out, session)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    said = {camera: session["counts"]["cameras"][camera] for camera in result}
    if as_json:
        print(json.dumps({"cameras": result, "said": said, "not_written": session["counts"]["not_written"]}))
        return
    for camera, own in result.items():
        print(
            f"{camera} ({own['make']}): {own['frames']} frames ({own['frames'] / seconds:.1f} fps), images that differ {own['differ']}, "
            f"frames twice {own['twice']}, missing {len(own['missing'])} {own['missing'][:10]}"
        )
        counts = said[camera]
        dropped = sum(gap["frames"] for gap in session["counts"]["not_written"].get(camera, []))
        print(
            f"    said: lost by the device {counts['lost']}, without a partner {counts['unpaired']}, dropped {dropped}"
        )
    print(
        f"{seconds:.0f} s of frames in {elapsed_s:.0f} s; CPU {session['cpu_s'] / seconds:.0%} of one core, cameras included; peak memory "
        f"{peak_mb:.0f} MB; load average {os.getloadavg()[0]:.1f}"
    )


if __name__ == "__main__":
    main()
