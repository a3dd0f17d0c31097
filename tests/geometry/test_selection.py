"""Greedy log det against what can be worked out by hand or by trying all."""

from itertools import combinations

import numpy as np

from rgbd_calib.geometry.selection import most_informative


def log_det(known, parts, chosen):
    return np.linalg.slogdet(known + sum(parts[i] for i in chosen))[1]


def of_rank_two(n, P, rng):
    rows = rng.normal(size=(n, 2, P)) * rng.uniform(0.2, 3, (n, 1, 1))
    return np.einsum("nki,nkj->nij", rows, rows)


def test_each_direction_once_before_any_twice():
    parts = [np.diag(np.eye(3)[i % 3]) * (1 + (i < 3)) for i in range(9)]
    assert most_informative(np.eye(3) * 1e-3, parts.__getitem__, 9, 3) == (0, 1, 2)


def test_ties_go_to_the_first_and_the_rest_is_taken_whole():
    parts = [np.eye(2)] * 5
    assert most_informative(np.eye(2), parts.__getitem__, 5, 2) == (0, 1)
    assert most_informative(np.eye(2), parts.__getitem__, 5, 2, first=[3]) == (0, 3)
    assert most_informative(np.eye(2), parts.__getitem__, 5, 9) == (0, 1, 2, 3, 4)


def test_lazy_is_greedy_and_near_the_best_of_all():
    rng = np.random.default_rng(0)
    for _ in range(20):
        parts, known = of_rank_two(10, 4, rng), np.eye(4) * 0.1
        plain = []
        for _ in range(4):
            gains = [-np.inf if i in plain else log_det(known, parts, [*plain, i]) for i in range(10)]
            plain.append(int(np.argmax(gains)))
        chosen = most_informative(known, parts.__getitem__, 10, 4)
        assert chosen == tuple(sorted(plain))
        before = log_det(known, parts, [])
        best = max(log_det(known, parts, some) for some in combinations(range(10), 4)) - before
        assert log_det(known, parts, chosen) - before >= (1 - 1 / np.e) * best  # Nemhauser, Wolsey, Fisher


def test_units_do_not_matter():
    rng = np.random.default_rng(1)
    parts, known = of_rank_two(40, 5, rng), np.eye(5)
    units = np.outer(*[10.0 ** np.array([-6, 3, 0, 8, -2])] * 2)
    chosen = most_informative(known, parts.__getitem__, 40, 7)
    assert most_informative(known * units, lambda i: parts[i] * units, 40, 7) == chosen
