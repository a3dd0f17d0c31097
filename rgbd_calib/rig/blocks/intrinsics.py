"""The lenses: focal lengths, centre and distortion of each camera."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Fault, Kind, Scope
from rgbd_calib.rig.setup import BundleParams, CameraPrior
from rgbd_calib.rig.sight import Look

_OPENCV = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tilt_x", "tilt_y"]
_FISHEYE = ["k1", "k2", "k3", "k4"]
_LEAST_SD = 1e-9


class IntrinsicsBlock(Block):
    """fx, fy, cx, cy and the lens's coefficients, (C, 4 + the longest); those that a shorter lens lacks are held at 0."""

    name = "intrinsics"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.PIXEL, Kind.DEPTH})
    over_time = Fault(
        "lens over time",
        lambda t: (
            f"{t.camera}'s intrinsics (or its orientation) changed at frame {t.frame}: focal length {t.estimate[0]:+.1f} px, "
            f"centre {t.estimate[2]:+.1f}, {t.estimate[3]:+.1f} px, or {t.mm} at the board"
        ),
        "Switch its autofocus and zoom off, and record again",
        parameters=4,
    )
    between_recordings = Fault(
        "lens between recordings",
        lambda t: (
            f"{t.camera}'s intrinsics in the rig's recording differ from those of its intrinsic recording: "
            f"fx {-t.estimate[0]:+.1f}, fy {-t.estimate[1]:+.1f}, centre {-t.estimate[2]:+.1f}, {-t.estimate[3]:+.1f} px, or "
            f"{t.mm} at the board"
        ),
        "Another camera's images, another resolution or crop, rotated images, or another focus. Check the names, and "
        "record the intrinsics again with the camera as it is in the rig",
        parameters=4,
    )
    known = Fault(
        "lens given",
        lambda t: f"{t.camera}'s intrinsics differ from the given ones, by {t.mm} RMS at the board",
        "Check that the intrinsics are of this camera and image size; record them again",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        longest = max((prior.intrinsics for prior in self.setup.priors), key=lambda lens: len(lens.distortion))
        names = _OPENCV if longest.model == "opencv" else _FISHEYE
        first = ("focal length fx", "focal length fy", "principal point cx", "principal point cy")
        return (*first, *names[: len(longest.distortion)])

    def start(self) -> FloatArray:
        return self.setup.intrinsics

    def prior(self) -> BlockPrior:
        own = self.setup
        sd, free = np.ones((self.sets, self.n)), np.zeros((self.sets, self.n), bool)
        assumed = np.zeros((self.sets, self.n), bool)
        for i, prior in enumerate(own.priors):
            n = len(prior.intrinsics.vector)
            sd[i, :n] = _standard_deviations(prior, own.params)
            rows = own.obs.has_pixel if prior.mount is None else own.obs.has_depth
            seen = bool(np.any(rows[own.obs.camera == i]))
            free[i, :n] = own.params.free_intrinsics and seen and prior.held == "nothing"
            if prior.intrinsics.model == "opencv" and n > 8:
                free[i, 8] &= own.params.free_k3 or prior.intrinsics.distortion[4] != 0
            assumed[i, :n] = prior.intrinsics_sd is None or prior.from_views
        information = np.diag(1 / np.maximum(sd.ravel(), _LEAST_SD) ** 2)
        return BlockPrior(self._mean().ravel(), information, free.ravel(), assumed.ravel())

    def _mean(self) -> FloatArray:
        """The start, but k3 of Brown's lenses that the recording itself determines: what few views made of it is no knowledge."""
        mean = self.start()
        for i, prior in enumerate(self.setup.priors):
            if prior.from_views and len(prior.intrinsics.distortion) == 5:
                mean[i, 8] = 0.0
        return mean

    def changes(self, look: Look) -> bool:
        return look.by_lens is not None

    def derivative(self, look: Look) -> FloatArray:
        assert look.by_lens is not None
        return look.by_lens


def _standard_deviations(prior: CameraPrior, params: BundleParams) -> FloatArray:
    """(4 + n,) of the intrinsics before the bundle."""
    if prior.intrinsics_sd is not None and not prior.from_views:
        return prior.intrinsics_sd
    focal, centre, distortion = params.given_focal, params.given_centre, params.given_distortion
    if prior.from_views:
        focal, centre, distortion = params.weak_focal, params.weak_centre, params.weak_distortion
    elif prior.mount is not None:
        focal, centre = params.depth_focal_sd, params.depth_centre_sd
    own = prior.intrinsics
    sd = [focal * own.fx, focal * own.fy, centre * own.width, centre * own.width]
    lens = np.full(len(own.distortion), distortion)
    if own.model == "opencv":
        lens[2:4] /= 10  # tangential
    if len(lens) == 5:  # of more coefficients none is small by itself
        lens[4:5] = np.minimum(lens[4:5], params.k3_px / (own.fx * _corner_radius(own) ** 7))
    return np.concatenate([sd, lens])


def _corner_radius(lens: Intrinsics) -> float:
    """Of the image's corner from its principal point, in focal lengths."""
    return float(np.hypot(max(lens.cx, lens.width - lens.cx) / lens.fx, max(lens.cy, lens.height - lens.cy) / lens.fy))
