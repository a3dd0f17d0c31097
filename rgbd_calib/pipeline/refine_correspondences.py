"""The paper's methods on bare correspondences, without images or boards."""

from __future__ import annotations

from dataclasses import replace

from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.estimators import pose_cameras
from rgbd_calib.pipeline.judged_points import with_alignment
from rgbd_calib.pipeline.prepare import IntrinsicsSource
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.trust.self_check import calibration as self_check
from rgbd_calib.types import Correspondences, Rig, unposed


@one_blas_thread
def refine_correspondences(
    data: Correspondences, lenses: IntrinsicsSource, config: Config, reference: str
) -> tuple[Rig, RefinementResult | None]:
    """The rig, judged; None in place of a refinement where the method is `init`."""
    posed = pose_cameras(data, unposed(lenses.intrinsics, {}), reference, config)
    rig, refined = posed.rig, posed.refined
    quality = replace(rig.quality, method=config.method)
    if refined is not None:
        quality = replace(quality, self_check=self_check.of_correspondences(refined, data, config.self_check))
    return replace(rig, quality=with_alignment(quality, rig, data, posed.joint)), refined
