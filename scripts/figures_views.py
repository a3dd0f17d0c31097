"""Draws docs/figures/views.jpg: good and bad views of a board, each with what the detector finds in it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from detection_images import LOOKS, Look, with_board

from rgbd_calib.views.detect import find_corners

OUT = Path(__file__).parents[1] / "docs" / "figures" / "views.jpg"
WIDTH, HEIGHT, COLUMNS = 400, 300, 3
GOOD, BAD = (60, 140, 30), (40, 40, 200)
VIEWS: tuple[tuple[str, bool, Look], ...] = (
    ("good: large, tilted by 25 degrees", True, Look(side_px=(38, 42), tilt_deg=(24, 26))),
    ("good: farther away, tilted", True, Look(side_px=(22, 25), tilt_deg=(28, 32))),
    ("good: square to the camera, with tilted ones", True, Look(side_px=(34, 36), tilt_deg=(0, 3))),
    ("bad: too far", False, Look(side_px=(5.5, 6.5), blur_px=(0.8, 0.9))),
    ("bad: tilted by 72 degrees", False, Look(side_px=(26, 30), tilt_deg=(71, 73))),
    ("bad: out of focus", False, Look(blur_px=(5.5, 6.0))),
    ("bad: moved during exposure", False, Look(motion_px=(16, 18))),
    ("bad: glare", False, LOOKS["glare"]),
    ("bad: low contrast, noise", False, Look(white=(60, 80), contrast=(12, 16), noise=(12, 14))),
)


def main() -> None:
    rng = np.random.default_rng(4)
    tiles = [tile(*view, rng) for view in VIEWS]
    rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
    OUT.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(OUT), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


def tile(title: str, good: bool, look: Look, rng: np.random.Generator) -> np.ndarray:
    """One captioned picture."""
    drawn = with_board("easy", rng, look)
    found = find_corners(drawn.gray, drawn.board)
    image = cv2.cvtColor(drawn.gray, cv2.COLOR_GRAY2BGR)
    said = "board not found"
    if found is not None:
        ids, corners_px = found
        rms_px = min(
            float(np.sqrt(np.mean((corners_px - true_px[ids]) ** 2)))
            for true_px in (drawn.true_px, drawn.true_px[::-1])
        )
        said = f"{len(ids)} of {drawn.board.n_corners} corners, {rms_px:.3f} px RMS"
        for u, v in corners_px:
            cv2.circle(image, (round(u), round(v)), 3, (0, 200, 255), -1, cv2.LINE_AA)
    out = np.full((HEIGHT + 52, WIDTH + 8, 3), 255, np.uint8)
    out[:HEIGHT, 4:-4] = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    for n, (text, color) in enumerate(((title, GOOD if good else BAD), (said, (70, 70, 70)))):
        cv2.putText(out, text, (8, HEIGHT + 20 + 22 * n), cv2.FONT_HERSHEY_SIMPLEX, 0.52, color, 1, cv2.LINE_AA)
    return out


if __name__ == "__main__":
    main()
