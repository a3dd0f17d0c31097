"""PNG images of the most frequent kind, 8 bits each of R, G and B, by libspng: half the time of Pillow, the same pixels.

libspng does not compare checksums, so that is done here. Whatever is not plainly whole, or has chunks that may change what
is seen, is left to Pillow, which reads it or says what is wrong with it.
"""

from __future__ import annotations

import zlib

import numpy as np

from rgbd_calib.io.schema_base import MAX_SIDE

try:
    from pyspng import load as _load
except ImportError:  # no wheels for Linux on ARM
    _load = None

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HARMLESS = {b"IHDR", b"IDAT", b"IEND", b"pHYs", b"tEXt", b"tIME", b"sRGB"}
_RGB_8 = bytes([8, 2, 0, 0, 0])
"""The end of the header: bits, colour type, compression, filter, not interlaced."""


def read_rgb(data: bytes, size: tuple[int, int] | None = None) -> np.ndarray | None:
    """The image (h, w, 3), uint8, in a PNG file of 8-bit R G B without transparency; None for everything else, and where it
    has not the `size` (w, h), or without one has more than MAX_SIDE pixels a side."""
    w, h = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
    if (w, h) != size if size is not None else max(w, h) > MAX_SIDE:
        return None
    if _load is None or data[24:29] != _RGB_8 or not _is_whole(data):
        return None
    try:
        image = np.asarray(_load(data))
    except Exception:  # whatever it was, Pillow says it better
        return None
    return image if image.shape == (h, w, 3) and image.dtype == np.uint8 else None


def _is_whole(data: bytes) -> bool:
    """Whether the file is harmless chunks with right checksums, from the header to the end."""
    view, at = memoryview(data), 8
    if data[:8] != _SIGNATURE or data[8:16] != b"\0\0\0\x0dIHDR":
        return False
    while at + 12 <= len(data):
        kind, end = data[at + 4 : at + 8], at + 8 + int.from_bytes(data[at : at + 4], "big")
        if kind not in _HARMLESS or data[end : end + 4] != zlib.crc32(view[at + 4 : end]).to_bytes(4, "big"):
            return False
        if kind == b"IEND":
            return True
        at = end + 4
    return False
