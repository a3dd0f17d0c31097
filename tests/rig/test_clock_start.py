"""The first offsets of clocks, from how fast the board turns."""

from __future__ import annotations

import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.rig.motion.start import Track, first_offsets
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.session import draw_scene
from rgbd_calib.simulation.wave import WaveSession, film_wave

MOVES = (np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0]))
"""A two-sided board may be read from either side."""
POSE_NOISE_RAD = 0.003


def tracks(session: WaveSession, rng: np.random.Generator) -> dict[str, Track]:
    """Poses of single views, as noisy as corners of 0.1 px make them, each read from either side at random."""
    out = {}
    for c, own in session.truth.cameras.items():
        views = [v for v in session.views if v.camera == c]
        T = np.stack([se3.inverse(own.T_world_color) @ session.T_world_board(v) for v in views])
        R = T[:, :3, :3] @ so3.exp(rng.normal(0, POSE_NOISE_RAD, (len(views), 3)))
        R = R @ np.stack(MOVES)[rng.integers(2, size=len(views)), :3, :3]
        out[c] = Track(np.array([1e-6 * session.stamps_us[c][v.frame][0] for v in views]), R)
    return out


def filmed(seed: int, kind: str = "hand", seconds: float = 12.0, **wave: float) -> tuple[WaveSession, dict[str, Track]]:
    rng = np.random.default_rng(seed)
    scene = draw_scene(2 + seed % 2, "arc", 0, 0, rng)
    session = film_wave(scene, WaveParams(seconds=seconds, **wave), rng, kind)
    return session, tracks(session, rng)


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 20))])
def test_offsets_of_a_minute_and_a_half_with_dropped_frames(seed):
    session, seen = filmed(seed, offset_s=90.0, lost=0.1)
    offsets = first_offsets(seen, "C1", MOVES)
    for c, clock in session.clocks.items():
        assert abs(offsets[c] - clock.offset_s) < 0.02  # the estimate's prior is of 0.05 s


@pytest.mark.parametrize("kind", ["still", "line"])
def test_without_turns_the_clocks_cannot_be_told(kind):
    _, seen = filmed(0, kind)
    with pytest.raises(CalibrationError, match="C2: clocks cannot be determined"):
        first_offsets(seen, "C1", MOVES)
