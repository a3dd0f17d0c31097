"""Image files of foreign folders as pictures: what recordings read as it is stays as it is, the rest becomes arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.source import Encoded, Kind
from rgbd_calib.io.images import MAX_BYTES, as_bgr, decode_image, read_image
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.schema_base import MAX_SIDE
from rgbd_calib.io.sniff import Sniffed, sniff

KEPT = {
    "color": (".jpg", ".jpeg", ".png", ".webp"),
    "depth": (".png", ".tif", ".tiff", ".npy"),
    "ir": (".png", ".tif", ".tiff"),
}
SUFFIXES = (".exr", ".npz")
"""Besides those that recordings read."""
_DEPTH_CHANNELS = ("Z", "depth", "Y", "R", "V")
"""Of EXR, the likeliest first."""


def read_picture(path: Path, kind: Kind) -> np.ndarray | Encoded:
    """An image file as a picture.

    Raises
    ------
    ConfigError
        No such file, or damaged, if it is not kept as it is; see :func:`check_picture`.
    """
    if path.suffix.lower() in KEPT[kind]:
        return Encoded(read_bytes(path, MAX_BYTES), path.suffix.lower().replace("jpeg", "jpg"))
    image = _array(path)
    if kind == "color":
        return as_bgr(image) if image.dtype == np.uint8 else image
    return image.astype(np.float32) if image.dtype.kind == "f" else image


def check_picture(image: np.ndarray, kind: Kind, where: str) -> None:
    """Raise ConfigError for decoded pixels that are no image of this kind."""
    if kind == "color":
        good, needed = image.dtype == np.uint8, "8 bits a channel"
    elif kind == "depth":
        good = image.ndim == 2 and (image.dtype.kind == "f" or image.dtype == np.uint16)
        needed = "16 bits and one channel, or floating point,"
    else:
        good, needed = image.ndim == 2 and image.dtype in (np.uint8, np.uint16), "8 or 16 bits and one channel"
    if not good:
        channels = 1 if image.ndim == 2 else image.shape[-1]
        raise ConfigError(
            f"{where}: {image.dtype} with {channels} channel(s) seen, {needed} needed for {kind}. Is it the right stream?"
        )


def sniff_picture(path: Path) -> Sniffed | None:
    """As :func:`rgbd_calib.io.sniff.sniff`, of the types that only an import reads as well."""
    if path.suffix.lower() not in SUFFIXES:
        return sniff(path)
    try:
        image = _array(path)
    except ConfigError:
        return None
    height, width = image.shape[:2]
    if image.ndim == 3:
        return Sniffed("color", width, height)
    return Sniffed("float" if image.dtype.kind == "f" else "grey 16", width, height)


def _array(path: Path) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr(path)
    if suffix == ".npz":
        return _only_array(path)
    return read_image(path)


def read_exr(path: Path) -> np.ndarray:
    """The depth channel (h, w), float32, of an OpenEXR file.

    Raises
    ------
    ConfigError
        The package OpenEXR is missing; damaged; no channel that could be depth.
    """
    try:
        import OpenEXR
    except ImportError:
        raise ConfigError(f"{path}: OpenEXR files need a package. Install it: pip install 'rgbd-calib[exr]'") from None
    data = read_bytes(path, MAX_BYTES)
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise ConfigError(f"{path}: damaged or no OpenEXR file. Copy it again")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            first, last = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
        if not 0 < (last - first + 1).min() <= (last - first + 1).max() <= MAX_SIDE:
            raise ValueError(f"{last - first + 1} px; {MAX_SIDE} a side at most needed")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:
        why = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path}: damaged or no OpenEXR file ({why}). Copy it again") from None
    named = {name.rpartition(".")[2]: pixels for name, pixels in channels.items()}
    found = next((named[name] for name in _DEPTH_CHANNELS if name in named), None)
    if found is None or found.ndim != 2 or found.dtype.kind not in "fu" or max(found.shape) > MAX_SIDE:
        raise ConfigError(f"{path}: channels {', '.join(channels)[:100]} seen, one of depth needed (Z, Y or R)")
    return found.astype(np.float32)


def _only_array(path: Path) -> np.ndarray:
    """The one image in a .npz file, by :func:`decode_image`."""
    import zipfile

    try:
        with zipfile.ZipFile(path) as file:
            members = [m for m in file.infolist() if m.filename.endswith(".npy") and m.file_size <= MAX_BYTES]
            if len(members) != 1:
                raise ValueError(f"{len(members)} arrays; one is needed")
            with file.open(members[0]) as stream:
                data = stream.read(MAX_BYTES + 1)
    except Exception as error:  # zipfile raises anything on bytes that were made to
        why = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path}: damaged or no .npz of one image ({why}). Copy it again") from None
    return decode_image(data, str(path))
