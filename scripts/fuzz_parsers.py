"""What `fuzz.py` and the tests feed to each reader: a valid file, how it is read, and what counts as a fault."""

from __future__ import annotations

import functools
import io
import json
import resource
import shutil
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
import numpy as np

from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.io import correspondences, exports, residuals, rig
from rgbd_calib.io.calibrations import read_calibration
from rgbd_calib.io.capture_log import CaptureLog
from rgbd_calib.io.exports.common import Options
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.foreign.bop import BopScene
from rgbd_calib.io.foreign.orbbec import OrbbecBag
from rgbd_calib.io.foreign.pictures import read_picture
from rgbd_calib.io.foreign.realsense import RealSenseBag
from rgbd_calib.io.foreign.ros import RosBag
from rgbd_calib.io.foreign.source import Source
from rgbd_calib.io.foreign.tum import TumFolder
from rgbd_calib.io.foreign.videos import Videos
from rgbd_calib.io.images import decode_image
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.config import as_plain, load_config

SLOW_S = 10.0
LARGE_BYTES = 1 << 30
LENS = {"model": "opencv", "width": 8, "height": 6, "fx": 9.0, "fy": 9.0, "cx": 3.5, "cy": 2.5, "distortion": [0.0] * 5}
BIAS = {"coefficients": [0.01, -0.01], "min_m": 0.5, "max_m": 3.0, "rms_m": 0.001}
EYE = np.eye(4).tolist()
DATASET: dict[str, Any] = {
    "format": "rgbd-calib/dataset",
    "version": 1,
    "depth_scale": 0.001,
    "depth_registered": False,
    "synchronous": True,
    "files": {"color": "{camera}/color/{frame}.png", "depth": "{camera}/depth/{frame}.png"},
    "cameras": {
        "C1": {"width": 8, "height": 6, "serial": "14", "intrinsics": LENS},
        "C2": {
            "width": 8,
            "height": 6,
            "depth": {
                "width": 4,
                "height": 3,
                "intrinsics": LENS | {"width": 4, "height": 3, "sd": [1.0] * 9},
                "T_color_depth": EYE,
                "scale_m": 0.001,
                "invalid": [7],
            },
        },
    },
    "board": {"type": "checkerboard", "cols": 9, "rows": 6, "square": 0.06, "two_sided": True, "thickness": 0.006},
}
RIG: dict[str, Any] = {
    "format": "rgbd-calib/rig",
    "version": 1,
    "reference": "C1",
    "cameras": {
        "C1": {"intrinsics": LENS, "T_world_color": EYE, "covariance": np.eye(6).tolist()},
        "C2": {
            "intrinsics": LENS,
            "T_world_color": EYE,
            "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
            "translation_m": [0.0, 0.0, 0.0],
            "depth_bias": BIAS,
            "sigma_2d_px": 0.2,
        },
    },
    "boards": {"000000": EYE},
    "quality": {"method": "bundle"},
    "provenance": {"seed": 0},
}
CAPTURE: dict[str, Any] = {
    "format": "rgbd-calib/capture",
    "version": 1,
    "clock_zero_unix_s": 1.7e9,
    "sessions": [{"started": "2026-01-01", "status": "complete", "cameras": {"C1": {"serial": "14"}}, "events": []}],
}
TABLES: dict[str, list[list[str]]] = {
    "corners.csv": [
        [*correspondences.CORNERS],
        ["C1", "0", "0", "1.5", "2.5", "1.1", "25"],
        ["C1", "0", "1", "3", "4", "", "0"],
    ],
    "correspondences.csv": [
        [*correspondences.CORRESPONDENCES],
        ["C1", "0", "a", "1.5", "2", "0.1", "0.2", "1.5"],
        ["C2", "0", "a", "1", "2", "", "", ""],
    ],
    "residuals.csv": [
        [*residuals.COLUMNS],
        ["C1", "0", "0", "1", "2", "0.1", "0.1", "1.5", "0.001", "both"],
        ["C1", "0", "1", "1", "2", "", "", "", "", "none"],
    ],
    "timestamps.csv": [["frame", "color_us", "depth_us"], ["000000", "0", "12"], ["000001", "33333", ""]],
    "distances.csv": [["frame", "distance_m"], ["000000", "0.8"], ["000001", "1.2"]],
}


