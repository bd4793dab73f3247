"""What poses and covariances in a file must be, beside what `ekfslam.hdf5` knows of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.checks import rigid_defect
from ekfslam.errors import ArchiveError
from ekfslam.hdf5 import NUMBERS, Check

RIGID_TOLERANCE = 1e-6
COVARIANCE_TOLERANCE = 1e-6  # of correlations: far above rounding, far below what shows in an ellipse


def _is_rigid(T: Array, _: Mapping[str, int]) -> BoolArray:
    found = np.nan_to_num(T, nan=0.0, posinf=0.0, neginf=0.0)
    return (rigid_defect(found) <= RIGID_TOLERANCE) & NUMBERS.holds(T, {}).all(axis=(-1, -2))


def _is_covariance(P: Array, _: Mapping[str, int]) -> BoolArray:
    """Whether (...) of (..., n, n) are symmetric and positive semi-definite, by their correlations."""
    is_number = np.asarray(NUMBERS.holds(P, {}).all(axis=(-1, -2)))
    P = np.where(is_number[..., None, None], P, 0.0)
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    std = np.sqrt(np.where(variance > 0, variance, 1.0))
    C = P / std[..., :, None] / std[..., None, :]
    is_symmetric = (np.abs(C - C.swapaxes(-1, -2)) <= COVARIANCE_TOLERANCE).all(axis=(-1, -2))
    C = np.clip(C, -2.0, 2.0)  # beyond 1 it is none, but its eigenvalues must stay numbers
    smallest = np.linalg.eigvalsh((C + C.swapaxes(-1, -2)) / 2)[..., 0]
    return is_number & is_symmetric & (variance >= 0).all(axis=-1) & (smallest >= -COVARIANCE_TOLERANCE)


RIGID = Check("f", "be a rigid transform", _is_rigid)
COVARIANCES = Check("f", "be symmetric and positive semi-definite", _is_covariance)


def require_agreement(log: Mapping[str, Any], place: str) -> None:
    """Raise an `ArchiveError` where the fields of a log, each right by itself, contradict each other."""
    frame, landmark, previous = (log[name] for name in ("frame", "landmark", "previous"))
    if len(np.unique(landmark)) < len(log["id"]):
        unseen = np.setdiff1d(np.arange(len(log["id"])), landmark)[0]
        raise ArchiveError(f"{place}/landmark_id[{unseen}] has no observation")
    follows = np.flatnonzero(previous >= 0)
    before = previous[follows]
    wrong = (landmark[before] != landmark[follows]) | (frame[before] != frame[follows] - 1)
    if wrong.any():
        raise ArchiveError(
            f"{place}/previous[{follows[np.argmax(wrong)]}] is no observation of the same landmark in the frame before"
        )
    if log["up"].shape[1] not in (0, 3):
        raise ArchiveError(f"{place}/up has {log['up'].shape[1]} columns, expected 3, or 0 where it is not estimated")
