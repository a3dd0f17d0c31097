"""What an image file holds, by its header: enough to tell colour from depth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rgbd_calib.io.images import MAX_BYTES, decode_image, open_image
from rgbd_calib.io.reading import read_bytes

Pixels = Literal["color", "grey 8", "grey 16", "float"]


@dataclass(frozen=True)
class Sniffed:
    """The pixels of an image file."""

    pixels: Pixels
    width: int
    height: int


def sniff(path: Path) -> Sniffed | None:
    """Type and size of an image; None where it is none that is read."""
    try:
        data = read_bytes(path, MAX_BYTES)
        if data.startswith(b"\x93NUMPY"):
            return _of_array(decode_image(data, str(path)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open_image(data) as image:
                mode, (width, height) = image.mode, image.size
    except Exception:  # a decoder raises anything
        return None
    if mode in ("I;16", "I;16B", "I;16L", "I"):
        return Sniffed("grey 16", width, height)
    if mode == "F":
        return Sniffed("float", width, height)
    return Sniffed("grey 8" if mode in ("L", "1", "LA") else "color", width, height)


def _of_array(array: np.ndarray) -> Sniffed | None:
    height, width = array.shape[:2]
    if array.ndim == 3:
        return Sniffed("color", width, height) if array.dtype == np.uint8 and array.shape[2] in (3, 4) else None
    if array.dtype.kind == "f":
        return Sniffed("float", width, height)
    return Sniffed("grey 8" if array.dtype.itemsize == 1 else "grey 16", width, height)
