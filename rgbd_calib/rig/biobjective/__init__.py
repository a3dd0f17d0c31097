"""Refinement of the poses by pixels and measured 3D points together: the paper's method, and its exact form.

Symbols, with the numbers of the paper's equations:

    T_l = (R_l, t_l)                                pose of camera l, world from camera              (2.0)
    a_l^h = q_l^h - psi(K_l, T_l, x^h)              pixel residual, x^h free                         (2.3)
    V_BA  = sum_l sum_h |a_l^h|^2                                                                    (2.4)
    b_lm^j = (R_l p_l^j + t_l) - (R_m p_m^j + t_m)  residual of a pair of measured points            (2.5)
    V_ICP = sum_{l<m} sum_j |b_lm^j|^2              each pair counted once                           (2.6)
    V = V_ICP + w V_BA,  w = 2 sigma_3D^2 / sigma_2D^2                                               (4.5)

The solver's cost is eq. 4.4, V / (2 sigma_3D^2). For more than two cameras the pairs of one point are not independent;
their likelihood, `pairs="latent"` and the default, is (1 / sigma_3D^2) sum_j sum_l |y_l^j - y_mean^j|^2 with
y_l = R_l p_l + t_l, which for two cameras is the same. `method` chooses the terms: `ba` (2.4), `icp` (2.6), `baicp+`
(12.1), `biobjective` (4.5).

Where a sigma is not known, poses and sigmas are estimated in turn (section 6 of the paper): by the printed formulas
(3.04, 3.05), or, the default, by variance components with redundancy (:mod:`.statistics`). Each round is
Levenberg-Marquardt (A9 - A11, :mod:`.solver`) with analytic Jacobians on SE(3) (:mod:`.kernels`), the points
eliminated, the 3D term from its moments (:mod:`.moments`). :func:`refine_clouds` takes nearest neighbours in whole
clouds for the correspondences of the 3D term.

Limits: with `ba` the scale is a gauge; it stays what the start gave, and the covariance is that of poses with the mean
square distance of the cameras from the reference held. A covariance for each measured point, a robust loss, or sigmas
for each camera make the 3D term a sum over points; its cost then grows with them. A robust loss counts an observation
in the redundancy by its weight over the weight's mean for normal noise.

References
----------
Afzal, Aouada, Antunes, Fofi, Mirbach, Ottersten: Bi-objective framework for sensor fusion in RGB-D multi-view systems.
"""

from rgbd_calib.rig.biobjective.clouds import CloudParams, CloudResult, refine_clouds
from rgbd_calib.rig.biobjective.estimate import refine
from rgbd_calib.rig.biobjective.params import RefinementParams, RefinementResult, RefinementRound

__all__ = [
    "CloudParams",
    "CloudResult",
    "RefinementParams",
    "RefinementResult",
    "RefinementRound",
    "refine",
    "refine_clouds",
]
