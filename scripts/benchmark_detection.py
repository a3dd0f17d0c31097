"""Compares finders of checkerboards, and ways of refining corners: on drawn images, on images without a board, on recordings.

Drawn images (scripts/detection_images.py) and recordings that `rgbd-calib simulate` made have known corners: a board counts
as found if every corner is within WRONG_SQUARES of a square of its place. In recordings without true corners, any board
found counts. Times are CPU time on one core, reading excluded. Refinements start from the same corners, those of OpenCV's
exhaustive search: their error, and the part of it that a whole board has in common (independent errors leave
RMS / sqrt(corners)).
"""

from __future__ import annotations

import csv
import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
from detection_images import BOARDS, LOOKS, room_pictures, with_board, without_board

from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.images import as_bgr, read_image
from rgbd_calib.io.schema_parts import BoardModel
from rgbd_calib.types import Board
from rgbd_calib.views.detect import DetectParams, find_corners, subpixel
from rgbd_calib.views.detect.checkerboard import find_checkerboard

Finder = Callable[[np.ndarray, Board], np.ndarray | None]
WRONG_SQUARES = 0.35


def opencv(flags: int, scale: int = 1, sectors: bool = False) -> Finder:
    def find(gray: np.ndarray, board: Board) -> np.ndarray | None:
        image = gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        search = cv2.findChessboardCornersSB if sectors else cv2.findChessboardCorners
        ok, corners = search(image, (board.cols, board.rows), flags=flags)
        return (corners.reshape(-1, 2).astype(float) + 0.5) / scale - 0.5 if ok else None

    return find


def ours(gray: np.ndarray, board: Board) -> np.ndarray | None:
    found = find_corners(gray, board)
    if found is None:
        return None
    corners = np.full((board.n_corners, 2), np.nan)
    corners[found[0]] = found[1]
    return corners


FINDERS: dict[str, Finder] = {
    "rgbd-calib": ours,
    "SB": opencv(0, sectors=True),
    "SB normalize": opencv(cv2.CALIB_CB_NORMALIZE_IMAGE, sectors=True),
    "SB exhaustive": opencv(cv2.CALIB_CB_EXHAUSTIVE, sectors=True),
    "SB accuracy": opencv(cv2.CALIB_CB_ACCURACY, sectors=True),
    "SB, image x 2": opencv(0, 2, sectors=True),
    "quads": opencv(cv2.CALIB_CB_ADAPTIVE_THRESH),
    "quads normalize": opencv(cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE),
    "quads fast check": opencv(cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK),
    "quads, image x 2": opencv(cv2.CALIB_CB_ADAPTIVE_THRESH, 2),
}


def refinements(gray: np.ndarray, grid: np.ndarray, start: np.ndarray) -> dict[str, tuple[np.ndarray, float]]:
    """Corners (n, 2), px, and seconds, of each way."""
    sides = subpixel._sides(grid, start)
    assert sides is not None
    out: dict[str, tuple[np.ndarray, float]] = {"as SB exhaustive has it": (start, 0.0)}

    def timed(name: str, refine: Callable[[], np.ndarray]) -> None:
        begin = time.process_time()
        out[name] = refine(), time.process_time() - begin

    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    begin = start[:, None].astype(np.float32)
    for half in (3, 5, 11):
        timed(
            f"cornerSubPix, {half} px",
            lambda half=half: cv2.cornerSubPix(gray, begin.copy(), (half, half), (-1, -1), stop)[:, 0].astype(float),
        )
    timed("cornerSubPix, half a square", lambda: subpixel._gradients(gray, start, sides))
    rough = out["cornerSubPix, half a square"][0]
    timed("model, after that", lambda: subpixel.fit_crossings(gray, rough, sides)[0])
    return out


def roughness(grid: np.ndarray, corners: np.ndarray) -> float:
    """RMS, px for each coordinate, about a homography and a cubic."""
    H, _ = cv2.findHomography(grid, corners)
    basis = subpixel._smooth(grid, len(grid))
    off = corners - cv2.perspectiveTransform(grid[:, None], H)[:, 0]
    off -= basis @ np.linalg.lstsq(basis, off, rcond=None)[0]
    return float(np.sqrt((off**2).sum() / (2 * (len(grid) - basis.shape[1]))))


