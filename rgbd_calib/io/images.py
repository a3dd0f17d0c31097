"""Images of recordings: PNG and JPEG, by their content, with the size checked before anything is decoded."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.fast_png import read_rgb
from rgbd_calib.io.files import read_bytes, whole_file
from rgbd_calib.io.schema_base import MAX_SIDE

MAX_BYTES = 256 << 20
"""MAX_SIDE x MAX_SIDE pixels of 3 bytes, not compressed."""
_CONVERTED = {"P": "RGBA", "PA": "RGBA", "1": "RGB", "LA": "RGB", "CMYK": "RGB", "YCbCr": "RGB"}
"""How Pillow's modes other than grey, R G B and R G B A are read; a palette may hold transparency."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


def read_image(path: Path, size: tuple[int, int] | None = None, who: str = "") -> np.ndarray:
    """The image (height, width) or (height, width, 3 or 4) in a file; R G B where it has colours.

    Parameters
    ----------
    size
        Width and height that it must have, px; None: at most MAX_SIDE each.
    who
        What says so, as "dataset.yaml says".

    Raises
    ------
    ConfigError
        No such file, damaged, neither PNG nor JPEG, or of another size.
    """
    return decode_image(read_bytes(path, MAX_BYTES), str(path), size, who)


def decode_image(data: bytes, where: str, size: tuple[int, int] | None = None, who: str = "") -> np.ndarray:
    """As :func:`read_image`, of a file's bytes; `where` names them in errors."""
    if (rgb := read_rgb(data, size)) is not None:
        return rgb
    try:
        with _opened(data) as image:
            _check_size(where, image.size, size, who)
            image.load()  # raises where the file ends early, which cv2.imread would not
            array = np.array(image if image.mode not in _CONVERTED else image.convert(_CONVERTED[image.mode]))
    except ConfigError:
        raise
    except (
        Exception
    ) as error:  # a decoder raises anything on bytes that were made to: struct.error, EOFError, zlib.error
        raise ConfigError(f"{where}: damaged or no image ({error}). Delete it, or copy the recording again") from error
    return array.astype(np.uint16) if array.dtype == np.int32 and array.max() < 65536 else array


def as_bgr(image: np.ndarray) -> np.ndarray:
    """B G R (h, w, 3) of a decoded image that is grey, R G B or R G B A."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    if image.dtype == np.uint8:
        return cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGR)
    return np.ascontiguousarray(image[..., 2::-1])


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image (h, w) or (h, w, 3), B G R, as PNG; one of many, so without waiting for the disk."""
    with whole_file(path, durable=False) as temporary:
        # not imwrite, which does not always notice that the disk is full
        temporary.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _opened(data: bytes):  # type: ignore[no-untyped-def]
    """The image with its header read, by the decoder that its first bytes name: no other of Pillow's is let near it."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    if data.startswith(_PNG):
        return PngImageFile(io.BytesIO(data))
    if data.startswith(_JPEG):
        # Pillow reads EXIF data on opening, and warns of what is wrong in them
        return JpegImageFile(io.BytesIO(data.replace(b"Exif\x00\x00", b"none\x00\x00")))
    raise ValueError(f"{len(data)} bytes that begin neither as PNG nor as JPEG")


def _check_size(where: str, seen: tuple[int, int], size: tuple[int, int] | None, who: str) -> None:
    if size is None and max(seen) > MAX_SIDE:
        raise ConfigError(f"{where}: {seen[0]}x{seen[1]} px seen, {MAX_SIDE} a side at most needed. Is it an image?")
    if size is not None and seen != size:
        raise ConfigError(
            f"{where}: {seen[0]}x{seen[1]} px seen, {who} {size[0]}x{size[1]}. "
            "Correct the size in dataset.yaml, or record depth registered to colour"
        )
