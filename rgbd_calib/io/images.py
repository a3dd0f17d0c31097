"""Images of recordings: PNG, JPEG, TIFF, BMP, PNM, WebP and NPY, by content; the size is checked before anything is decoded."""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.fast_png import read_rgb
from rgbd_calib.io.files import whole_file
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.schema_base import MAX_SIDE

MAX_BYTES = 256 << 20
"""MAX_SIDE x MAX_SIDE pixels of 3 bytes, not compressed."""
_CONVERTED = {"P": "RGBA", "PA": "RGBA", "1": "RGB", "LA": "RGB", "CMYK": "RGB", "YCbCr": "RGB"}
"""How Pillow's modes other than grey, R G B and R G B A are read; a palette may hold transparency."""
_PNG, _JPEG, _NPY = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"\x93NUMPY"
_TIFF, _BMP, _PNM = (b"II*\0", b"MM\0*"), b"BM", (b"P5", b"P6")
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".pgm")
logging.getLogger("PIL").addHandler(logging.NullHandler())  # what it logs of a damaged file is raised, too
BRIGHTEST = 99.5
"""Percentile of an infrared image above which it may be white: what reflects, and what is near."""


def read_image(path: Path, size: tuple[int, int] | None = None, who: str = "") -> np.ndarray:
    """The image (height, width) or (height, width, 3 or 4) in a file; R G B where it has colours, of the file's type.

    Parameters
    ----------
    size
        Width and height that it must have, px; None: at most MAX_SIDE each.
    who
        What says so, as "dataset.yaml says".

    Raises
    ------
    ConfigError
        No such file, damaged, of no kind that is read, or of another size.
    """
    return decode_image(read_bytes(path, MAX_BYTES), str(path), size, who)


def decode_image(data: bytes, where: str, size: tuple[int, int] | None = None, who: str = "") -> np.ndarray:
    """As :func:`read_image`, of a file's bytes; `where` names them in errors."""
    if (rgb := read_rgb(data, size)) is not None:
        return rgb
    try:
        if data.startswith(_NPY):
            return _decode_npy(data, where, size, who)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, of odd tags in TIFF
            with open_image(data) as image:
                _check_size(where, image.size, size, who)
                if getattr(image, "n_frames", 1) != 1:
                    raise ValueError("several images in one file; one is needed")
                image.load()  # raises where the file ends early, which cv2.imread would not
                array = np.array(image if image.mode not in _CONVERTED else image.convert(_CONVERTED[image.mode]))
    except ConfigError:
        raise
    except (
        Exception
    ) as error:  # a decoder raises anything on bytes that were made to: struct.error, EOFError, zlib.error
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"{where}: damaged or no image ({why}). Delete it, or copy the recording again") from error
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    whole = array.dtype == np.int32 and array.size and array.min() >= 0 and array.max() < 65536
    return array.astype(np.uint16) if whole else array


def as_bgr(image: np.ndarray) -> np.ndarray:
    """B G R (h, w, 3) of a decoded image that is grey, R G B or R G B A."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    if image.dtype == np.uint8:
        return cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGR)
    return np.ascontiguousarray(image[..., 2::-1])


def in_8_bits(image: np.ndarray) -> np.ndarray:
    """An infrared image (h, w), uint8 or uint16, as uint8: the root of the brightness, which falls as 1 / z^2."""
    if image.dtype == np.uint8:
        return image
    root = np.sqrt(image.astype(np.float32))
    return np.clip(root * (255 / max(float(np.percentile(root, BRIGHTEST)), 1.0)), 0, 255).astype(np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image (h, w) or (h, w, 3), B G R, as PNG; one of many, so without waiting for the disk."""
    with whole_file(path, durable=False) as temporary:
        # not imwrite, which does not always notice that the disk is full
        temporary.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def open_image(data: bytes):  # type: ignore[no-untyped-def]
    """The image with its header read, by the decoder that its first bytes name: no other of Pillow's is let near it."""
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile
    from PIL.PpmImagePlugin import PpmImageFile
    from PIL.TiffImagePlugin import TiffImageFile
    from PIL.WebPImagePlugin import WebPImageFile

    if data.startswith(_PNG):
        return PngImageFile(io.BytesIO(data))
    if data.startswith(_JPEG):
        # Pillow reads EXIF data on opening, and warns of what is wrong in them
        return JpegImageFile(io.BytesIO(data.replace(b"Exif\x00\x00", b"none\x00\x00")))
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return WebPImageFile(io.BytesIO(data))
    for start, kind in ((_TIFF, TiffImageFile), (_BMP, BmpImageFile), (_PNM, PpmImageFile)):
        if data.startswith(start):
            return kind(io.BytesIO(data))
    raise ValueError(f"{len(data)} bytes that begin as none of PNG, JPEG, TIFF, BMP, PNM, WebP, NPY")


def _decode_npy(data: bytes, where: str, size: tuple[int, int] | None, who: str) -> np.ndarray:
    """The array of a .npy file, its shape checked before it is made."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = read_header(stream)
    if len(shape) == 3 and shape[2] == 1:
        shape = shape[:2]
    if len(shape) not in (2, 3) or dtype.kind not in "uif" or min(shape) < 1:
        raise ValueError(f"an array {shape} of {dtype}; numbers (height, width) are needed")
    _check_size(where, (shape[1], shape[0]), size, who)
    return np.load(io.BytesIO(data), allow_pickle=False).reshape(shape)


def _check_size(where: str, seen: tuple[int, int], size: tuple[int, int] | None, who: str) -> None:
    if size is None and max(seen) > MAX_SIDE:
        raise ConfigError(f"{where}: {seen[0]}x{seen[1]} px seen, {MAX_SIDE} a side at most needed. Is it an image?")
    if size is not None and seen != size:
        raise ConfigError(
            f"{where}: {seen[0]}x{seen[1]} px seen, {who} {size[0]}x{size[1]}. "
            "Correct the size in dataset.yaml, or record depth registered to colour"
        )
