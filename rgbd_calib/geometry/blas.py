"""BLAS limited to one thread, so that results do not depend on the number of threads, which split sums differently."""

from __future__ import annotations

import cv2  # noqa: F401  (a library must be loaded to be limited; numpy, scipy and OpenCV each bring their own BLAS)
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_limits

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator of the pipeline's entry points: the same bytes for any OMP_NUM_THREADS. The matrices of a bundle are small, so
that more threads make it slower where the cores are busy."""
