"""Small rigs with known truth for the tests of the refinement."""

import numpy as np

from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.types import Correspondences

LENS = (0.1, -0.2, 0.001, -0.002, 0.05)


def make(rng, cameras=4, points=(60, 60), sigmas=(1.0, 0.018), visible=1.0, lens=False, off=0.02):
    """Correspondences, intrinsics, starting poses and true poses of cameras around a cloud of points.

    Features are seen by each camera with probability `visible`; starts are off by `off` rad and m in each coordinate.
    """
    T = np.stack([_look(0.6 * (i - (cameras - 1) / 2), 0.2 * (i % 2)) for i in range(cameras)])
    T = se3.inverse(T[0]) @ T
    K = [Intrinsics(640, 480, 520.0 + 5 * i, 525.0, 319.5, 239.5, LENS if lens else (0.0,) * 5) for i in range(cameras)]
    names = tuple(f"C{i + 1}" for i in range(cameras))
    centre = np.mean(T[:, :3, 3] + 2.5 * T[:, :3, 2], axis=0)
    tables = []
    for n, kind in zip(points, "qp", strict=True):
        X = centre + rng.uniform([-0.8, -0.6, -0.8], [0.8, 0.6, 0.8], (n, 3))
        number, point = np.nonzero(rng.random((cameras, n)) < visible)
        p = se3.transform(se3.inverse(T)[number], X[point])
        if kind == "q":
            p = camera.project(np.stack([k.vector for k in K])[number], p)
        tables.append((number, point, p))
    (qc, qp, q), (pc, pp, p) = tables
    data = Correspondences(
        names,
        tuple(("0", f"q{i}") for i in range(points[0])) + tuple(("0", f"p{i}") for i in range(points[1])),
        qc,
        qp,
        q + rng.normal(0, 1, q.shape) * sigmas[0],
        pc,
        pp + points[0],
        p + rng.normal(0, 1, p.shape) * sigmas[1],
    )
    start = T.copy()
    start[1:] = se3.retract(T[1:], rng.normal(0, 1, (cameras - 1, 6)) * off)
    return data, *(dict(zip(names, what, strict=True)) for what in (K, start, T))


def _look(angle, lift):
    position = np.array([2.5 * np.sin(angle), -lift, -2.5 * np.cos(angle)])
    z = -position / np.linalg.norm(position)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    return se3.make(np.stack([x, np.cross(z, x), z], axis=1), position)
