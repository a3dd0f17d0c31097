"""What `fuzz.py` and the tests feed to each reader: a valid file, how it is read, and what counts as a fault."""

from __future__ import annotations

import io
import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import fuzz_bags
import fuzz_samples as samples
import numpy as np
from fuzz_bags import Reader, all_of, everything

from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.io import correspondences, exports, residuals, rig
from rgbd_calib.io.board_files import read_board
from rgbd_calib.io.calibrations import read_calibration
from rgbd_calib.io.capture_log import CaptureLog
from rgbd_calib.io.exports.common import Options
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.foreign.azure import AzureMkv
from rgbd_calib.io.foreign.bop import BopScene
from rgbd_calib.io.foreign.caliscope import CaliscopeSession
from rgbd_calib.io.foreign.pictures import read_picture
from rgbd_calib.io.foreign.realsense import RealSenseBag
from rgbd_calib.io.foreign.tum import TumFolder
from rgbd_calib.io.foreign.videos import Videos
from rgbd_calib.io.images import decode_image
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.snapshot import read_snapshot
from rgbd_calib.pipeline.config import as_plain, load_config
from rgbd_calib.trust.verdict import judge

SLOW_S = 10.0
LARGE_BYTES = 1 << 30
RECORDED = {"Azure mkv": ("azure_kinect.mkv", AzureMkv), "RealSense bag": ("realsense_single.bag", RealSenseBag)}
"""Readers that are fed recordings of real devices: file and reader."""


@dataclass(frozen=True)
class Parser:
    """One reader of foreign input."""

    name: str
    read: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    trees: tuple[dict[str, Any], ...] = ()
    """Of YAML or JSON files, to be mutated by structure."""
    table: list[list[str]] | None = None
    """Of a CSV file."""


@dataclass(frozen=True)
class Outcome:
    """What a reader made of an input: accepted, refused, or a fault and its place."""

    status: str
    what: str = ""


def attempt(parser: Parser, data: bytes) -> Outcome:
    """Read once; a fault is any other exception, a warning, words on stderr, too much time or too much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()  # of a loaded machine, too
    status, what = "accepted", ""
    said = io.StringIO()
    with warnings.catch_warnings(record=True) as seen, redirect_stderr(said):
        warnings.simplefilter("always")
        signal.setitimer(signal.ITIMER_REAL, 6 * SLOW_S)
        try:
            parser.read(data)
        except RgbdCalibError as error:
            status, what = "refused", str(error)
            if len(str(error)) > 2000 or "\n" in str(error):
                status, what = (
                    "fault",
                    f"message of {len(str(error))} characters on {str(error).count(chr(10)) + 1} lines",
                )
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            at = traceback.extract_tb(error.__traceback__)[-1]
            status, what = (
                "fault",
                f"{type(error).__name__}: {str(error)[:100]} at {Path(at.filename).name}:{at.lineno}",
            )
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    if status != "fault" and (seen or said.getvalue()):
        status, what = "fault", f"warning: {seen[0].message if seen else said.getvalue()[:100]}"
    if time.process_time() - start > SLOW_S:
        status, what = "fault", f"more than {SLOW_S:g} s"
    if (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 > LARGE_BYTES:
        status, what = "fault", "more than 1 GiB"
    return Outcome(status, what)


def _too_slow(number: int, frame: object) -> None:
    raise TimeoutError


def parsers(folder: Path, recordings: Path | None = None) -> dict[str, Parser]:
    """All parsers by name; their files lie in `folder`, which should be in memory; `RECORDED` where their files are given."""
    signal.signal(signal.SIGALRM, _too_slow)
    others = folder / "others"
    for name in ("log", "tum", "others"):
        (folder / name).mkdir()
    made = [*_of_trees(folder, _recording(folder / "recording"), others), *_of_tables(folder, others)]
    any_yaml = tuple(dump_yaml(tree).encode() for tree in (samples.DATASET, samples.CAPTURE))
    any_yaml += (b"a: &a {b: 1}\nc: {<<: *a}\n",)
    made.append(Parser("YAML bytes", from_file(others / "any.yaml", load_yaml), any_yaml))
    made.append(Parser("images", lambda data: decode_image(data, "image"), samples.images()))
    calibrations = samples.calibrations(others)
    made.append(Parser("calibrations", _by_start(others, _CALIBRATIONS, _calibration), calibrations))
    made.append(
        Parser("calibration trees", _by_start(others, _CALIBRATIONS, _calibration), (), samples.trees(calibrations))
    )
    made.append(
        Parser(
            "COLMAP", _colmap(folder / "colmap"), tuple(bytes([n]) + d for n, d in enumerate(samples.COLMAP.values()))
        )
    )
    made.append(Parser("scene_camera.json", _bop(folder / "bop"), (json.dumps(samples.BOP).encode(),), (samples.BOP,)))
    video = _by_start(folder, ((b"\x1a\x45", ".mkv"), (b"", ".mp4")), lambda p: all_of(Videos(p, "C1")))
    made.append(Parser("videos", video, samples.videos(folder)[:2]))
    picture = _by_start(folder, ((b"PK", ".npz"), (b"", ".exr")), lambda p: read_picture(p, "depth"))
    made.append(Parser("imported images", picture, samples.pictures(folder)))
    made += [Parser(name, read, (seed,)) for name, (read, seed) in fuzz_bags.readers(folder).items()]
    for name, (file, reader) in RECORDED.items() if recordings else ():
        read = from_file(folder / file, lambda p, reader=reader: all_of(reader(p, "C1")))  # type: ignore[misc]
        made.append(Parser(name, read, ((recordings / file).read_bytes(),)))  # type: ignore[operator]
    return {parser.name: parser for parser in made}


def from_file(path: Path, read: Callable[[Path], object]) -> Reader:
    """The reader of a file, as one of bytes."""

    def call(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return call


def _by_start(folder: Path, suffixes: tuple[tuple[bytes, str], ...], read: Callable[[Path], object]) -> Reader:
    """As :func:`from_file`, the file's suffix by its first bytes."""

    def call(data: bytes) -> object:
        path = folder / f"fuzzed{next(suffix for start, suffix in suffixes if data.startswith(start))}"
        path.write_bytes(data)
        return read(path)

    return call


