"""Pictures for people, as PNG."""

from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import whole_file


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3), uint8, R G B, whole or not at all."""
    from PIL import Image

    with whole_file(path) as temporary:
        try:
            Image.fromarray(picture).save(temporary, format="PNG")
        except OSError as error:
            raise ConfigError(f"{path}: could not be written ({error}). Is the disk full?") from error
