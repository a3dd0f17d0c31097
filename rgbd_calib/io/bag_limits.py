"""A size limit for compressed ROS bags: `rosbags` has none, and a few kilobytes of bz2 can expand to gigabytes."""

from __future__ import annotations

import bz2
import sys
from typing import Any, BinaryIO, Protocol

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_CHUNK_BYTES = 256 << 20
"""Of one chunk or message. ROS writes chunks of 768 kB, or one message: an image of 8192 x 8192 x 3 bytes is 192 MB."""
MAX_RATIO = 1000
"""Of a file that is expanded as a whole; images compress by 2 to 20, black ones by 300."""


def limit_expansion() -> None:
    """Let `rosbags`, from now on in this process, expand chunks and messages up to the limit only.

    Its readers take their decompressors from tables of two modules, which is where ours are put. What expands beyond the
    limit, ends early or is damaged raises ValueError.
    """
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    ros1.decompressors.update({"bz2": _bz2, "lz4": _lz4})
    mcap.DECOMPRESSORS.update({"lz4": lambda data, _: _lz4(data), "zstd": lambda data, _: _zstd(data)})
    ros2.zstd = _Zstd  # type: ignore[assignment, misc]


class Decompressor(Protocol):
    """What `bz2.BZ2Decompressor`, `lzma.LZMADecompressor` and `lz4.frame.LZ4FrameDecompressor` have in common."""

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def expand(decompressor: Decompressor, data: bytes) -> bytes:
    """Compressed `data`, expanded to at most MAX_CHUNK_BYTES.

    Raises
    ------
    ValueError
        `data` expand beyond the limit, end early, or are damaged.
    """
    try:
        out = decompressor.decompress(data, max_length=MAX_CHUNK_BYTES + 1)
    except (OSError, EOFError, RuntimeError, zstd.ZstdError) as error:
        raise ValueError(f"damaged compressed data: {error}") from error
    if len(out) > MAX_CHUNK_BYTES:
        raise ValueError(f"compressed data expand to more than {MAX_CHUNK_BYTES >> 20} MB")
    if not decompressor.eof:
        raise ValueError("compressed data end early")
    return out


def _bz2(data: bytes) -> bytes:
    return expand(bz2.BZ2Decompressor(), data)


def _lz4(data: bytes) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return expand(LZ4FrameDecompressor(), data)


def _zstd(data: bytes) -> bytes:
    return expand(zstd.ZstdDecompressor(), data)


class _Zstd:
    """As much of the module `zstd` as `rosbags` uses."""

    decompress = staticmethod(_zstd)

    @staticmethod
    def open(stream: BinaryIO, mode: str) -> Any:
        return _BoundedFile(stream, mode)


class _BoundedFile(zstd.ZstdFile):
    def __init__(self, stream: BinaryIO, mode: str) -> None:
        size = stream.seek(0, 2)
        stream.seek(0)
        self._left = MAX_RATIO * size
        super().__init__(stream, mode)  # type: ignore[call-overload]

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(f"its zstd data expand to more than {MAX_RATIO} times their size")
        return data
