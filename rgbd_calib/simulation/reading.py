"""One depth image of a camera, as its sensor sends it."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.depth_sensor import DepthNoise, measure
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.time_of_flight import measure_time_of_flight


def reading(
    params: SimulationParams,
    truth: TrueRig,
    camera: str,
    z_true_m: FloatArray,
    cos_incidence: FloatArray,
    reflectance: FloatArray | None,
    length: FloatArray,
    rng: np.random.Generator,
    drift_m: float = 0.0,
) -> np.ndarray:
    """Depth image (h, w) in whole millimetres, uint16, 0 where there is no measurement.

    `z_true_m`, `cos_incidence`, `reflectance` and `length` (h, w) are as for :func:`measure_time_of_flight`; triangulating
    sensors need no reflectance.
    """
    sensor, bias, field = params.depth_noise, truth.depth_bias[camera], truth.depth_field.get(camera)
    if isinstance(sensor, DepthNoise):
        return measure(z_true_m, cos_incidence, sensor, bias, rng, field)
    assert reflectance is not None
    stray = params.realism.stray_light
    return measure_time_of_flight(
        z_true_m, cos_incidence, reflectance, length, sensor, bias, rng, field, drift_m, stray
    )
