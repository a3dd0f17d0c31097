"""Ways to spoil the files of a real recording, for `study_silent_failures.py --recording`: without truth, against the unspoiled result."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.types import Rig

Image = np.ndarray


class Files:
    """A copy of a recording; its cameras by number."""

    def __init__(self, recording: Path, folder: Path) -> None:
        self.folder = Path(shutil.copytree(recording, folder))
        self.cameras = sorted(path.name for path in self.folder.iterdir() if path.is_dir())

    def of(self, camera: int, kind: str) -> list[Path]:
        return sorted((self.folder / self.cameras[camera] / kind).iterdir())

    def images(self, kind: str, change: Callable[[Image], Image], *cameras: int) -> None:
        """Change the images of these cameras, or of all; colour is written without loss."""
        for camera in cameras or range(len(self.cameras)):
            for path in self.of(camera, kind):
                image = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
                path.unlink()
                cv2.imwrite(str(path.with_suffix(".png")), image)

    def both(self, change: Callable[[Image], Image], camera: int) -> None:
        for kind in ("color", "depth"):
            self.images(kind, change, camera)

    def edit(self, old: str, new: str) -> None:
        path = self.folder / "dataset.yaml"
        text, n = re.subn(old, new, path.read_text())
        assert n, old
        path.write_text(text)

    def reorder(self, camera: int, kind: str, order: Callable[[int], int]) -> None:
        """Give image k the content of image order(k)."""
        paths = self.of(camera, kind)
        kept = [path.read_bytes() for path in paths]
        for k, path in enumerate(paths):
            path.write_bytes(kept[order(k) % len(kept)])

    def swap(self, kind: str) -> None:
        """The folders of the last two cameras."""
        a, b = (self.folder / name / kind for name in self.cameras[-2:])
        a.rename(self.folder / "aside")
        b.rename(a)
        (self.folder / "aside").rename(b)


@dataclass(frozen=True)
class Spoiling:
    apply: Callable[[Files], object]
    says: str = ""
    """Words that name the cause, where it should not be absorbed."""
    changes: str = ""
    """What is really another in the second camera (all: in all cameras) and so not compared: depth, lens."""
    everywhere: bool = False
    turned_deg: float = 0.0
    """By which the colour camera really turns about its axis, anticlockwise in the image."""


def _blurred(sigma_px: float) -> Callable[[Image], Image]:
    return lambda image: cv2.GaussianBlur(image, (0, 0), sigma_px)


def _moved(by: tuple[float, float]) -> Callable[[Image], Image]:
    return lambda image: cv2.warpAffine(
        image, np.float64([[1, 0, by[0]], [0, 1, by[1]]]), image.shape[1::-1], flags=cv2.INTER_NEAREST
    )


def _cropped(image: Image) -> Image:
    h, w = image.shape[:2]
    inner = image[h // 20 : h - h // 20, w // 20 : w - w // 20]
    return cv2.resize(inner, (w, h), interpolation=cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_LINEAR)


def _resized(image: Image) -> Image:
    return cv2.resize(
        image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_AREA
    )


def _scaled(factor: float) -> Callable[[Image], Image]:
    return lambda image: np.clip(np.rint(image * factor), 0, 65535).astype(image.dtype)


def _noisy(sigma: float) -> Callable[[Image], Image]:
    rng = np.random.default_rng(0)
    return lambda image: np.clip(image + rng.normal(0, sigma, image.shape), 0, 255).astype(np.uint8)


def _offset(mm: int) -> Callable[[Image], Image]:
    return lambda depth: np.where(depth > 0, depth + mm, 0).astype(np.uint16)


def _stepped(step: int) -> Callable[[Image], Image]:
    return lambda depth: (depth // step * step).astype(np.uint16)


def _along_ray(depth: Image) -> Image:
    h, w = depth.shape
    v, u = np.mgrid[:h, :w]
    return np.rint(depth * np.sqrt(1 + ((u - w / 2) / 610) ** 2 + ((v - h / 2) / 610) ** 2)).astype(np.uint16)


def _holes(depth: Image) -> Image:
    out = depth.copy()
    out[:, : out.shape[1] // 2] = 0
    return out


def _decimated(depth: Image) -> Image:
    h, w = depth.shape
    return cv2.resize(depth[::4, ::4], (w, h), interpolation=cv2.INTER_NEAREST)


def _filled(depth: Image) -> Image:
    """Holes take the farthest value around them, as librealsense's filter does."""
    return np.where(depth > 0, depth, cv2.dilate(depth, np.ones((31, 31), np.uint8)))


