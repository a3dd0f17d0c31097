"""What the refinement is told and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.loss import LossName
from rgbd_calib.rig.biobjective.solver import Status

Method = Literal["ba", "icp", "baicp+", "biobjective"]


@dataclass(frozen=True)
class RefinementParams:
    """Which estimator, and when to stop."""

    method: Method = "biobjective"
    sigma_2d_px: float | None = None
    """Noise of a pixel coordinate where it is known; None: estimated. Both known: w is (eq. 4.5)."""
    sigma_3d_m: float | None = None
    """Noise of a coordinate of a measured point where it is known; None: estimated."""
    pairs: Literal["latent", "paper"] = "latent"
    """latent: the likelihood. paper: every pair of cameras once, eq. 2.6 (the same for two cameras)."""
    noise_estimator: Literal["redundancy", "paper"] = "redundancy"
    """redundancy: unbiased variance components. paper: eq. 3.04 and 3.05 as printed."""
    per_camera_sigmas: bool = False
    """A sigma_2D and a sigma_3D for each camera; needs three cameras or more, sigmas unknown."""
    loss: LossName = "squared"
    loss_scale: float = 2.5
    """In sigmas, of the length of one observation's residual."""
    baicp_c: float = 0.5
    """c of eq. 12.1: 0 is ICP alone, 1 is BA alone."""
    max_rounds: int = 50
    """Of the alternation of poses and sigmas (section 6 of the paper)."""
    sigma_tolerance: float = 1e-4
    """Relative change of the sigmas at which the alternation stops."""
    max_iterations: int = 100
    """Of Levenberg-Marquardt, in each round."""
    cost_tolerance: float = 1e-10
    """Relative decrease of the cost at which Levenberg-Marquardt stops."""

    def __post_init__(self) -> None:
        for key in ("sigma_2d_px", "sigma_3d_m"):
            value = getattr(self, key)
            if value is not None and not 0 < value < float("inf"):
                raise ConfigError(
                    f"refinement.{key}: {value} given, a positive number needed. Leave it out to estimate it"
                )
        if not 0 < self.baicp_c < 1:
            raise ConfigError(
                f"refinement.baicp_c: {self.baicp_c} given, between 0 and 1 needed. Use icp or ba instead"
            )
        if not self.loss_scale > 0:
            raise ConfigError(f"refinement.loss_scale: {self.loss_scale} given, a positive number of sigmas needed")
        exact = self.loss == "squared" and not self.per_camera_sigmas
        if not exact and (self.method == "baicp+" or self.pairs == "paper" or self.noise_estimator == "paper"):
            raise ConfigError(
                "refinement: a robust loss or sigmas for each camera were asked for with one of the paper's printed forms "
                "(method baicp+, pairs paper, noise_estimator paper), which have neither. Use the latent form with them"
            )
        if self.per_camera_sigmas and (self.sigma_2d_px is not None or self.sigma_3d_m is not None):
            raise ConfigError("refinement.per_camera_sigmas: sigmas were given too. Give them, or have them estimated")


@dataclass(frozen=True)
class RefinementRound:
    """One round of the alternation: the weight it used, and the sigmas that its residuals then gave."""

    w: float
    """2 sigma_3D^2 / sigma_2D^2, m^2 / px^2 (eq. 4.5); NaN where only one term takes part."""
    sigma_2d_px: float
    sigma_3d_m: float
    cost: float
    iterations: int


@dataclass(frozen=True)
class RefinementResult:
    """Poses, how sure they are, and what was seen on the way. NaN stands for a term that takes no part."""

    cameras: tuple[str, ...]
    """The order of `joint_covariance`."""
    reference: str
    T_world_color: dict[str, FloatArray]
    covariance: dict[str, FloatArray]
    """(6, 6) of the left perturbation (rad, m) in the world frame; zeros for the reference. For `ba`, in the gauge that
    keeps the mean square distance of the cameras from the reference."""
    joint_covariance: FloatArray
    """(6 N, 6 N), in the order of `cameras`."""
    points_m: FloatArray
    """(labels, 3), x^h of eq. 2.3 in the world; NaN where a label has no pixels in two cameras."""
    points_3d_m: FloatArray
    """(labels, 3), the latent point of the 3D measurements in the world; NaN where fewer than two cameras have one."""
    sigma_2d_px: float
    sigma_3d_m: float
    sigma_covariance: FloatArray
    """(2, 2) of (sigma_2d_px, sigma_3d_m); 0 where a sigma was given."""
    sigmas_2d_px: dict[str, float]
    """By camera; all equal unless each camera has its own."""
    sigmas_3d_m: dict[str, float]
    w: float
    redundancy_2d: float
    """Pixel residuals less the share of the unknowns that they determined."""
    redundancy_3d: float
    variance_factor_2d: float
    """Mean square of the residuals over what `sigma_2d_px` predicts: 1 within sqrt(2 / redundancy) if all is well."""
    variance_factor_3d: float
    history: tuple[RefinementRound, ...]
    cost: float
    """V_BA / sigma_2D^2 + the 3D term over its sigma^2 (eq. 4.4), or the robust loss's sum."""
    iterations: int
    status: Status
    message: str
    residuals_2d_px: FloatArray
    """(n2, 2), measured - predicted, rows as in the correspondences; NaN where a row was left out."""
    residuals_3d_m: FloatArray
    """(n3, 3), measured - predicted in the camera's frame."""
    weights_2d: FloatArray
    """(n2,), robust weights; 1 for the squared loss, NaN where a row was left out."""
    weights_3d: FloatArray
    dropped: dict[str, int]
    """Rows that took no part, by reason."""

    @property
    def sigma_2d_se_px(self) -> float:
        """Standard error of `sigma_2d_px`."""
        return float(self.sigma_covariance[0, 0] ** 0.5)

    @property
    def sigma_3d_se_m(self) -> float:
        """Standard error of `sigma_3d_m`."""
        return float(self.sigma_covariance[1, 1] ** 0.5)