@dataclass(frozen=True)
class Sample:
    """An image (h, w), uint8, and the true corners (n, 2), px, of its board where they are known and all visible."""

    gray: np.ndarray
    board: Board
    true_px: np.ndarray | None
    known: bool
    """Whether the corners are known; if so and `true_px` is None, there is no whole board."""


def load(folder: Path) -> list[Sample]:
    """Colour and infrared images of a simulated folder or of one recording."""
    truth: dict[tuple[str, ...], dict[str, dict[int, tuple[float, float, bool]]]] = defaultdict(
        lambda: defaultdict(dict)
    )
    if (folder / "true_corners.csv").exists():
        with (folder / "true_corners.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                key, at = (row["recording"], row["camera"], row["frame"]), (float(row["u_px"]), float(row["v_px"]))
                truth[key][row["face"]][int(row["feature"])] = (*at, row["visible"] == "1")
    samples = []
    for recording in [folder / name for name in ("extrinsic", "intrinsic")] if truth else [folder]:
        board = BoardModel(**load_yaml(recording / "dataset.yaml")["board"]).value()
        for path in sorted(p for kind in ("color", "ir") for p in recording.glob(f"*/{kind}/*")):
            faces = truth.get((recording.name, path.parts[-3], path.stem), {}).values()
            whole = [f for f in faces if len(f) == board.n_corners and all(c[2] for c in f.values())]
            true_px = np.array([whole[0][i][:2] for i in sorted(whole[0])]) if whole else None
            samples.append(Sample(_gray(read_image(path)), board, true_px, bool(truth)))
    return samples


def _gray(image: np.ndarray) -> np.ndarray:
    if image.ndim == 3:
        return cv2.cvtColor(as_bgr(image), cv2.COLOR_BGR2GRAY)
    return image if image.dtype == np.uint8 else cv2.convertScaleAbs(image, alpha=200 / np.percentile(image, 99))


def drawn(kind: str, n: int) -> list[Sample]:
    rng = np.random.default_rng([1, *kind.encode()])
    boards = [with_board(kind, rng) for _ in range(n)]
    return [Sample(b.gray, b.board, b.true_px, True) for b in boards]


def nearest_order(corners: np.ndarray, true_px: np.ndarray, board: Board) -> np.ndarray:
    """True corners in the finder's order: finders turn and mirror boards."""
    grid = true_px.reshape(board.rows, board.cols, 2)
    orders = [g.reshape(-1, 2) for g in (grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1])]
    return min(orders, key=lambda order: float(np.nanmean(np.abs(corners - order))))


def is_right(corners: np.ndarray | None, sample: Sample) -> bool:
    if corners is None or sample.true_px is None:
        return corners is not None and not sample.known
    off = np.abs(corners - nearest_order(corners, sample.true_px, sample.board))
    grid = sample.true_px.reshape(sample.board.rows, sample.board.cols, 2)
    side = min(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min() for a in (0, 1))
    return bool(np.nanmax(off) < WRONG_SQUARES * side)


def study_finders(kind: str, samples: list[Sample], names: list[str]) -> dict[str, Any]:
    """How many boards of a kind of images each finder finds, and all but the first one together."""
    row: dict[str, Any] = {"images": kind, "n": len(samples)}
    right = {}
    for name in names:
        begin = time.process_time()
        corners = [FINDERS[name](sample.gray, sample.board) for sample in samples]
        ms = 1e3 * (time.process_time() - begin) / len(samples)
        right[name] = [is_right(c, sample) for c, sample in zip(corners, samples, strict=True)]
        seen = sum(
            c is not None and (s.true_px is not None or not s.known) for c, s in zip(corners, samples, strict=True)
        )
        row |= {name: sum(right[name]), f"{name}, wrong": seen - sum(right[name]), f"{name}, ms": ms}
        errors = [c - nearest_order(c, s.true_px, s.board) for c, s, ok in zip(corners, samples, right[name], strict=True)
                  if ok and s.true_px is not None]  # fmt: skip
        if errors:
            row[f"{name}, median px"] = float(np.median([np.sqrt(np.nanmean(e**2)) for e in errors]))
    if len(names) > 1:
        row["all others together"] = sum(map(any, zip(*(right[name] for name in names[1:]), strict=True)))
    return row


