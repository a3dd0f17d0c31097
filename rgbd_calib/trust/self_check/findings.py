"""What a self-check says, and from when on it says it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rgbd_calib.quality import Finding as Finding
from rgbd_calib.quality import Level as Level
from rgbd_calib.quality import SelfCheck as SelfCheck
from rgbd_calib.views.depth_scale import CLIPPED_SHARE, CLIPPED_WIDTH

LIMITS_AT_M = 2.0
_IN_PROPORTION = ("caution_mm", "distrust_mm", "max_apart_mm", "bad_apart_mm")


@dataclass(frozen=True)
class SelfCheckParams:
    """When a deviation is worth a sentence: significant, and large enough to matter.

    Limits in mm are those of a working distance of `LIMITS_AT_M`; of others they are in proportion (:meth:`at`).
    """

    significance: float = 1e-3
    """Chance of a false alarm in a recording whose errors are as the model says, shared evenly among all tests of the
    recording (Bonferroni): one in a thousand calibrations."""
    scale_significance: float = 1e-3
    """The same of the board's size by itself: what people misstate most, with the depth as its only witness. Between the two it
    is a caution."""
    caution_mm: float = 1.0
    """Three such errors make the 3 mm up to which a rig is called good; much less than what is stated is no news either."""
    distrust_mm: float = 3.0
    """The noise of one depth pixel at 1.4 m (1.6e-3 z^2): beyond it an error shows in every fused cloud."""
    splits: int = 8
    """A change is looked for at seven places in time: one between two of them is blurred over a sixteenth of the frames."""
    folds: int = 4
    """Parts in time that are held out in turn: a quarter is enough to tell and leaves enough to calibrate with."""
    min_side: int = 3
    """Frames on each side of a change, and views of a camera in each of two recordings, that can speak of it."""
    max_sigma_px: float = 0.5
    """Finders of corners leave 0.02 to 0.2 px; a scatter of half a pixel is blur, a lens beyond the model, or motion."""
    bad_sigma_px: float = 1.0
    min_step_sd: float = 10.0
    """Standard errors by which single views of two cameras put these elsewhere from one frame on, where corners scatter by more
    than max_sigma_px, or boards seem to move: then something that the estimate holds constant was not, and this is it."""
    max_depth_k_per_m: float = 5e-3
    """sigma_z = k z^2 of the mean over a corner's cell. One pixel of a Kinect or Xtion has 1.6e-3, of the worst sensors
    of this kind 5e-3: a mean that is no better than the worst single pixel is not the sensor's noise."""
    bad_depth_k_per_m: float = 10e-3
    max_apart_mm: float = 10.0
    """What pixels, or depth, of one view may put its board beside where everything together puts it, RMS: the noise of a
    single depth pixel at 2.5 m, here of the whole board. Such errors average over frames, and the covariance counts them."""
    bad_apart_mm: float = 30.0
    max_left_apart: float = 4.0
    """Variance that views' poses still have, over that of their corners, once the errors that were found are in the model: those
    that are the cause leave 1 to 1.6."""
    shaken: float = 2.0
    """Deviation of one camera's views over that of the others': with three alike each gets a third of what one does."""
    wall_sigmas: float = 8.0
    """Of what was stated of a wall's written distance: tapes slip, and sag."""
    max_wall_bend: float = 5e-3
    """Of a wall, as a share of its distance at unit rays: structured light leaves 0.3e-3, time of flight 3e-3."""
    max_factor: float = 1.25
    """Of the deviation that the residuals show over a given sigma: a covariance that is a quarter too small is still one."""
    max_group_ratio: float = 2.0
    """Of the deviation in a part of the data over the camera's whole: the stated errors may be off by so much there."""
    min_group: int = 100
    """Residuals of such a part: the ratio is then known to 7 %."""
    min_votes_share: float = 0.5
    """Of the common frames of two cameras that must agree on their relative pose: with fewer, most of the recording
    contradicts it."""
    max_dropped_share: float = 0.3
    """Of a camera's views that may be left out as gross errors: estimates that resist them break down at a half."""
    copies_sigmas: float = 6.0
    """Two frames whose corners differ by less than so many sigmas in all views show one and the same placement."""
    max_copies: float = 2.0
    """Frames for each placement of the board: with more, the stated errors are too small by the root of it and more."""

    max_clipped_share: float = CLIPPED_SHARE
    clipped_width: float = CLIPPED_WIDTH

    def at(self, distance_m: float) -> SelfCheckParams:
        """With the limits in mm of this working distance, metres, in place of those of `LIMITS_AT_M`."""
        share = distance_m / LIMITS_AT_M
        scaled = {name: share * getattr(self, name) for name in _IN_PROPORTION}
        return replace(self, **scaled)
