"""PNG without compression: the pixels come back as they were, by OpenCV and by this program's reader."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbd_calib.io.images import decode_image
from rgbd_calib.io.stored_png import stored_png


@pytest.mark.parametrize(
    ("size", "dtype"),
    [((48, 64, 3), np.uint8), ((240, 320, 3), np.uint8), ((7, 5), np.uint8), ((7, 5), np.uint16), ((1, 1), np.uint16)],
)
def test_what_was_stored_is_read(size, dtype):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, size, dtype)
    data = stored_png(image)
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == dtype and np.array_equal(read, image)
    decoded = decode_image(data, "a.png")
    assert np.array_equal(decoded, image[..., ::-1] if image.ndim == 3 else image)