def _of_trees(folder: Path, recording: Path, others: Path) -> list[Parser]:
    full = as_plain(load_config(None))
    config = {key: full[key] for key in ("method", "reference", "seed", "detect", "initialization", "refinement")}

    def all_of_recording(path: Path) -> object:
        opened = open_recording(path.parent)
        kinds = ((opened.color_files, opened.color), (opened.depth_files, opened.depth_own_m))
        images = [read(c, f) for files, read in kinds for c in opened.cameras for f in files[c]]
        return images, opened.remarks, [read_snapshot(opened, c) for c in opened.cameras]

    def all_of_rig(path: Path) -> object:
        parts = (
            rig.read_intrinsics_sd,
            rig.read_depth_bias_samples,
            rig.read_boards,
            rig.read_intrinsics,
            rig.read_depth_bias,
        )
        part = zlib.crc32(path.read_bytes()) % (4 * len(parts))  # one of them: each parses the file anew
        return parts[part](path) if part < len(parts) else used(rig.read_rig(path), part)

    def used(read: Any, part: int) -> object:
        """What is done with rigs that were read: judged, exported, written."""
        if not read.quality.faults:  # else the commands name them, and stop
            judge(read.quality, ())
        assert not any("\n" in why for why in read.quality.faults.values())
        dump_yaml(rig.rig_data(read))
        kinds = tuple(exports.FORMATS)
        return exports.export(read, kinds[part % len(kinds)], Options(suffix=".yml"))

    readers: dict[str, tuple[tuple[dict[str, Any], ...], Path, Callable[[Path], object]]] = {
        "dataset.yaml": ((samples.DATASET,), recording / "dataset.yaml", all_of_recording),
        "rig.yaml": ((samples.RIG, samples.full_rig()), others / "rig.yaml", all_of_rig),
        "config.yaml": ((config,), others / "config.yaml", load_config),
        "capture.yaml": (
            (samples.CAPTURE,),
            folder / "log" / "capture.yaml",
            lambda p: CaptureLog(p.parent, "", "").identities(),
        ),
        "board.yaml": (samples.BOARDS, others / "board.yaml", read_board),
        "timing.yaml": ((samples.TIMING,), others / "timing.yaml", rig.read_timing),
    }
    return [
        Parser(name, from_file(path, read), tuple(dump_yaml(tree).encode() for tree in trees), trees)
        for name, (trees, path, read) in readers.items()
    ]