@dataclass(frozen=True)
class Parser:
    """One reader of foreign input."""

    name: str
    read: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    tree: dict[str, Any] | None = None
    """Of a YAML file, to be mutated by structure."""
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
    start = time.perf_counter()
    status, what = "accepted", ""
    said = io.StringIO()
    with warnings.catch_warnings(record=True) as seen, redirect_stderr(said):
        warnings.simplefilter("always")
        signal.setitimer(signal.ITIMER_REAL, 2 * SLOW_S)
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
    if time.perf_counter() - start > SLOW_S:
        status, what = "fault", f"more than {SLOW_S:g} s"
    if (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 > LARGE_BYTES:
        status, what = "fault", "more than 1 GiB"
    return Outcome(status, what)


def _too_slow(number: int, frame: object) -> None:
    raise TimeoutError


def parsers(folder: Path) -> dict[str, Parser]:
    """All parsers by name; their files lie in `folder`, which should be in memory."""
    signal.signal(signal.SIGALRM, _too_slow)
    recording = _recording(folder / "recording")
    full, others = as_plain(load_config(None)), folder / "others"
    config = {key: full[key] for key in ("method", "reference", "seed", "detect", "initialization", "refinement")}
    (folder / "log").mkdir()
    (folder / "tum").mkdir()
    others.mkdir()
    opened = open_recording(recording)
    image = (folder / "recording/C1/color/000000.png").read_bytes()
    (folder / "tum" / "a.png").write_bytes(image)

    def from_file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
        def call(data: bytes) -> object:
            path.write_bytes(data)
            return read(path)

        return call

    def all_of_recording(path: Path) -> object:
        opened = open_recording(path.parent)
        kinds = ((opened.color_files, opened.color), (opened.depth_files, opened.depth_own_m))
        return [read(c, f) for files, read in kinds for c in opened.cameras for f in files[c]], opened.remarks

    def all_of_rig(path: Path) -> object:
        parts = (
            rig.read_intrinsics_sd,
            rig.read_depth_bias_samples,
            rig.read_boards,
            rig.read_intrinsics,
            rig.read_depth_bias,
        )
        part = zlib.crc32(path.read_bytes()) % (2 * len(parts))  # one of them: each parses the file anew
        return parts[part](path) if part < len(parts) else rig.read_rig(path)

    def tum(path: Path) -> object:
        source = TumFolder(path.parent, "C1")
        return source.stamps(), list(source.pictures(everything))

    yaml_readers: dict[str, tuple[dict[str, Any], Path, Callable[[Path], object]]] = {
        "dataset.yaml": (DATASET, recording / "dataset.yaml", all_of_recording),
        "rig.yaml": (RIG, others / "rig.yaml", all_of_rig),
        "config.yaml": (config, others / "config.yaml", load_config),
        "capture.yaml": (CAPTURE, folder / "log" / "capture.yaml", lambda p: CaptureLog(p.parent, "", "").identities()),
    }
    tables: dict[str, Callable[[Path], object]] = {
        "corners.csv": correspondences.read_corners,
        "correspondences.csv": correspondences.read_correspondences,
        "residuals.csv": residuals.read_residuals,
        "timestamps.csv": lambda p: opened.timestamps_us("C1"),
        "distances.csv": lambda p: opened.distances_m("C1"),
    }
    made = [
        Parser(name, from_file(path, read), (dump_yaml(tree).encode(),), tree=tree)
        for name, (tree, path, read) in yaml_readers.items()
    ]
    for name, read in tables.items():
        path = recording / "C1" / name if name in ("timestamps.csv", "distances.csv") else others / name
        made.append(Parser(name, from_file(path, read), (csv_bytes(TABLES[name]),), table=TABLES[name]))
    rgb_txt = b"# a comment\n1305031102.175304 a.png\n1305031102.2 a.png\n"
    words = [["1305031102.175304", "a.png"], ["1305031102.2", "a.png"]]
    made.append(Parser("rgb.txt", from_file(folder / "tum" / "rgb.txt", tum), (rgb_txt,), table=words))
    bytes_of_yaml = tuple(dump_yaml(tree).encode() for tree in (DATASET, CAPTURE)) + (b"a: &a {b: 1}\nc: {<<: *a}\n",)
    made.append(Parser("YAML bytes", from_file(others / "any.yaml", load_yaml), bytes_of_yaml))
    made.append(Parser("images", lambda data: decode_image(data, "image"), image_seeds()))
    made += [_calibrations(others), _bop(folder / "bop"), _videos(folder), _imported_images(folder)]
    return {parser.name: parser for parser in made} | _bag_parsers(folder)


def everything(*picture: object) -> bool:
    """All pictures are wanted."""
    return True


def all_of(source: Source) -> object:
    """Everything that a source gives."""
    return source.cameras, source.stamps(), source.stems(), list(source.pictures(everything))


_STARTS = ((b"{", ".json"), (b"<", ".xml"), (b"[", ".toml"))


def _calibrations(folder: Path) -> Parser:
    """Calibrations as this program exports them, and as others write them; the suffix by the first bytes."""
    path = folder / "rig.yaml"
    path.write_text(dump_yaml(RIG))
    known = rig.read_rig(path)
    seeds = [
        exports.export(known, to, Options(suffix=suffix)).files[""]
        for to, suffix in (
            ("kalibr", ""),
            ("nerfstudio", ""),
            ("open3d", ""),
            *(("opencv", s) for s in (".yml", ".xml", ".json")),
        )
    ]
    seeds.append(exports.export(known, "ros", Options()).files["C1.yaml"])
    seeds.append(
        "[cameras.0]\nsize = [8, 6]\nmatrix = [[9.0, 0, 3.5], [0, 9.0, 2.5], [0, 0, 1]]\ndistortions = [0.1, 0, 0, 0, 0]\n"
        "rotation = [0.1, 0, 0]\ntranslation = [0, 0, 1.0]\n"
    )
    own = {
        "width": 8,
        "height": 6,
        "fx": 9.0,
        "fy": 9.0,
        "ppx": 3.5,
        "ppy": 2.5,
        "model": "Inverse Brown Conrady",
        "coeffs": [0.01, 0, 0, 0, 0],
    }
    seeds.append(json.dumps({"color": {"intrinsics": own}}))
    seeds.append(
        "{ 'lensmodel': 'LENSMODEL_OPENCV4', 'extrinsics': [0, 0, 0, 0, 0, 0], 'intrinsics': [9, 9, 3.5, 2.5, 0, 0, 0, 0], 'imagersize': [8, 6], }"
    )

    def read(data: bytes) -> object:
        suffix = next((s for start, s in _STARTS if data.startswith(start)), ".yaml")
        if data.startswith(b"{ 'lens"):
            suffix = ".cameramodel"
        target = folder / f"calibration{suffix}"
        target.write_bytes(data)
        return read_calibration(target, (8, 6))

    return Parser("calibrations", read, tuple(text.encode() for text in seeds))


def _bop(folder: Path) -> Parser:
    for kind, image in (("rgb", np.zeros((6, 8, 3), np.uint8)), ("depth", np.full((6, 8), 900, np.uint16))):
        (folder / kind).mkdir(parents=True)
        cv2.imwrite(str(folder / kind / "000000.png"), image)

    def read(data: bytes) -> object:
        (folder / "scene_camera.json").write_bytes(data)
        return all_of(BopScene(folder, "C1"))

    entry = {"cam_K": [9.0, 0, 3.5, 0, 9.0, 2.5, 0, 0, 1], "depth_scale": 0.1}
    return Parser("scene_camera.json", read, (json.dumps({"0": entry}).encode(),))


def _videos(folder: Path) -> Parser:
    import av

    seeds = []
    for name, codec, pixels in (
        ("a.mkv", "ffv1", "bgr0"),
        ("a.mp4", "mpeg4", "yuv420p"),
        ("d.mkv", "ffv1", "gray16le"),
    ):
        path = folder / name
        with av.open(str(path), "w") as file:
            stream: Any = file.add_stream(codec, rate=30)
            stream.width, stream.height, stream.pix_fmt = 32, 16, pixels
            for i in range(2):
                grey = pixels == "gray16le"
                image = np.full((16, 32), 900 + i, np.uint16) if grey else np.full((16, 32, 3), 50 * i, np.uint8)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=pixels if grey else "bgr24")))
            file.mux(stream.encode())
        seeds.append(path.read_bytes())
        path.unlink()

    def read(data: bytes) -> object:
        path = folder / ("fuzzed.mkv" if data.startswith(b"\x1a\x45") else "fuzzed.mp4")
        path.write_bytes(data)
        return all_of(Videos(path, "C1"))

    return Parser("videos", read, tuple(seeds[:2]))


