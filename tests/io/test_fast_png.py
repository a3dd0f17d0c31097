"""PNG by libspng: the pixels that Pillow gives, and nothing damaged let through."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from rgbd_calib.io import fast_png
from rgbd_calib.io.fast_png import read_rgb
from rgbd_calib.io.images import decode_image

pytestmark = pytest.mark.skipif(fast_png._load is None, reason="no pyspng on this machine")


def picture(rng, mode="RGB"):
    gray = np.cumsum(rng.integers(-3, 4, (30, 41)), axis=1).astype(np.uint8)
    return Image.fromarray(np.stack([gray, gray + 9, rng.permutation(gray)], axis=2)).convert(mode)


def png(image, **options):
    stream = io.BytesIO()
    image.save(stream, "png", **options)
    return stream.getvalue()


@pytest.mark.parametrize("level", [0, 1, 6, 9])
def test_the_pixels_are_those_of_pillow(level):
    image = picture(np.random.default_rng(level))
    data = png(image, compress_level=level)
    assert np.array_equal(read_rgb(data), np.array(image))
    assert np.array_equal(decode_image(data, "a.png"), np.array(image))


def test_other_kinds_are_left_to_pillow():
    rng = np.random.default_rng(0)
    gamma = PngImagePlugin.PngInfo()
    gamma.add(b"gAMA", (45455).to_bytes(4, "big"))
    others = [png(picture(rng, mode)) for mode in ("RGBA", "L", "P", "1", "LA", "I;16")]
    others += [png(picture(rng), pnginfo=gamma), png(picture(rng), transparency=(1, 2, 3))]
    for data in others:
        assert read_rgb(data) is None
        assert decode_image(data, "a.png").shape[:2] == (30, 41)


def test_damage_is_left_to_pillow():
    """Cut, changed and shortened files: none is read here, and Pillow decides."""
    rng = np.random.default_rng(1)
    data = png(picture(rng))
    for k in range(600):
        part, at = bytearray(data), int(rng.integers(8, len(data) - 12))
        if k % 3 == 0:
            part = part[:at]
        elif k % 3 == 1:
            part[at] ^= 1 << int(rng.integers(8))
        else:
            del part[at : at + int(rng.integers(1, 12))]
        assert read_rgb(bytes(part)) is None


def test_images_of_another_size_are_left_to_pillow_to_refuse():
    data = png(picture(np.random.default_rng(2)))
    assert read_rgb(data, (41, 30)).shape == (30, 41, 3)
    assert read_rgb(data, (30, 41)) is None
    assert read_rgb(data[:16] + (40000).to_bytes(4, "big") + data[20:]) is None
