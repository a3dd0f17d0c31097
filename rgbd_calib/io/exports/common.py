"""What the export formats share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics, project
from rgbd_calib.types import Rig


@dataclass(frozen=True)
class Options:
    """How to export."""

    image_name: str = "{camera}.png"
    """Name of the image of each camera, in formats that list images."""
    undistorted: bool = False
    """The images are made by `correct --undistort`: pinholes without distortion."""
    suffix: str = ""
    """Suffix of the file, where it says which dialect is wanted."""

    def image_names(self, rig: Rig) -> dict[str, str]:
        """Image name by camera; raises ConfigError where the pattern is wrong or gives two cameras the same name."""
        try:
            names = {camera: self.image_name.format(camera=camera) for camera in rig.cameras}
        except (LookupError, ValueError, AttributeError):
            names = {}
        if len(set(names.values())) < len(rig.cameras):
            raise ConfigError(
                f"--image-name: '{self.image_name}' seen; a name with {{camera}} in it is needed, as '{{camera}}/0.png'"
            )
        return names


@dataclass(frozen=True)
class Export:
    """Texts by file name, the one name "" for a format of a single file; and what the format leaves out."""

    files: dict[str, str]
    notes: tuple[str, ...] = ()


def without_lens(rig: Rig) -> Rig:
    """The same rig with pinhole cameras, for images that `correct --undistort` made: same K, no distortion."""
    cameras = {
        name: replace(camera, intrinsics=replace(camera.intrinsics, distortion=(0.0,) * 5))
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def reach_px(lens: Intrinsics, kept: tuple[bool, ...] = (False,) * 5) -> float:
    """Farthest that a pixel of the image moves when only the `kept` of k1, k2, p1, p2, k3 are left, px."""
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, 17), np.linspace(0, lens.height - 1, 17))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    p_color = lens.rays(pixels)
    distortion = tuple(k if keep else 0.0 for k, keep in zip(lens.distortion, kept, strict=True))
    moved = project(np.array([lens.fx, lens.fy, lens.cx, lens.cy, *distortion]), p_color)
    return float(np.nanmax(np.linalg.norm(moved - pixels, axis=1)))


def refuse_lens(rig: Rig, to: str, carried: tuple[bool, ...]) -> None:
    """Raise ConfigError where a camera's distortion has a coefficient that the format does not carry."""
    names = ("k1", "k2", "p1", "p2", "k3")
    for camera, entry in rig.cameras.items():
        lost = [
            n for n, k, keep in zip(names, entry.intrinsics.distortion, carried, strict=True) if k != 0.0 and not keep
        ]
        if lost:
            raise ConfigError(
                f"{camera}: distortion {', '.join(lost)} seen, which {to} cannot carry; without it pixels are off by up "
                f"to {reach_px(entry.intrinsics, carried):.2g} px. Export with --undistorted, and feed {to} the images "
                "of `rgbd-calib correct --undistort`"
            )


def bias_note(rig: Rig, to: str) -> tuple[str, ...]:
    """A note where the rig has depth biases, which most formats have no place for."""
    biased = [name for name, camera in rig.cameras.items() if camera.depth_bias is not None]
    if not biased:
        return ()
    return (f"{to} has no place for the depth bias of {', '.join(biased)}: feed it the depth of `rgbd-calib correct`",)
