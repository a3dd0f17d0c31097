"""Which few of many pieces of information tell the most: D-optimal design, greedily.

Of information matrices R_i (positive semidefinite) those are wanted whose sum with what is known before, A, has the largest
log det(A + sum R_i): the least volume of the ellipsoid of the unknowns. Taking the best next one again and again comes within
1 - 1/e of the best gain, because log det is submodular in the set; and a gain only shrinks as the set grows, so that most
gains need not be looked at again (lazy evaluation).

References
----------
G. Nemhauser, L. Wolsey, M. Fisher: An analysis of approximations for maximizing submodular set functions, Math. Prog. 14, 1978.
M. Minoux: Accelerated greedy algorithms for maximizing submodular set functions, Optimization Techniques, 1978.
L. Carlone, S. Karaman: Attention and anticipation in fast visual-inertial navigation, IEEE T-RO 35(1), 2019 (log det of the
information of visual features).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray


def most_informative(
    known: FloatArray, information: Callable[[int], FloatArray], items: int, n: int, first: Sequence[int] = ()
) -> tuple[int, ...]:
    """`n` of `items` by greedy log det, in order of their number; `first` are among them whatever they tell.

    Parameters
    ----------
    known : (P, P), positive definite.
    information : (P, P) of an item, positive semidefinite.
    """
    chosen = list(first)
    A = known + sum((information(i) for i in chosen), np.zeros_like(known))
    stale = [(-np.inf, i, -1) for i in range(items) if i not in set(chosen)]
    scale = np.sqrt(np.diag(known))  # the determinant of near-singular matrices wants units of their own size
    while len(chosen) < min(n, items):
        now = _log_det(A, scale)
        while True:
            _, best, seen = stale[0]
            if seen == len(chosen):
                break
            gain = _log_det(A + information(best), scale) - now
            heapq.heapreplace(stale, (-gain, best, len(chosen)))
        heapq.heappop(stale)
        A = A + information(best)
        chosen.append(best)
    return tuple(sorted(chosen))


def _log_det(A: FloatArray, scale: FloatArray) -> float:
    return float(np.linalg.slogdet(A / np.outer(scale, scale))[1])
