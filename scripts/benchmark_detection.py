"""Compares ways of finding a board and of refining its corners, on simulated recordings whose corners are known.

Finders: how many of the boards that are whole in the image each finds, how many it finds in a wrong place, and the time
where there is a board and where there is none (the same images, the board painted over). Refinements, all from the same
start, of the boards that OpenCV's exhaustive search finds: the error, and how much of it a whole board has in common
(independent errors leave RMS / sqrt(corners)). Recordings without true corners count with the boards found, and with
the scatter about a homography with a smooth part.
"""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np

from rgbd_calib.io.recording import open_recording
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


def load(folder: Path) -> list[dict[str, Any]]:
    """Images of a simulated folder or of one recording, with the true corners of each whole board."""
    truth: dict[tuple[str, ...], dict[str, dict[int, tuple[float, float, bool]]]] = defaultdict(
        lambda: defaultdict(dict)
    )
    if (folder / "true_corners.csv").exists():
        with (folder / "true_corners.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                key, at = (row["recording"], row["camera"], row["frame"]), (float(row["u_px"]), float(row["v_px"]))
                truth[key][row["face"]][int(row["feature"])] = (*at, row["visible"] == "1")
    recordings = [folder / name for name in ("extrinsic", "intrinsic")] if truth else [folder]
    images = []
    for path in recordings:
        recording = open_recording(path)
        assert recording.board is not None
        for camera, files in recording.color_files.items():
            for frame in files:
                gray = cv2.cvtColor(recording.color(camera, frame), cv2.COLOR_BGR2GRAY)
                faces = truth.get((path.name, camera, frame), {}).values()
                whole = [f for f in faces if len(f) == recording.board.n_corners and all(c[2] for c in f.values())]
                true_px = np.array([whole[0][i][:2] for i in sorted(whole[0])]) if whole else None
                images.append({"gray": gray, "board": recording.board, "true": true_px, "known": bool(truth)})
    return images


def nearest_order(corners: np.ndarray, true_px: np.ndarray, board: Board) -> np.ndarray:
    """True corners in the finder's order: finders turn and mirror boards."""
    grid = true_px.reshape(board.rows, board.cols, 2)
    orders = [g.reshape(-1, 2) for g in (grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1])]
    return min(orders, key=lambda order: float(np.nanmean(np.abs(corners - order))))


def painted_over(image: dict[str, Any]) -> np.ndarray:
    """The image without its board."""
    gray, true_px = image["gray"].copy(), image["true"]
    around = (true_px - true_px.mean(axis=0)) * 1.5 + true_px.mean(axis=0)
    cv2.fillConvexPoly(gray, cv2.convexHull(around.astype(np.int32)), int(np.median(gray)))
    return gray


def study_finders(images: list[dict[str, Any]], names: list[str]) -> list[dict[str, Any]]:
    rows = []
    known, real = [i for i in images if i["true"] is not None], [i for i in images if not i["known"]]
    for name in names:
        found = wrong = elsewhere = 0
        seconds: dict[str, list[float]] = {"board": [], "none": []}
        for image in known:
            begin = time.process_time()
            corners = FINDERS[name](image["gray"], image["board"])
            seconds["board"].append(time.process_time() - begin)
            if corners is not None:
                off = np.abs(corners - nearest_order(corners, image["true"], image["board"]))
                grid = image["true"].reshape(image["board"].rows, image["board"].cols, 2)
                side = min(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min() for a in (0, 1))
                good = bool(np.nanmax(off) < WRONG_SQUARES * side)
                found, wrong = found + good, wrong + (not good)
        for image in known[::3]:
            gray = painted_over(image)
            begin = time.process_time()
            FINDERS[name](gray, image["board"])
            seconds["none"].append(time.process_time() - begin)
        begin = time.process_time()
        elsewhere = sum(FINDERS[name](image["gray"], image["board"]) is not None for image in real)
        row = {"finder": name, "found": found, "of": len(known), "wrong": wrong}
        row |= {f"ms_{kind}": 1e3 * float(np.mean(values)) for kind, values in seconds.items() if values}
        if real:
            row |= {"found_real": elsewhere, "ms_real": 1e3 * (time.process_time() - begin) / len(real)}
        rows.append(row)
    return rows


def study_refinements(images: list[dict[str, Any]]) -> list[dict[str, Any]]:
    errors: dict[str, list[np.ndarray]] = defaultdict(list)
    rough: dict[str, list[float]] = defaultdict(list)
    seconds: dict[str, list[float]] = defaultdict(list)
    for image in images:
        board, gray = image["board"], image["gray"]
        start = FINDERS["SB exhaustive"](gray, board)
        if (
            start is None
            or (image["known"] and image["true"] is None)
            or not find_checkerboard(gray, board, DetectParams())
        ):
            continue
        grid = np.stack(np.divmod(np.arange(board.n_corners), board.cols)[::-1], axis=1).astype(float)
        for name, (corners, took) in refinements(gray, grid, start).items():
            seconds[name].append(took)
            if image["known"]:
                errors[name].append(corners - nearest_order(corners, image["true"], board))
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

    cells = [list(rows[0]), *([text(value) for value in row.values()] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in [cells[0], ["---"] * len(cells[0]), *cells[1:]])


@click.command()
@click.argument("recordings", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option("--finder", "names", multiple=True, type=click.Choice(list(FINDERS)), help="Only these.  [default: all]")
@click.option("--json", "as_json", is_flag=True, help="Numbers instead of tables.")
def main(recordings: tuple[Path, ...], names: tuple[str, ...], as_json: bool) -> None:
    """Compare finders and refinements on RECORDINGS: folders that `simulate` made, or recordings without truth."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        if not recordings:
            from rgbd_calib.cli.simulate import command

            command(
                [
                    scratch,
                    "--overwrite",
                    "--cameras",
                    "2",
                    "--frames",
                    "12",
                    "--intrinsic-views",
                    "6",
                    "--distances",
                    "1,2",
                ],
                standalone_mode=False,
            )
            recordings = (Path(scratch),)
        images = [image for folder in recordings for image in load(folder)]
        result = {
            "finders": study_finders(images, list(names) or list(FINDERS)),
            "refinements": study_refinements(images),
        }
    click.echo(json.dumps(result, indent=1) if as_json else "\n\n".join(table(rows) for rows in result.values()))


if __name__ == "__main__":
    main()
