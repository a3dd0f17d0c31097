"""What the export formats share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics, LensName
from rgbd_calib.geometry.lens_fit import as_model
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
    max_px: float = 0.05
    """A lens that the format does not have may be off by so much, px, after it was fitted to one that it has."""

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
        name: replace(camera, intrinsics=camera.intrinsics.without_distortion()) for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Of OpenCV's lens, in its order."""
FISHEYE = ("k1", "k2", "k3", "k4")


def coefficients(lens: Intrinsics) -> dict[str, float]:
    """The lens's coefficients by name; those that it does not have are not there."""
    return dict(zip(FISHEYE if lens.model == "kannala_brandt" else COEFFICIENTS, lens.distortion, strict=False))


@dataclass(frozen=True)
class FormatLens:
    """A lens that a format has: the first `n` coefficients of a model."""

    model: LensName
    n: int
    name: str
    """As the format calls it."""

    def holds(self, lens: Intrinsics) -> bool:
        """The lens is one of these as it is."""
        return lens.model == self.model and not any(lens.distortion[self.n :])


def with_carried_lenses(rig: Rig, to: str, carried: Sequence[FormatLens], max_px: float) -> tuple[Rig, tuple[str, ...]]:
    """The rig with lenses that the format has, and a note for each that was fitted: refitted over its image.

    Raises
    ------
    ConfigError
        The nearest lens of the format is off by more than `max_px`.
    """
    cameras, notes = dict(rig.cameras), []
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics
        if any(own.holds(lens) for own in carried):
            continue
        try:
            fits = [(as_model(lens, own.model, own.n), own) for own in carried]
        except ValueError as error:
            raise ConfigError(f"{name}: {error}; {to} needs another lens. Calibrate it with `--lens fisheye`") from None
        best, own = min(fits, key=lambda fit: fit[0].max_px)
        off = f"{best.max_px:.2g} px at most, {best.rms_px:.2g} px RMS"
        if not best.max_px <= max_px:
            lost = [k for k, value in coefficients(lens).items() if value != 0.0]
            raise ConfigError(
                f"{name}: lens {lens.model} with {', '.join(lost)} seen, which {to} does not have; its nearest, {own.name}, is "
                f"off by {off} over the image, {max_px:g} px allowed. Allow it with --max-px, or export with --undistorted and "
                f"feed {to} the images of `rgbd-calib correct --undistort`"
            )
        notes.append(f"{name}: lens {lens.model} refitted as {own.name}: off by {off}")
        cameras[name] = replace(camera, intrinsics=best.intrinsics)
    return replace(rig, cameras=cameras), tuple(notes)


def bias_note(rig: Rig, to: str) -> tuple[str, ...]:
    """A note where the rig has depth biases, which most formats have no place for."""
    biased = [name for name, camera in rig.cameras.items() if camera.depth_bias is not None]
    if not biased:
        return ()
    return (f"{to} has no place for the depth bias of {', '.join(biased)}: feed it the depth of `rgbd-calib correct`",)
