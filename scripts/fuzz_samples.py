"""Valid files of every kind that is read, from which `fuzz.py` makes damaged ones."""

from __future__ import annotations

import dataclasses
import io
import json
import struct
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import cv2
import numpy as np
import yaml

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import correspondences, exports, residuals, rig
from rgbd_calib.io.exports.common import Options
from rgbd_calib.io.files import dump_yaml
from rgbd_calib.io.plain import plain
from rgbd_calib.io.quality import quality_data
from rgbd_calib.quality import BiasSamples, CameraStatistics, Quality
from rgbd_calib.types import Board, BoardShape

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
    "caliscope timestamps.csv": [["cam_id", "frame_time"], ["0", "1.5"], ["0", "1.6"]],
}
RGB_TXT = [["1305031102.175304", "a.png"], ["1305031102.2", "a.png"]]
BOP = {"0": {"cam_K": [9.0, 0, 3.5, 0, 9.0, 2.5, 0, 0, 1], "depth_scale": 0.1}}
BOARDS: tuple[dict[str, Any], ...] = (
    {"board": DATASET["board"]},
    {"board": {"type": "charuco", "cols": 7, "rows": 5, "square": 0.04, "marker": 0.03, "dictionary": "DICT_4X4_50"}},
    {"target_type": "aprilgrid", "tagCols": 6, "tagRows": 6, "tagSize": 0.088, "tagSpacing": 0.3},
    {
        "target_type": "checkerboard",
        "targetCols": 9,
        "targetRows": 6,
        "colSpacingMeters": 0.06,
        "rowSpacingMeters": 0.06,
    },
)
CLOCK = {"offset_s": 0.01, "drift_ppm": 2.0, "depth_delay_s": 0.001, "readout_s": 0.01, "jitter_s": 0.001}
TIMING = RIG | {"cameras": {"C1": {"clock": {}}, "C2": {"clock": CLOCK}}}
COLMAP = {
    "cameras.txt": b"# a comment\n1 OPENCV 8 6 9 9 3.5 2.5 0.1 0 0 0\n2 PINHOLE 8 6 9 9 3.5 2.5\n",
    "images.txt": b"1 1 0 0 0 0 0 0 1 left/a.png\n\n2 1 0 0 0 0.1 0 0 2 right/a.png\n1 2 -1\n",
    "rigs.txt": b"1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 0.1 0 0\n",
    "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 9, 9, 3.5, 2.5),
    "images.bin": struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q", 0),
}
_RAW_LENS = {
    "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
    "ModelParameters": [0.5, 0.6, 0.5, 0.7, *[0.1] * 10],
}
_POSE = {"Rotation": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0.0, 0.0, 0.0]}
_SENSOR = {"SensorWidth": 4096, "SensorHeight": 3072}
AZURE = {
    "CalibrationInformation": {
        "Cameras": [
            {"Location": f"CALIBRATION_CameraLocation{which}", "Intrinsics": _RAW_LENS, "Rt": _POSE, **_SENSOR}
            for which in ("PV0", "D0")
        ]
    }
}


def csv_bytes(table: list[list[str]]) -> bytes:
    """The table as a file."""
    return "".join(",".join(row) + "\n" for row in table).encode()


def images() -> tuple[bytes, ...]:
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


SMALLEST: dict[Any, Any] = {
    Board: Board(9, 6, 0.06),
    BoardShape: BoardShape(np.zeros((54, 3))),
    Intrinsics: Intrinsics(8, 6, 9.0, 9.0, 3.5, 2.5, (0.0,) * 5),
}
"""Of records that check their fields."""


def example(hint: Any, within: tuple[Any, ...] = ()) -> Any:
    """A value of this type, every record with all of its fields: what `quality` of a rig file can hold."""
    kind, args = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        own = next(own for own in args if own is not NoneType)
        return None if own in within else example(own, within)  # a record within itself
    if kind is Literal:
        return args[0]
    if hint == FloatArray:
        return np.full((2, 2), 0.25)
    if kind in SMALLEST:
        return SMALLEST[kind]
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        named = [f.name for f in dataclasses.fields(kind) if f.name not in ("other", "faults")]
        return kind(**{name: example(hints[name], (*within, kind)) for name in named})  # type: ignore[operator]
    if kind is tuple:
        return tuple(example(own, within) for own in args if own is not ...)
    if kind is Mapping:
        return {"C1": example(args[1], within)}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return next(iter(kind))
    return {float: 0.5, int: 3, str: "C1", bool: True}.get(kind)


def full_rig() -> dict[str, Any]:
    """A rig file that has every key."""
    field = {
        "basis": "legendre",
        "width": 8,
        "height": 6,
        "degree": 1,
        "growth": [2.0, 0.0],
        "coefficients": [0.001, 0.001],
    }
    pattern = {"powers": [2], "values": [[[0.001, 0.0], [0.0, 0.001]]], "covariance": [[1e-6]]}
    grid = {"basis": "grid", "u_px": [0.0, 7.0], "v_px": [0.0, 5.0], "z_m": [0.5, 3.0], "error_m": np.zeros((2, 2, 2))}
    bias = BIAS | {"ripple_m": [0.001], "data_m": [0.6, 2.0], "covariance": np.eye(3)}
    depth = DATASET["cameras"]["C2"]["depth"] | {"covariance": np.eye(10)}
    depth["intrinsics"] = LENS | {"width": 4, "height": 3}
    pose = {"intrinsics": LENS, "T_world_color": EYE, "clock": CLOCK, "depth": depth, "intrinsics_sd": [1.0] * 9}
    held = {"min_m": 0.5, "max_m": 3.0, "covariance": np.eye(4), "pattern": pattern}
    camera: dict[str, Any] = plain(example(CameraStatistics))
    samples = plain(example(BiasSamples))
    cameras = {
        "C1": camera | pose | {"depth_bias": bias, "depth_field": field | held, "samples": samples},
        "C2": camera | pose | {"depth_bias": BIAS, "depth_field": grid},
    }
    return plain(RIG | {"cameras": cameras, "quality": quality_data(example(Quality))})  # type: ignore[no-any-return]


def calibrations(folder: Path) -> tuple[bytes, ...]:
    """Calibrations as this program exports them, and as others write them; `folder` is for a rig file."""
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
    seeds.append(json.dumps(AZURE))
    return tuple(text.encode() for text in seeds)


def trees(texts: tuple[bytes, ...]) -> tuple[dict[str, Any], ...]:
    """Those of calibrations that are mappings of YAML or JSON."""
    plain_yaml = [text for text in texts if not text.startswith((b"%", b"<", b"[", b"{ '"))]
    return tuple(yaml.load(text, Loader=yaml.CSafeLoader) for text in plain_yaml)


def videos(folder: Path) -> tuple[bytes, ...]:
    """A lossless and a lossy video of two frames, and one of depth."""
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
    return tuple(seeds)


def pictures(folder: Path) -> tuple[bytes, ...]:
    """Depth in files that only `import` reads: .npz, and .exr of both precisions and kinds."""
    import OpenEXR

    np.savez(folder / "a.npz", depth=np.full((6, 8), 900, np.uint16))
    made = [(folder / "a.npz").read_bytes()]
    for compression in (OpenEXR.ZIP_COMPRESSION, OpenEXR.NO_COMPRESSION, OpenEXR.PIZ_COMPRESSION):
        for kind in (np.float32, np.float16, np.uint32):
            header = {"compression": compression, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"Z": np.full((6, 8), 1, kind)}).write(str(folder / "a.exr"))
            made.append((folder / "a.exr").read_bytes())
    return tuple(made)
