"""A board, or a camera, that was not in one place while all cameras exposed: its cameras disagree otherwise in each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbd_calib.rig.weights import N_PIXEL
from rgbd_calib.trust.self_check.equations import Equations, pose_residuals
from rgbd_calib.trust.self_check.findings import Finding, SelfCheckParams


def check_motion(
    eq: Equations,
    explained: Equations,
    apart_mm: Mapping[str, float],
    errors: Sequence[Finding],
    params: SelfCheckParams,
) -> list[Finding]:
    """Errors of single cameras were found, and with all of them in the model each view still stands beside the others.

    Another lens, or another pose from some frame on, leaves views that agree as their corners' noise lets them. A motion
    between exposures has as many unknowns as there are views: errors that are smooth over the image fit a part of it.

    Parameters
    ----------
    eq, explained : equations without and with the errors that were found.
    apart_mm : by camera, RMS by which a view's pixels put its board beside where the others put it.
    errors : what was found.
    """
    if not _ratios(explained) > params.max_left_apart:
        return []
    name = max(eq.cameras, key=lambda c: _ratios(eq, c))
    if apart_mm.get(name, 0.0) < params.distrust_mm:
        return []
    if not any(own.cameras for own in errors):
        return _shaken(eq, name, apart_mm[name], params)
    text = (
        f"{name}'s images put the board elsewhere in each frame than the other cameras' images do, by "
        f"{apart_mm[name]:.0f} mm (RMS), and no error of a lens or a pose explains it: frames of one name are not one instant"
    )
    advice = (
        "The board moved between the cameras' exposures, or clocks differ: hold it still until all have exposed, or find the clocks "
        "with `rgbd-calib sync` (`synchronous: false` in dataset.yaml)"
    )
    return [Finding("board moved", "distrust", (name,), text, advice, round(apart_mm[name], 2))]


def _shaken(eq: Equations, name: str, apart_mm: float, params: SelfCheckParams) -> list[Finding]:
    """One camera of three or more disagrees with the others far more than these do with each other."""
    others = [_ratios(eq, c) for c in eq.cameras if c != name]
    if len(others) < 2 or _ratios(eq, name) < params.shaken**2 * float(np.median(others)):
        return []
    text = (
        f"{name}'s images put the board elsewhere in each frame than the other cameras' images do, by {apart_mm:.0f} mm (RMS), "
        "and those agree better with each other: it shakes, or its images and theirs are not one instant"
    )
    advice = (
        "Switch image stabilisation and autofocus off, fix the camera to its mount, and check that its frames are of the same "
        "instants as the others'; then film again"
    )
    return [Finding("camera shakes", "distrust", (name,), text, advice, round(apart_mm, 2))]


def _ratios(eq: Equations, camera: str | None = None) -> float:
    """Variance of the pixels' pose parts over that of single corners, of one camera or of all."""
    squares, expected = pose_residuals(eq)
    mine = np.ones(len(eq.camera), bool) if camera is None else eq.camera == eq.cameras.index(camera)
    return float(squares[mine, :N_PIXEL].sum() / max(float(expected[mine, :N_PIXEL].sum()), 1e-9))
