"""Refinement by clouds: two views of the same room, sampled apart, come together."""

import numpy as np
import pytest
from refinement_cases import make

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.rig.biobjective import CloudParams, RefinementParams, refine_clouds


def room(rng, n=30_000):
    """Points (n, 3) on a floor, two walls and a box, metres, in the frame of a camera in front of them."""
    a, b = rng.uniform(-1, 1, (2, n))
    faces = [
        np.stack([a, 0.8 + 0 * a, 2.5 + b], 1),
        np.stack([a, 0.8 * b, 3.5 + 0 * a], 1),
        np.stack([1 + 0 * a, 0.8 * a, 2.5 + b], 1),
        np.stack([0.2 * a, 0.6 + 0.2 * b, 2.2 + 0 * a], 1),
        np.stack([0.2 + 0 * a, 0.6 + 0.2 * b, 2.4 + 0.2 * a], 1),
    ]
    return np.stack(faces)[rng.integers(0, len(faces), n), np.arange(n)]


def views(rng, cameras=2, noise_m=0.002):
    """Clouds of the same room, each sampled anew, with true and starting poses."""
    truth = {
        f"C{i + 1}": se3.retract(np.eye(4), np.array([0.02, -0.3, 0.05, 0.6, 0.1, 0.05]) * i) for i in range(cameras)
    }
    clouds = {}
    for camera, T in truth.items():
        seen = se3.transform(se3.inverse(T), room(rng))
        seen = seen[np.abs(seen[:, 0]) < 0.55 * seen[:, 2]]  # its field of view: the overlap is partial
        clouds[camera] = seen + rng.normal(0, noise_m, seen.shape)
    start = {c: T if c == "C1" else se3.retract(T, rng.normal(0, 0.01, 6)) for c, T in truth.items()}
    return clouds, start, truth


@pytest.mark.parametrize("cameras", [2, 3])
def test_clouds_come_together(cameras):
    clouds, start, truth = views(np.random.default_rng(0), cameras)
    out = refine_clouds(clouds, start, "C1", matching=CloudParams(max_points=2000))
    assert out.settled
    for camera in list(truth)[1:]:
        before, after = (
            np.abs(se3.difference(T[camera], truth[camera])).max() for T in (start, out.refinement.T_world_color)
        )
        # samples about 25 mm apart on each face, 2000 pairs: 25 mm / sqrt(2000) = 0.6 mm, and a lever of 3
        assert after < min(0.003, before / 3)
    assert set(out.n_pairs) >= {("C1", "C2")}


def test_pixels_join_the_clouds():
    rng = np.random.default_rng(1)
    data, K, start, truth = make(rng, 2, (40, 5), (0.3, 0.01))
    scene = room(rng)
    clouds = {c: se3.transform(se3.inverse(T), scene + rng.normal(0, 0.002, scene.shape)) for c, T in truth.items()}
    out = refine_clouds(clouds, start, "C1", RefinementParams(), CloudParams(max_points=1000), data, K)
    assert np.abs(se3.difference(out.refinement.T_world_color["C2"], truth["C2"])).max() < 0.002
    assert np.isfinite(out.refinement.sigma_2d_px)


def test_clouds_that_do_not_meet_are_named():
    clouds, start, _ = views(np.random.default_rng(2))
    with pytest.raises(CalibrationError, match="no 3D point"):
        refine_clouds({"C1": clouds["C1"], "C2": clouds["C2"] + [0, 0, 50]}, start, "C1")
    with pytest.raises(CalibrationError, match="C2: cloud with NaN"):
        refine_clouds({"C1": clouds["C1"], "C2": clouds["C2"] * np.nan}, start, "C1")
    with pytest.raises(CalibrationError, match="C2: cloud of 3 points"):
        refine_clouds({"C1": clouds["C1"], "C2": clouds["C2"][:3]}, start, "C1")
    with pytest.raises(ConfigError, match="needs pixel features"):
        refine_clouds(clouds, start, "C1", RefinementParams())
    with pytest.raises(ConfigError, match="overlap"):
        CloudParams(overlap=1.5)
