"""Written distances of walls against the boards: both say what the depth errs by along the range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.self_check.findings import Finding, SelfCheckParams

BENT_AT_M = 2.0
"""Distance at which a bend is told."""
EXPLAINED = 0.25
"""Share of the median deviation that an offset or a factor may leave and still be the explanation."""


@dataclass(frozen=True)
class WallDistances:
    """Of one camera's walls, metres; W walls."""

    written_m: FloatArray
    """(W,)."""
    true_m: FloatArray
    """(W,), as boards and depth together have them."""
    sd_m: FloatArray
    """(W,), of what was written, as stated."""

    @property
    def off_m(self) -> FloatArray:
        """(W,), of what was written."""
        return self.written_m - self.true_m

    def only(self, which: BoolArray) -> WallDistances:
        """Some of the walls."""
        return WallDistances(self.written_m[which], self.true_m[which], self.sd_m[which])


def walls_of_bundle(solved: Solution) -> dict[str, WallDistances]:
    """By camera; cameras without walls are absent."""
    walls, state, out = solved.problem.setup.walls, solved.state, {}
    for i, name in enumerate(solved.cameras):
        mine = np.flatnonzero(walls.camera == i)
        if len(mine):
            tape = state.values["tape"][i, 0] if "tape" in solved.problem.parts else 0.0
            off_m = state.walls.values[mine, 0] + tape
            sd_m = np.hypot(walls.sd_m[mine], solved.problem.setup.params.tape_sd_m)
            out[name] = WallDistances(walls.written_m[mine], walls.written_m[mine] + off_m, sd_m)
    return out


_ADVICE = {
    "offset": "Measure from the front of the camera's lens, square to the wall. The result follows the boards",
    "factor": (
        "The square of the board is not as stated, walls were measured along a slant, or depth has another scale since. The result "
        "follows the boards"
    ),
    "scatter": (
        "Walls of another camera, a depth sensor that changed between the recordings (mode, firmware, temperature), or another "
        "square of the board than stated: measure both. The result follows the boards"
    ),
    "slips": "Correct distances.csv, or take these walls out",
}


def check_walls(walls: Mapping[str, WallDistances], params: SelfCheckParams) -> list[Finding]:
    """Distances that were written down and are not those of the boards; the result follows the boards."""
    by_kind: dict[str, dict[str, WallDistances]] = {}
    for name, own in walls.items():
        wrong = np.abs(own.off_m) > params.wall_sigmas * own.sd_m
        if wrong.any():
            slips = wrong.sum() <= max(1, len(wrong) // 4) and _fit(own.only(~wrong))
            by_kind.setdefault("slips" if slips else _kind(own), {})[name] = own.only(wrong) if slips else own
    return [
        Finding("walls", "caution", tuple(some), _told(kind, some), _ADVICE[kind]) for kind, some in by_kind.items()
    ]


def check_bends(solved: Solution, params: SelfCheckParams) -> list[Finding]:
    """Walls that look more bent than any wall is: depth errs otherwise on them than on boards."""
    setup, out = solved.problem.setup, []
    for i in np.unique(setup.walls.camera):
        bend, lens = float(solved.problem.weights.wall_bend[i]), setup.priors[i].intrinsics
        if bend > params.max_wall_bend:
            border_mm = 1e3 * bend * BENT_AT_M * (lens.width / lens.fx / 2) ** 2
            text = (
                f"{solved.cameras[i]}'s walls look bent by the depth, by {border_mm:.0f} mm at the border of the image at "
                f"{BENT_AT_M:g} m"
            )
            advice = "Is the bias recording of this camera, in this mode? Or the wall is not flat: film another. The result follows the boards"
            out.append(Finding("walls", "caution", (solved.cameras[i],), text, advice))
    return out


def _fit(own: WallDistances) -> bool:
    """Are these as good as was stated? Where not, what is wrong with one wall is wrong with all."""
    return bool(np.sqrt(np.mean((own.off_m / own.sd_m) ** 2)) < 2.0)


def _kind(own: WallDistances) -> str:
    """The simplest that explains it: one offset, one factor, or neither."""
    left = {
        "offset": np.abs(own.off_m - np.median(own.off_m)),
        "factor": np.abs(own.written_m - np.median(own.written_m / own.true_m) * own.true_m),
    }
    best = min(left, key=lambda key: float(np.median(left[key])))
    return best if float(np.median(left[best])) < EXPLAINED * float(np.median(np.abs(own.off_m))) else "scatter"


def _told(kind: str, some: Mapping[str, WallDistances]) -> str:
    names, all_ = ", ".join(some), list(some.values())
    written_m, true_m = (np.concatenate([getattr(own, key) for own in all_]) for key in ("written_m", "true_m"))
    if kind == "slips":
        pairs = ", ".join(f"{w:.3f} m for {t:.3f} m" for w, t in zip(written_m, true_m, strict=True))
        return f"{names}: written distances of walls that the boards contradict: {pairs}"
    rms_mm = 1e3 * float(np.sqrt(np.mean((written_m - true_m) ** 2)))
    text = f"{names}: written distances of walls differ from those by the boards, by {rms_mm:.0f} mm (RMS)"
    if kind == "offset":
        return f"{text}: all are {1e3 * float(np.median(written_m - true_m)):+.0f} mm off"
    return f"{text}: they are {float(np.median(written_m / true_m)):.3f} times as long" if kind == "factor" else text
