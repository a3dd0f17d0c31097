"""What commands make of seventeen kinds of spoiled input: one line for each, of this code or of an older one, for docs/reliability.md.

rgbd-calib simulate base --cameras 2 --frames 10 --intrinsic-views 10 --distances 0.8,1.2,1.8,2.6 --seed 1
python scripts/study_hazards.py base [--code FOLDER_OF_ANOTHER_VERSION] [--only 13]
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import numpy as np
from hazard_trial import Trial

ROOT = Path(__file__).parents[1]
Kind = Callable[[Trial], str]
KINDS: list[tuple[int, str, Kind]] = []


def kind(number: int, what: str) -> Callable[[Kind], Kind]:
    def add(function: Kind) -> Kind:
        KINDS.append((number, what, function))
        return function

    return add


def _depth_as(t: Trial, rename: Callable[[Path], Path], change: Callable[[Path, Path], None]) -> str:
    t.copy()
    for path in sorted((t.folder / "extrinsic").glob("*/depth/*.png")):
        new = rename(path)
        new.parent.mkdir(exist_ok=True)
        change(path, new)
        path.unlink()
    return t.calibrate()


def _float_tiff(old: Path, new: Path) -> None:
    cv2.imwrite(str(new), cv2.imread(str(old), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000)


@kind(1, "depth as float TIFF, metres")
def _tiff(t: Trial) -> str:
    return _depth_as(t, lambda p: p.with_suffix(".tiff"), _float_tiff)


@kind(1, "depth as `depth_000000.png`")
def _prefixed(t: Trial) -> str:
    return _depth_as(t, lambda p: p.with_name(f"depth_{p.name}"), shutil.copy)


@kind(1, "depth in `Depth/`")
def _capital(t: Trial) -> str:
    return _depth_as(t, lambda p: p.parents[1] / "Depth" / p.name, shutil.copy)


@kind(1, "depth as EXR")
def _exr(t: Trial) -> str:
    return _depth_as(t, lambda p: p.with_suffix(".exr"), shutil.copy)


@kind(2, "no bias recording")
def _no_walls(t: Trial) -> str:
    t.copy()
    return t.calibrate(bias=False)


def _magnified(image: np.ndarray) -> np.ndarray:
    A = np.array([[1.01, 0, -0.01 * 319.5], [0, 1.01, -0.01 * 239.5]])
    return np.asarray(cv2.warpAffine(image, A, image.shape[1::-1], flags=cv2.INTER_NEAREST))


@kind(3, "depth magnified by 1 % in all cameras")
def _scaled(t: Trial) -> str:
    t.copy()
    t.images(_magnified, "depth")
    return t.calibrate()


def _shifted_planes(image: np.ndarray) -> np.ndarray:
    return np.dstack([np.roll(image[..., 0], 1, axis=1), image[..., 1], np.roll(image[..., 2], -1, axis=1)])


@kind(3, "R and B shifted by a pixel against G")
def _planes(t: Trial) -> str:
    t.copy()
    t.images(_shifted_planes, "color")
    return t.calibrate()


def _with_rig(t: Trial) -> None:
    t.copy()
    t.calibrate()


@kind(4, "`correct` of depth at 6 m, bias known up to 2.6 m")
def _beyond(t: Trial) -> str:
    _with_rig(t)
    t.images(lambda z: np.full_like(z, 6000), "depth")
    return t.run("correct", "extrinsic", "--rig", "rig.yaml", "-o", "corrected", "--jobs", "1")


@kind(5, "`correct` of depth with 65535 for no data")
def _no_data(t: Trial) -> str:
    _with_rig(t)
    t.images(lambda z: np.where(z == 0, 65535, z).astype(np.uint16), "depth")
    said = t.run("correct", "extrinsic", "--rig", "rig.yaml", "-o", "corrected", "--jobs", "1")
    files = sorted((t.folder / "corrected").glob("*/depth/*.png"))
    most = max((int(cv2.imread(str(f), cv2.IMREAD_UNCHANGED).max()) for f in files), default=0)
    return f"{said}; largest depth written {most}"


@kind(6, "a recording without depth")
def _no_depth(t: Trial) -> str:
    t.copy()
    for camera in ("C1", "C2"):
        shutil.rmtree(t.folder / "extrinsic" / camera / "depth")
    return t.calibrate(bias=False)


@kind(7, "`import` of a TUM folder in millimetres")
def _tum(t: Trial) -> str:
    for name in ("rgb", "depth"):
        (t.folder / "tum" / name).mkdir(parents=True)
    for k, path in enumerate(sorted((t.base / "extrinsic" / "C1" / "color").glob("*.png"))):
        shutil.copy(path, t.folder / "tum" / "rgb" / f"{k}.png")
        shutil.copy(path.parents[1] / "depth" / path.name, t.folder / "tum" / "depth" / f"{k}.png")
    for name in ("rgb", "depth"):
        (t.folder / "tum" / f"{name}.txt").write_text("".join(f"{k}.0 {name}/{k}.png\n" for k in range(10)))
    said = t.run("import", "C1=tum", "-o", "out", "--board", "9x6", "--square", "0.06", "--two-sided", "0.006")
    dataset = t.folder / "out" / "dataset.yaml"
    scale = re.search(r"depth_scale: (\S+)", dataset.read_text()) if dataset.exists() else None
    return f"{said}; depth_scale {scale[1] if scale else 'none'}"


@kind(8, "`registered: false` in dataset.yaml")
def _key(t: Trial) -> str:
    t.copy()
    t.edit("extrinsic/dataset.yaml", "depth_registered: true", "registered: false")
    return t.calibrate()


@kind(8, "`scale: 0.0002` under a camera")
def _camera_key(t: Trial) -> str:
    t.copy()
    t.edit("extrinsic/dataset.yaml", "(serial: simulated-C1)", r"\1\n    scale: 0.0002")
    return t.calibrate()


@kind(9, "C1 numbered from 000000, C2 from 100000")
def _stems(t: Trial) -> str:
    t.copy()
    for path in sorted((t.folder / "extrinsic" / "C2").glob("*/*.png")):
        path.rename(path.with_name(f"1{path.name[1:]}"))
    return t.calibrate()


@kind(10, "C2 dim, noisy and blurred")
def _dim(t: Trial) -> str:
    rng = np.random.default_rng(0)

    def change(image: np.ndarray) -> np.ndarray:
        soft = cv2.GaussianBlur(image, (0, 0), 1.2) * 0.35
        return np.clip(soft + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)

    t.copy()
    t.images(change, "color", "C2")
    return t.calibrate()


@kind(11, "squares counted in place of corners (10x7)")
def _counted(t: Trial) -> str:
    t.copy()
    t.edit("extrinsic/dataset.yaml", "cols: 9\n  rows: 6", "cols: 10\n  rows: 7")
    return t.calibrate(bias=False, close=False)


@kind(11, "square in millimetres")
def _millimetres(t: Trial) -> str:
    t.copy()
    t.edit("extrinsic/dataset.yaml", "square: 0.06", "square: 60")
    return t.calibrate(bias=False, close=False)


@kind(12, "depth 25 mm beside colour, stated as registered")
def _unregistered(t: Trial) -> str:
    t.copy()

    def change(z: np.ndarray) -> np.ndarray:
        out = np.zeros_like(z)
        v, u = np.nonzero(z)
        at = np.rint(u + 25 * 550 / z[v, u]).astype(int)
        ok = at < z.shape[1]
        out[v[ok], at[ok]] = z[v[ok], u[ok]]
        return out

    t.images(change, "depth")
    return t.calibrate()


@kind(12, "square stated 1 % too large")
def _square(t: Trial) -> str:
    t.copy()
    t.edit("extrinsic/dataset.yaml", "square: 0.06", "square: 0.0606")
    return t.calibrate(close=False)


def _left(t: Trial, folder: str) -> str:
    return "kept" if (t.folder / folder).exists() else "**destroyed**"


@kind(13, "`simulate HOLIDAY --overwrite`, a folder of other files")
def _holiday(t: Trial) -> str:
    (t.folder / "holiday").mkdir()
    (t.folder / "holiday" / "letter.txt").write_text("mine")
    said = t.run(
        "simulate",
        "holiday",
        "--cameras",
        "2",
        "--frames",
        "1",
        "--intrinsic-views",
        "0",
        "--distances",
        "",
        "--overwrite",
        "--jobs",
        "1",
    )
    return f"{said}; letter {_left(t, 'holiday/letter.txt')}"


@kind(13, "`correct X -o X --overwrite`")
def _onto_itself(t: Trial) -> str:
    _with_rig(t)
    said = t.run("correct", "extrinsic", "--rig", "rig.yaml", "-o", "extrinsic", "--overwrite", "--jobs", "1")
    return f"{said}; images {_left(t, 'extrinsic/C1/color/000000.png')}"


@kind(13, "`-o` a FIFO, with `--overwrite`")
def _fifo_out(t: Trial) -> str:
    t.copy()
    os.mkfifo(t.folder / "out.csv")
    said = t.run("detect", "extrinsic", "-o", "out.csv", "--overwrite", "--jobs", "1")
    return f"{said}; FIFO {'kept' if (t.folder / 'out.csv').is_fifo() else '**replaced**'}"


@kind(14, "a FIFO as an image")
def _fifo(t: Trial) -> str:
    path = t.copy() / "C2" / "color" / "000003.png"
    path.unlink()
    os.mkfifo(path)
    return t.calibrate()


@kind(14, "`--config /dev/zero`")
def _endless(t: Trial) -> str:
    t.copy()
    return t.calibrate("--config", "/dev/zero")


@kind(15, "a camera called `kam\\xe9ra` (Latin 1)")
def _latin(t: Trial) -> str:
    root = t.copy()
    os.rename(root / "C2", os.fsencode(root) + b"/kam\xe9ra")
    for name in ("intrinsic", "depth_bias"):
        t.copy(name)
    t.edit("extrinsic/dataset.yaml", "C2:", "kamera:")
    return t.run("calibrate", "extrinsic", "-o", "rig.yaml", "--jobs", "1")


@kind(15, "`-o` a name that is not UTF-8")
def _latin_out(t: Trial) -> str:
    t.copy()
    name = os.fsdecode(b"r\xe9sultat.yaml")
    said = t.calibrate()
    shutil.copy(t.folder / "rig.yaml", t.folder / name)
    return f"{said[:60]}; `report`: " + t.run("report", name, "-o", "page")


@kind(17, "`schema rig | head -1`")
def _closed(t: Trial) -> str:
    command = f"set -o pipefail; {sys.executable} -m rgbd_calib schema rig 2>err | head -1 >/dev/null; echo ${{PIPESTATUS[0]}}"
    status = subprocess.run(
        ["bash", "-c", command], cwd=t.folder, env=t.env, capture_output=True, text=True, check=False
    )
    return f"{status.stdout.strip()}: stderr {(t.folder / 'err').read_text().strip()[-120:] or 'empty'}"


@kind(17, "`OMP_NUM_THREADS` 1 and 2: equal bytes")
def _threads(t: Trial) -> str:
    t.copy()
    found = []
    for n in ("1", "2"):
        t.env["OMP_NUM_THREADS"] = t.env["OPENBLAS_NUM_THREADS"] = n
        t.calibrate()
        text = (t.folder / "rig.yaml").read_text()
        found.append(re.findall(r"T_world_color:\n(?:.*\n){4}", text))
    return "poses equal" if found[0] == found[1] else "**poses differ**"


@kind(16, "the preview's server: Host, token, idle connections (`pytest tests/io/test_serving.py`)")
def _serving(t: Trial) -> str:
    tests = Path(t.env["PYTHONPATH"]) / "tests" / "io" / "test_serving.py"
    if not tests.exists():
        return "not run: this version has no such tests"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", str(tests)],
        env=t.env,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip().splitlines()[-1]


@kind(17, "a bag of zeros, 20 GB")
def _endless_bag(t: Trial) -> str:
    with (t.folder / "huge.bag").open("wb") as stream:
        stream.truncate(20 << 30)
    return t.run("import", "huge.bag", "-o", "out")


@click.command()
@click.argument("base", type=click.Path(exists=True, path_type=Path))
@click.option("--code", type=click.Path(exists=True, path_type=Path), default=ROOT, help="Version to run.")
@click.option("--only", type=int, multiple=True)
def main(base: Path, code: Path, only: tuple[int, ...]) -> None:
    click.echo("| kind | what | outcome |\n|---|---|---|")
    for number, what, function in KINDS:
        if only and number not in only:
            continue
        with tempfile.TemporaryDirectory() as folder:
            said = function(Trial(base.resolve(), Path(folder), code.resolve()))
            click.echo(f"| {number} | {what} | {said.replace(folder + '/', '')} |")


if __name__ == "__main__":
    main()
