"""rig.yaml as a pydantic model: one place says which keys there are, and a JSON Schema is published from it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from rgbd_calib.geometry import so3
from rgbd_calib.io.schema_base import (
    Finite,
    Matrix4,
    Matrix6,
    Model,
    Name,
    Vector3,
    Vector4,
    check_rigid,
)
from rgbd_calib.io.schema_parts import (
    DepthBiasModel,
    DepthCameraModel,
    GridFieldModel,
    IntrinsicsModel,
    PolynomialFieldModel,
)
from rgbd_calib.types import Clock

NotNegative = Annotated[Finite, Field(ge=0)]


class ClockModel(Model):
    """t_reference = stamp + offset_s + 1e-6 drift_ppm (stamp - first stamp); zeros for the reference; `depth_delay_s` is the
    instant of the depth less that of its colour image beyond what the stamps say; `readout_s` from the first row to the last."""

    offset_s: Finite = 0.0
    offset_sd_s: NotNegative = 0.0
    drift_ppm: Finite = 0.0
    drift_sd_ppm: NotNegative = 0.0
    depth_delay_s: Finite = 0.0
    depth_delay_sd_s: NotNegative = 0.0
    readout_s: Finite = 0.0
    jitter_s: NotNegative = 0.0

    @classmethod
    def of(cls, clock: Clock) -> ClockModel:
        return cls(**asdict(clock))

    def value(self) -> Clock:
        return Clock(**self.model_dump(include=set(ClockModel.model_fields)))


class RigCameraModel(Model):
    """One camera; `p_world = T_world_color @ p_color`; the covariance is of the left perturbation (rad, m)."""

    intrinsics: IntrinsicsModel | None = None
    T_world_color: Matrix4 | None = None
    rotation_wxyz: Vector4 | None = None
    translation_m: Vector3 | None = None
    covariance: Matrix6 | None = None
    depth_bias: DepthBiasModel | None = None
    depth_field: PolynomialFieldModel | GridFieldModel | None = Field(default=None, discriminator="basis")
    depth: DepthCameraModel | None = None
    clock: ClockModel | None = None
    intrinsics_sd: Annotated[list[Finite], Field(min_length=8, max_length=18)] | None = None
    sigma_2d_px: Finite | None = None
    sigma_3d_m: Finite | None = None
    sigma_3d_model: str | None = None

    @model_validator(mode="after")
    def _pose(self) -> RigCameraModel:
        if self.T_world_color is None:
            return self
        T = np.array(self.T_world_color)
        check_rigid(T)
        if self.translation_m is not None and not np.allclose(T[:3, 3], self.translation_m, atol=1e-6):
            raise ValueError("translation_m and T_world_color disagree")
        q = self.rotation_wxyz
        if q is not None and not np.allclose(abs(so3.quaternion_wxyz(T[:3, :3]) @ np.array(q)), 1, atol=1e-6):
            raise ValueError("rotation_wxyz and T_world_color disagree")
        return self


class RigModel(Model):
    """rig.yaml; intrinsics.yaml, depth_bias.yaml and truth.yaml are the same with fewer or more keys."""

    format: Literal["rgbd-calib/rig"]
    version: Literal[1]
    reference: str | None = None
    cameras: Annotated[dict[Name, RigCameraModel], Field(min_length=1)]
    boards: dict[str, Matrix4] | None = None
    quality: dict[str, Any] = Field(default_factory=dict)
    provenance: dict[str, Any] = Field(default_factory=dict)