def _letterboxed(image: Image) -> Image:
    """Squeezed to three quarters of its height, with black bars."""
    h, w = image.shape[:2]
    inner = cv2.resize(image, (w, h * 3 // 4), interpolation=cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_LINEAR)
    out = np.zeros_like(image)
    out[h // 8 : h // 8 + inner.shape[0]] = inner
    return out


def _interlaced(image: Image) -> Image:
    out = image.copy()
    out[::2] = np.roll(image[::2], 2, axis=1)
    return out


def _turned(deg: float) -> Callable[[Image], Image]:
    def change(image: Image) -> Image:
        h, w = image.shape[:2]
        between = cv2.INTER_CUBIC if image.ndim == 3 else cv2.INTER_NEAREST  # steps of half a pixel would move corners
        return cv2.warpAffine(image, cv2.getRotationMatrix2D((w / 2, h / 2), deg, 1), (w, h), flags=between)

    return change


def _gamma(image: Image) -> Image:
    return np.rint(255 * (image / 255.0) ** 2.2).astype(np.uint8)


def _disparity(depth: Image) -> Image:
    return np.where(depth > 0, 3e7 / np.maximum(depth, 1) / 32, 0).clip(0, 65535).astype(np.uint16)


def _sparse(value: int) -> Callable[[Image], Image]:
    return lambda depth: np.where(depth > 0, depth, value).astype(np.uint16)


def _lost_frame(files: Files) -> None:
    """The fifth frame of the second camera is lost, and those after it move up."""
    for kind in ("color", "depth"):
        paths = files.of(1, kind)
        kept = [path.read_bytes() for path in paths]
        for path, data in zip(paths[5:-1], kept[6:], strict=True):
            path.write_bytes(data)
        paths[-1].unlink()


def _unpadded(files: Files) -> None:
    for kind in ("color", "depth"):
        for path in files.of(1, kind):
            path.rename(path.with_name(f"{int(path.stem)}{path.suffix}"))


def _of_late(kind: str, change: Callable[[Image], Image]) -> Callable[[Files], object]:
    def apply(files: Files) -> None:
        for path in files.of(1, kind)[8:]:
            image = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            path.unlink()
            cv2.imwrite(str(path.with_suffix(".png")), image)

    return apply


def _without_depth(files: Files, *cameras: int) -> None:
    for camera in cameras:
        shutil.rmtree(files.folder / files.cameras[camera] / "depth")


def _renamed(files: Files) -> None:
    """Frames of the second camera begin at 100."""
    for kind in ("color", "depth"):
        for path in reversed(files.of(1, kind)):
            path.rename(path.with_name(f"{int(path.stem) + 100:03d}{path.suffix}"))


def _copied(files: Files) -> None:
    """Every frame three times."""
    for camera in range(len(files.cameras)):
        for kind in ("color", "depth"):
            for path in files.of(camera, kind):
                for k in (1, 2):
                    shutil.copyfile(path, path.with_name(f"{path.stem}_{k}{path.suffix}"))


def _kept(wanted: Callable[[int], bool]) -> Callable[[Files], object]:
    def apply(files: Files) -> None:
        for camera in range(len(files.cameras)):
            for kind in ("color", "depth"):
                for k, path in enumerate(files.of(camera, kind)):
                    if not wanted(k):
                        path.unlink()

    return apply


def _both_orders(order: Callable[[int], int]) -> Callable[[Files], object]:
    return lambda files: [files.reorder(1, kind, order) for kind in ("color", "depth")]


SQUARE = r"square: [\d.]+"
SPOILINGS: dict[str, Spoiling] = {
    "square 2.5 % too large": Spoiling(lambda f: f.edit(SQUARE, "square: 0.025625"), "squares are"),
    "square 10 % too large": Spoiling(lambda f: f.edit(SQUARE, "square: 0.0275"), "squares are"),
    "square in cm": Spoiling(lambda f: f.edit(SQUARE, "square: 2.5"), "2.5 cm write 0.025"),
    "cols and rows exchanged": Spoiling(lambda f: f.edit("cols: 10\n  rows: 6", "cols: 6\n  rows: 10")),
    "squares counted for corners": Spoiling(lambda f: f.edit("cols: 10\n  rows: 6", "cols: 11\n  rows: 7"), "10 x 6|10x6"),
    "one row too few stated": Spoiling(lambda f: f.edit("rows: 6", "rows: 5"), "10 x 6|10x6|rows"),
    "depth_scale ten times too large": Spoiling(lambda f: f.edit("depth_scale: 0.001", "depth_scale: 0.01"), "depth_scale"),
    "depth_scale 0.00025": Spoiling(lambda f: f.edit("depth_scale: 0.001", "depth_scale: 0.00025"), "depth_scale"),
    "depth of one camera in 0.25 mm": Spoiling(lambda f: f.images("depth", _scaled(4), 1), "cam1: depth_scale"),
    "depth of one camera 3 % too long": Spoiling(lambda f: f.images("depth", _scaled(1.03), 1), "", "depth"),
    "depth of all cameras 3 % too long": Spoiling(lambda f: f.images("depth", _scaled(1.03)), "squares are", "depth", True),
    "depth of one camera 10 mm too long": Spoiling(lambda f: f.images("depth", _offset(10), 1), "", "depth"),
    "depth of one camera from frame 008 on 10 mm too long": Spoiling(_of_late("depth", _offset(10)), "cam1's depth"),
    "depth of one camera along its rays": Spoiling(lambda f: f.images("depth", _along_ray, 1), "along", "depth"),
    "depth of one camera in steps of 5 mm": Spoiling(lambda f: f.images("depth", _stepped(5), 1), "", "depth"),
    "depth of one camera 6 px aside": Spoiling(lambda f: f.images("depth", _moved((6, 0)), 1), "", "depth"),
    "depth of one camera mirrored": Spoiling(lambda f: f.images("depth", lambda i: i[:, ::-1], 1), "cam1"),
    "depth of one camera turned by 180 deg": Spoiling(lambda f: f.images("depth", lambda i: i[::-1, ::-1], 1), "cam1"),
    "depth of one camera in 8 bits": Spoiling(
        lambda f: f.images("depth", lambda i: (i // 16).clip(0, 255).astype(np.uint8), 1), "cam1.*8|depth"
    ),
    "depth of one camera empty": Spoiling(lambda f: f.images("depth", lambda i: 0 * i, 1), "cam1: depth on the board"),
    "depth of one camera missing": Spoiling(lambda f: _without_depth(f, 1), "", "depth"),
    "depth of all cameras missing": Spoiling(lambda f: _without_depth(f, 0, 1, 2), "depth"),
    "depth of one camera missing in its left half": Spoiling(lambda f: f.images("depth", _holes, 1)),
    "depth images of two cameras exchanged": Spoiling(lambda f: f.swap("depth"), "depth"),
    "depth of one camera that of the frame before": Spoiling(lambda f: f.reorder(1, "depth", lambda k: k - 1), "depth"),
    "folders of two cameras exchanged for colour": Spoiling(lambda f: f.swap("color"), "depth|relative pose|cam1|cam2"),
    "frames of one camera off by one": Spoiling(_both_orders(lambda k: k - 1), "instant|relative pose"),
    "frames of one camera in reverse order": Spoiling(_both_orders(lambda k: -1 - k), "instant|relative pose"),
    "two frames of one camera exchanged": Spoiling(_both_orders(lambda k: {3: 4, 4: 3}.get(k, k))),
    "frames of one camera named from 100 on": Spoiling(_renamed, "no frame has the name"),
    "each frame three times": Spoiling(_copied, "places only"),
    "half of the frames": Spoiling(_kept(lambda k: k % 2 == 0)),
    "one camera's images mirrored": Spoiling(lambda f: f.both(lambda i: i[:, ::-1], 1), "mirror"),
    "one camera's images on their side": Spoiling(lambda f: f.both(lambda i: np.rot90(i).copy(), 1), "640x480"),
    "one camera's images cropped by 5 % and enlarged": Spoiling(lambda f: f.both(_cropped, 1), "", "lens depth"),
    "one camera's images of half the size": Spoiling(lambda f: f.both(_resized, 1), "640x480"),
    "one camera's images cropped by 5 % and enlarged from frame 008 on": Spoiling(_of_late("color", _cropped), "cam1"),
    "one camera's colour 3 px aside": Spoiling(lambda f: f.images("color", _moved((3, 0)), 1), "", "lens depth"),
    "one camera's images blurred by 2 px": Spoiling(lambda f: f.images("color", _blurred(2), 1)),
    "one camera's images blurred by 4 px": Spoiling(lambda f: f.images("color", _blurred(4), 1)),
    "one camera's exposure an eighth": Spoiling(lambda f: f.images("color", _scaled(0.125), 1)),
    "one camera's images overexposed": Spoiling(lambda f: f.images("color", lambda i: cv2.convertScaleAbs(i, alpha=2.0), 1)),
    "one camera's images noisy by 20 levels": Spoiling(lambda f: f.images("color", _noisy(20), 1)),
    "one camera's images of poor JPEG": Spoiling(
        lambda f: f.images("color", lambda i: cv2.imdecode(cv2.imencode(".jpg", i, [1, 15])[1], 1), 1)
    ),
    "one camera's red and blue exchanged": Spoiling(lambda f: f.images("color", lambda i: i[..., ::-1], 1)),
    "registered: false": Spoiling(lambda f: f.edit("depth_registered: true", "registered: false"), "depth_registered"),
    "depth_registered: false": Spoiling(lambda f: f.edit("depth_registered: true", "depth_registered: false"), "register"),
    "synchronous: false": Spoiling(lambda f: f.edit("depth_scale", "synchronous: false\ndepth_scale"), "stamps|synchronous"),
    "a frame of one camera lost, those after it moved up": Spoiling(_lost_frame, "instant|relative pose|cam1"),
    "frames of one camera without leading zeros": Spoiling(_unpadded),
    "depth of one camera decimated by four and enlarged": Spoiling(lambda f: f.images("depth", _decimated, 1), "", "depth"),
    "depth of one camera with its holes filled": Spoiling(lambda f: f.images("depth", _filled, 1), "", "depth"),
    "depth of one camera averaged over 25 px": Spoiling(lambda f: f.images("depth", _blurred(25), 1), "", "depth"),
    "depth of one camera as disparity": Spoiling(lambda f: f.images("depth", _disparity, 1), "cam1"),
    "depth of one camera with its bytes exchanged": Spoiling(lambda f: f.images("depth", lambda i: i.byteswap(), 1), "cam1|depth"),
    "depth of one camera as a picture of three channels": Spoiling(
        lambda f: f.images("depth", lambda i: cv2.applyColorMap((i // 16).clip(0, 255).astype(np.uint8), 2), 1), "channel"
    ),
    "depth of one camera with 65535 for none": Spoiling(lambda f: f.images("depth", _sparse(65535), 1), "", "depth"),
    "depth of one camera clipped at 0.9 m": Spoiling(
        lambda f: f.images("depth", lambda i: np.minimum(i, 900), 1), "clipped|cam1"
    ),
    "one camera's images letterboxed": Spoiling(lambda f: f.both(_letterboxed, 1), "", "lens depth"),
    "one camera's images interlaced": Spoiling(lambda f: f.images("color", _interlaced, 1), "", "lens"),
    "one camera's colour turned by 2 deg about its middle": Spoiling(
        lambda f: f.images("color", _turned(2), 1), "", "lens depth", turned_deg=2.0
    ),
    "one camera's images without gamma": Spoiling(lambda f: f.images("color", _gamma, 1)),
    "one camera's images inverted": Spoiling(lambda f: f.images("color", lambda i: 255 - i, 1)),
    "one camera's images grey": Spoiling(lambda f: f.images("color", lambda i: i[..., 1], 1)),
    "one camera's colour black in half of the frames": Spoiling(_of_late("color", lambda i: 0 * i)),
    "one camera's colour moved by 10 px from frame 008 on": Spoiling(_of_late("color", _moved((10, 0))), "cam1"),
    "one camera's images turned by 2 deg from frame 008 on": Spoiling(
        lambda f: [_of_late(kind, _turned(2))(f) for kind in ("color", "depth")], "cam1 moved|cam1"
    ),
    "one camera's images of half the size in half of the frames": Spoiling(_of_late("color", _resized), "640x480"),
}  # fmt: skip


def with_unspoiled(now: Rig, base: Rig, spoiling: Spoiling) -> Rig:
    """What a spoiling really changes is as in the unspoiled rig, so that its pixels and depth can be compared."""
    cameras = dict(now.cameras)
    for k, name in enumerate(base.cameras):
        if name in cameras and spoiling.changes and (spoiling.everywhere or k == 1):
            own, true = cameras[name], base.cameras[name]
            depth = {"depth_bias": true.depth_bias, "depth_field": true.depth_field, "depth_camera": true.depth_camera}
            lens = {"intrinsics": true.intrinsics} if "lens" in spoiling.changes else {}
            turn = se3.make(so3.exp(np.array([0.0, 0.0, -np.deg2rad(spoiling.turned_deg)])), np.zeros(3))
            cameras[name] = replace(own, T_world_color=own.T_world_color @ turn, **depth, **lens)
    return replace(now, cameras=cameras)