def _of_tables(folder: Path, others: Path) -> list[Parser]:
    recording = folder / "recording"
    opened = open_recording(recording)
    (folder / "tum" / "a.png").write_bytes((recording / "C1/color/000000.png").read_bytes())
    session = folder / "caliscope"
    session.mkdir()
    (session / "cam_0.mp4").write_bytes(samples.videos(folder)[1])

    def tum(path: Path) -> object:
        source = TumFolder(path.parent, "C1")
        return source.stamps(), list(source.pictures(everything))

    readers: dict[str, tuple[Path, Callable[[Path], object]]] = {
        "corners.csv": (others, correspondences.read_corners),
        "correspondences.csv": (others, correspondences.read_correspondences),
        "residuals.csv": (others, residuals.read_residuals),
        "timestamps.csv": (recording / "C1", lambda p: opened.timestamps_us("C1")),
        "distances.csv": (recording / "C1", lambda p: opened.distances_m("C1")),
        "caliscope timestamps.csv": (session, lambda p: all_of(CaliscopeSession(p.parent))),
    }
    made = []
    for name, (where, read) in readers.items():
        table = samples.TABLES[name]
        made.append(
            Parser(name, from_file(where / name.rpartition(" ")[2], read), (samples.csv_bytes(table),), table=table)
        )
    listed = b"# a comment\n" + "".join(" ".join(row) + "\n" for row in samples.RGB_TXT).encode()
    made.append(Parser("rgb.txt", from_file(folder / "tum" / "rgb.txt", tum), (listed,), table=samples.RGB_TXT))
    return made


_CALIBRATIONS = ((b"{ 'lens", ".cameramodel"), (b"{", ".json"), (b"<", ".xml"), (b"[", ".toml"), (b"", ".yaml"))


def _calibration(path: Path) -> object:
    return read_calibration(path, (1280, 720) if b"CalibrationInformation" in path.read_bytes() else (8, 6))


def _colmap(folder: Path) -> Reader:
    """A model of which one file is fed: the first byte says which."""
    names = list(samples.COLMAP)

    def read(data: bytes) -> object:
        fed = names[data[0] % len(names) if data else 0]
        kind = folder / fed.rpartition(".")[2]
        kind.mkdir(parents=True, exist_ok=True)
        for name in names:
            if name.endswith(kind.name):
                (kind / name).write_bytes(data[1:] if name == fed else samples.COLMAP[name])
        return read_calibration(kind)

    return read


def _bop(folder: Path) -> Reader:
    for kind, image in (("rgb", np.zeros((6, 8, 3), np.uint8)), ("depth", np.full((6, 8), 900, np.uint16))):
        (folder / kind).mkdir(parents=True)
        cv2.imwrite(str(folder / kind / "000000.png"), image)
    return from_file(folder / "scene_camera.json", lambda p: all_of(BopScene(p.parent, "C1")))


def _recording(folder: Path) -> Path:
    for camera in ("C1", "C2"):
        (folder / camera / "color").mkdir(parents=True)
        (folder / camera / "depth").mkdir(parents=True)
        cv2.imwrite(str(folder / camera / "color" / "000000.png"), np.zeros((6, 8, 3), np.uint8))
        size = (6, 8) if camera == "C1" else (3, 4)
        cv2.imwrite(str(folder / camera / "depth" / "000000.png"), np.full(size, 900, np.uint16))
    (folder / "dataset.yaml").write_text(dump_yaml(samples.DATASET))
    return folder


def scratch() -> Path:
    """A new folder in memory, where the system has one."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if memory.is_dir() else None))


if __name__ == "__main__":
    sys.exit("This module holds what `fuzz.py` runs")