def study_without(n: int, names: list[str], compared: int) -> list[dict[str, Any]]:
    """Boards found in images that hold none: `n` images for the first finder, `compared` for the others."""
    rng = np.random.default_rng(2)
    scenes = list(room_pictures(10, rng)) if n else []
    found, seconds, looked = Counter[str](), Counter[str](), Counter[str]()
    for k in range(n):
        gray, board = without_board(rng, scenes), Board(*BOARDS[rng.integers(len(BOARDS))], 1.0)
        for name in names if k < compared else names[:1]:
            begin = time.process_time()
            found[name] += FINDERS[name](gray, board) is not None
            seconds[name] += time.process_time() - begin
            looked[name] += 1
    return [
        {"finder": f, "images without a board": looked[f], "found": found[f], "ms": 1e3 * seconds[f] / looked[f]}
        for f in names
        if looked[f]
    ]


def study_refinements(samples: list[Sample]) -> list[dict[str, Any]]:
    errors: dict[str, list[np.ndarray]] = defaultdict(list)
    rough: dict[str, list[float]] = defaultdict(list)
    seconds: dict[str, list[float]] = defaultdict(list)
    for sample in samples:
        board, gray = sample.board, sample.gray
        start = FINDERS["SB exhaustive"](gray, board)
        if (
            start is None
            or (sample.known and sample.true_px is None)
            or not find_checkerboard(gray, board, DetectParams())
        ):
            continue
        grid = np.stack(np.divmod(np.arange(board.n_corners), board.cols)[::-1], axis=1).astype(float)
        for name, (corners, took) in refinements(gray, grid, start).items():
            seconds[name].append(took)
            if sample.true_px is not None:
                errors[name].append(corners - nearest_order(corners, sample.true_px, board))
            else:
                rough[name].append(roughness(grid, corners))
    rows = []
    for name, took in seconds.items():
        row: dict[str, Any] = {"refinement": name, "ms": 1e3 * float(np.mean(took))}
        if errors[name]:
            everything = np.concatenate(errors[name])
            means = np.array([e.mean(axis=0) for e in errors[name]])
            row["rms_px"] = float(np.sqrt(np.mean(everything**2)))
            row["common_to_a_board_px"] = float(np.sqrt(np.mean(means**2)))
            row["within_a_board_px"] = float(np.median([e.std(axis=0).mean() for e in errors[name]]))
            row["worst_px"] = float(np.linalg.norm(everything, axis=1).max())
        if rough[name]:
            row["scatter_real_px"] = float(np.median(rough[name]))
        rows.append(row)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    def text(value: Any) -> str:
        return (
            f"{value:.3f}"
            if isinstance(value, float) and abs(value) < 10
            else f"{value:.0f}"
            if isinstance(value, float)
            else str(value)
        )

    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [keys, ["---"] * len(keys), *([text(row[key]) if key in row else "" for key in keys] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


@click.command()
@click.argument("recordings", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option(
    "--finder", "names", multiple=True, type=click.Choice(list(FINDERS)), help="Only these.  [default: three]"
)
@click.option("--drawn", "n_drawn", default=40, show_default=True, help="Drawn images of each kind.")
@click.option("--without", "n_without", default=200, show_default=True, help="Images without a board.")
@click.option("--compared", default=40, show_default=True, help="Of these for all finders, the rest for the first.")
@click.option("--refinements", is_flag=True, help="Compare refinements on RECORDINGS too.")
@click.option("--json", "as_json", is_flag=True, help="Numbers instead of tables.")
def main(
    recordings: tuple[Path, ...],
    names: tuple[str, ...],
    n_drawn: int,
    n_without: int,
    compared: int,
    refinements: bool,
    as_json: bool,
) -> None:
    """Compare finders on drawn images and on RECORDINGS: folders that `simulate` made, or recordings without truth."""
    cv2.setNumThreads(1)
    finders = list(names) or ["rgbd-calib", "SB exhaustive", "quads"]
    rows = [study_finders(kind, drawn(kind, n_drawn), finders) for kind in LOOKS if n_drawn]
    loaded = {folder: load(folder) for folder in recordings}
    rows += [study_finders(folder.name, samples, finders) for folder, samples in loaded.items()]
    result = {"finders": rows, "without": study_without(n_without, finders, compared)}
    if refinements:
        result["refinements"] = study_refinements([sample for samples in loaded.values() for sample in samples])
    click.echo(
        json.dumps(result, indent=1) if as_json else "\n\n".join(table(part) for part in result.values() if part)
    )


if __name__ == "__main__":
    main()
