"""Time the kernels, compiled and plain, with pytest-benchmark; a comparison shows kernels that became slower.

python -m pytest experiments/kernel_times.py -n 0 --benchmark-autosave
python -m pytest experiments/kernel_times.py -n 0 --benchmark-compare
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from ekfslam.kernels import compiled, plain

LANDMARKS, DIMENSION, WIDTH = 100, 3, 120  # of a frame on KITTI


def arguments(name: str) -> tuple[Any, ...]:
    """Return arguments of a kernel of the size of a frame."""
    rng = np.random.default_rng(0)
    k, d, n = LANDMARKS, DIMENSION, WIDTH
    A = rng.normal(size=(k, d, d + 2))
    S, rows, wide = A @ A.swapaxes(1, 2), np.arange(k), rng.normal(size=(k, d, n))
    points, R = rng.normal(size=(k, 3)) + np.array([0.0, 0.0, 8.0]), np.eye(3)
    residual, variance, by = rng.normal(size=(k, d)), np.ones((k, d)), rng.normal(size=(6, 12))
    return {
        "whiten": (wide, S, rows, rng.normal(size=(k, d, 12)), A[..., :3], variance),
        "own_variances": (np.linalg.cholesky(S), 0.1 * wide, variance),
        "given_others": (np.linalg.cholesky(S), 0.01 * wide, variance),
        "correct": (wide, S, rows, wide.copy(), 1e-9 * A[..., :3], rows),
        "change": (wide, S, rows, np.broadcast_to(R, (k, 3, 3)), 1e-9 * wide[..., :12], np.arange(12)),
        "normalised_squares": (S, residual),
        "squares_given_others": (S, residual, variance),
        "whitened": (S, residual),
        "moved_by_image": (points, 0.01 * points, np.ones(k, dtype=bool), 4.0),
        "change_by_image": ((points, points, R, by), (points, points, R, by), np.ones(k, dtype=bool)),
    }[name]


@pytest.mark.parametrize("form", [plain, compiled], ids=["plain", "compiled"])
@pytest.mark.parametrize(
    "name",
    [
        "whiten",
        "own_variances",
        "given_others",
        "correct",
        "change",
        "normalised_squares",
        "squares_given_others",
        "whitened",
        "moved_by_image",
        "change_by_image",
    ],
)
def test_time(benchmark: Any, name: str, form: ModuleType) -> None:
    benchmark.group = name
    benchmark(getattr(form, name), *arguments(name))