def _imported_images(folder: Path) -> Parser:
    import OpenEXR

    np.savez(folder / "a.npz", depth=np.full((6, 8), 900, np.uint16))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.full((6, 8), 0.9, np.float32)}).write(str(folder / "a.exr"))
    seeds = tuple((folder / name).read_bytes() for name in ("a.npz", "a.exr"))

    def read(data: bytes) -> object:
        path = folder / ("fuzzed.npz" if data.startswith(b"PK") else "fuzzed.exr")
        path.write_bytes(data)
        return read_picture(path, "depth")

    return Parser("imported images", read, seeds)


def csv_bytes(table: list[list[str]]) -> bytes:
    """The table as a file."""
    return "".join(",".join(row) + "\n" for row in table).encode()


def image_seeds() -> tuple[bytes, ...]:
    """Small images of the kinds that recordings hold, and of others that PNG and JPEG know."""
    rng = np.random.default_rng(0)
    color, depth = rng.integers(0, 256, (6, 8, 3), np.uint8), rng.integers(0, 9000, (6, 8), np.uint16)
    out = [
        cv2.imencode(".png", i)[1].tobytes() for i in (color, depth, color[..., 0], np.dstack([color, color[..., :1]]))
    ]
    out += [cv2.imencode(".jpg", i)[1].tobytes() for i in (color, color[..., 0])]
    from PIL import Image

    for array in (color, depth, depth.astype(np.float32)):
        for compression in (1, 5, 8):  # none, LZW, deflate
            out.append(cv2.imencode(".tiff", array, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes())
    out += [cv2.imencode(s, color)[1].tobytes() for s in (".bmp", ".ppm")] + [cv2.imencode(".pgm", depth)[1].tobytes()]
    for array in (depth, depth.astype(np.float32)):
        stream = io.BytesIO()
        np.save(stream, array)
        out.append(stream.getvalue())
    for mode, options in (("P", {"transparency": b"\0\1"}), ("1", {}), ("LA", {}), ("CMYK", {"format": "JPEG"})):
        stream = io.BytesIO()
        exif = Image.Exif()
        exif[0x0112] = 3
        Image.fromarray(color).convert(mode).save(stream, **{"format": "PNG", "exif": exif, **options})  # type: ignore[arg-type]
        out.append(stream.getvalue())
    return tuple(out)


def _recording(folder: Path) -> Path:
    for camera in ("C1", "C2"):
        (folder / camera / "color").mkdir(parents=True)
        (folder / camera / "depth").mkdir(parents=True)
        cv2.imwrite(str(folder / camera / "color" / "000000.png"), np.zeros((6, 8, 3), np.uint8))
        size = (6, 8) if camera == "C1" else (3, 4)
        cv2.imwrite(str(folder / camera / "depth" / "000000.png"), np.full(size, 900, np.uint16))
    (folder / "dataset.yaml").write_text(dump_yaml(DATASET))
    return folder


def _bag_parsers(folder: Path) -> dict[str, Parser]:
    _remember_types()
    made = {}
    for kind, suffix in (("ROS 1 bag", "bag"), ("MCAP", "mcap"), ("ROS 2 db3", "db3")):
        seed, path = _bag(folder / f"bag_{suffix}", suffix), folder / f"fuzzed.{suffix}"

        def read(data: bytes, path: Path = path) -> object:
            path.write_bytes(data)
            source = RosBag(path)
            return source.stamps(), list(source.pictures(everything))

        made[kind] = Parser(kind, read, (seed,))
    for kind, suffix, reader in (("RealSense db3", "db3", RealSenseBag), ("Orbbec bag", "bag", OrbbecBag)):
        seed, path = _makers_bag(folder / f"maker_{suffix}", suffix), folder / f"maker.{suffix}"

        def read_maker(data: bytes, path: Path = path, reader: Any = reader) -> object:
            path.write_bytes(data)
            return all_of(reader(path, "C1"))

        made[kind] = Parser(kind, read_maker, (seed,))
    return made


def _makers_bag(folder: Path, suffix: str) -> bytes:
    """A recording of librealsense (.db3) or the Orbbec SDK (.bag), as far as its reader looks."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if suffix == "bag" else Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg(
            "float32[] cameraIntrinsic\nfloat32[] cameraDistortion\nuint8 distortionModel\nuint16 width\nuint16 height\n"
            "float32[] rotationMatrix\nfloat32[] translationMatrix\n",
            "custom_msg/msg/StreamProfileInfo",
        )
    )
    types: Any = store.types
    path = folder.with_suffix(".bag") if suffix == "bag" else folder
    writer: Any = Writer1(path) if suffix == "bag" else Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    serialize = store.serialize_ros1 if suffix == "bag" else store.serialize_cdr
    more = {"seq": 0} if suffix == "bag" else {}
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](1, 2), frame_id="", **more)

    def image(encoding: str, *shape: int) -> Any:
        data = np.arange(np.prod(shape), dtype=np.uint8)
        return types["sensor_msgs/msg/Image"](header, *shape[:2], encoding, 0, data.size // shape[0], data)

    def text(value: str) -> Any:
        return types["std_msgs/msg/String"](value)

    if suffix == "bag":
        lens = np.array([9, 9, 3.5, 2.5], np.float32)
        profile = types["custom_msg/msg/StreamProfileInfo"](
            lens, np.zeros(8, np.float32), 4, 8, 6, np.eye(3, dtype=np.float32).ravel(), np.zeros(3, np.float32)
        )
        messages = [(f"/cam/streamProfileType_{n}", profile) for n in (2, 3)]
        messages += [
            ("/cam/sensor_2/frameType_2", image("bgr8", 6, 8, 3)),
            ("/cam/sensor_3/frameType_3", image("mono16", 6, 8, 2)),
        ]
    else:
        lens = "width=8;height=6;fx=9;fy=9;ppx=3.5;ppy=2.5;model=2;coeffs=0.1,0,0,0,0"
        messages = [("/device_0/info", text("Serial Number=0001"))]
        for n, (name, encoding, size) in enumerate((("Depth", "mono16", 2), ("Color", "rgb8", 3))):
            base = f"/device_0/sensor_{n}/{name}_0"
            messages += [
                (f"{base}/camera_info", text(lens.replace("model=2", "model=Brown Conrady"))),
                (f"{base}/tf/0", text("rotation=1,0,0,0,1,0,0,0,1;translation=0.01,0,0")),
                (f"{base}/image/data", image(encoding, 6, 8, size)),
                (f"{base}/image/metadata", text("timestamp_domain=Hardware Clock")),
            ]
        messages.append(("/device_0/sensor_0/option/Depth_Units/value", types["std_msgs/msg/Float32"](0.001)))
    with writer:
        for topic, message in messages:
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connection, 1_000_000_002, serialize(message, message.__msgtype__))
    data = path.read_bytes() if suffix == "bag" else next(path.glob("*.db3")).read_bytes()
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return data


def _bag(folder: Path, suffix: str) -> bytes:
    """A bag with one image and its camera_info."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if suffix == "bag" else Stores.ROS2_HUMBLE)
    types: Any = store.types
    plugin = StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3
    path = folder.with_suffix(".bag") if suffix == "bag" else folder
    writer: Any = Writer1(path) if suffix == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    more = {"seq": 0} if suffix == "bag" else {}
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="", **more
    )
    image = types["sensor_msgs/msg/Image"](header, 2, 3, "rgb8", 0, 9, np.arange(18, dtype=np.uint8))
    with writer:
        topic = writer.add_connection("/left/color/image_raw", "sensor_msgs/msg/Image", typestore=store)
        serialize = store.serialize_ros1 if suffix == "bag" else store.serialize_cdr
        writer.write(topic, 1_000_000_002, serialize(image, image.__msgtype__))
    data = path.read_bytes() if suffix == "bag" else next(path.glob(f"*.{suffix}")).read_bytes()
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return data


def _remember_types() -> None:
    """Compile message definitions that were seen before only once: 50 ms of 52 for each bag."""
    import rosbags.highlevel.anyreader as reader
    import rosbags.serde.utils as serde
    import rosbags.typesys.store as store

    if hasattr(reader.get_types_from_msg, "cache_info"):
        return
    reader.get_types_from_msg = functools.lru_cache(1000)(reader.get_types_from_msg)
    generate = store.generate_python_code
    codes: dict[str, str] = {}
    made: dict[str, dict[str, Any]] = {}

    def generate_once(typs: Any) -> str:
        key = repr(typs)
        if key not in codes:
            codes[key] = generate(typs)
        return codes[key]

    def run_once(code: str, space: dict[str, Any]) -> None:
        if code not in made:
            if len(made) > 1000:
                made.clear()
            fresh = dict(space)
            exec(code, fresh)
            made[code] = fresh
        space.update(made[code])

    store.generate_python_code = generate_once
    store.exec = serde.exec = run_once  # type: ignore[attr-defined]


def scratch() -> Path:
    """A new folder in memory, where the system has one."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if memory.is_dir() else None))


if __name__ == "__main__":
    sys.exit("This module holds what `fuzz.py` runs")
