"""What mapping-only and the joint filter share: screening, innovations, the gate, first sight, and the books.

All functions treat the observations of one frame at once.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ekfslam import camera as cam
from ekfslam import se3
from ekfslam.camera import StereoCamera
from ekfslam.config import FilterConfig
from ekfslam.errors import InnovationError
from ekfslam.result import REASONS, Innovation, Rejections
from ekfslam.se3 import Array
from ekfslam.sequence import IntArray, Noise

ACCEPTED = -1
GATE, DISPARITY, ROW_MISMATCH, BEHIND_CAMERA = range(len(REASONS))


@dataclass(frozen=True)
class Rig:
    """What turns landmarks into pixels: intrinsics, extrinsics, noise."""

    camera: StereoCamera
    T_cam_imu: Array
    noise: Noise

    @cached_property
    def variance_px2(self) -> Array:
        """Variances (3,) of the rectified rows."""
        return cam.rectified_rows(np.zeros(4), self.noise.pixel_std_px)[1]

    def rows(self, pixels_px: Array) -> Array:
        """Rectified rows (n, 3) of pixels (n, 4)."""
        return cam.rectified_rows(pixels_px, self.noise.pixel_std_px)[0]


@dataclass(frozen=True)
class FrameReport:
    """What one frame's observations did.

    Args:
        frame: Frame index.
        ids: (n,) landmark ids seen.
        reason: (n,) `ACCEPTED` or an index into `REASONS`.
        nis: Normalised innovation squared of the accepted updates.
        dof: Its degrees of freedom.
        split: Ids of tracks that were split, their observation starting a new landmark.
    """

    frame: int
    ids: IntArray
    reason: IntArray
    nis: float
    dof: int
    split: IntArray


def screen(pixels_px: Array, config: FilterConfig) -> IntArray:
    """Reason codes (n,) of what can be judged from the pixels (n, 4) alone."""
    reason = np.full(len(pixels_px), ACCEPTED)
    reason[np.abs(pixels_px[:, 1] - pixels_px[:, 3]) > config.max_row_mismatch_px] = ROW_MISMATCH
    reason[pixels_px[:, 0] - pixels_px[:, 2] < config.min_disparity_px] = DISPARITY
    return reason


def normalised_squares(S: Array, residual: Array, frame: int, ids: IntArray) -> Array:
    """``r_i^T S_i^-1 r_i`` of every landmark: S (n, 3, 3), residual (n, 3) to (n,).

    Raises:
        InnovationError: A block of S is not positive definite; names the frame and the landmarks.
    """
    try:
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        finite = np.isfinite(S).all(axis=(1, 2), keepdims=True)
        smallest = np.linalg.eigvalsh(np.where(finite, S, 0.0))[:, 0]
        raise InnovationError(frame, ids[smallest <= 0]) from None
    whitened = np.linalg.solve(L, residual[..., None])[..., 0]
    return np.einsum("ni,ni->n", whitened, whitened)


def first_sight(rig: Rig, T_imu_world: Array, rows_px: Array) -> tuple[Array, Array, Array]:
    """Eq. (5): landmarks from one stereo observation each, rectified rows (n, 3).

    Returns:
        Positions (n, 3) in world; ``G`` (n, 3, 6), their derivative by the pose error; the part (n, 3, 3) of their
        covariance that the pixels cause.
    """
    q = cam.triangulate(rig.camera, rows_px)
    s = se3.apply(se3.inverse(rig.T_cam_imu), q)
    R_world_imu = T_imu_world[:3, :3].T
    G = -R_world_imu @ np.concatenate([np.broadcast_to(np.eye(3), (len(s), 3, 3)), -se3.skew(s)], axis=-1)
    R_world_cam = R_world_imu @ rig.T_cam_imu[:3, :3].T
    covariance = R_world_cam @ cam.triangulation_covariance(rig.camera, q, rig.variance_px2) @ R_world_cam.T
    return se3.apply(se3.inverse(T_imu_world), s), G, 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def missed(reason: IntArray) -> NDArray[np.bool_]:
    """Whether (n,) an observation speaks against its landmark, and not merely against itself."""
    return (reason == GATE) | (reason == BEHIND_CAMERA)


def lookup(sorted_ids: IntArray, ids: IntArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Index (n,) of each id in ``sorted_ids``, and whether (n,) it is there at all."""
    if len(sorted_ids) == 0:
        return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
    index = np.minimum(np.searchsorted(sorted_ids, ids), len(sorted_ids) - 1)
    return index, sorted_ids[index] == ids


def collect(reports: SequenceType[FrameReport]) -> tuple[Innovation, Rejections, dict[str, int]]:
    """The reports of a run as flat arrays, and the totals: accepted, rejected, and rejected per reason."""
    ids = np.concatenate([report.ids for report in reports])
    reason = np.concatenate([report.reason for report in reports])
    frame = np.repeat([report.frame for report in reports], [len(report.ids) for report in reports])
    rejected = reason != ACCEPTED
    rejections = Rejections(frame[rejected], ids[rejected], reason[rejected])
    innovation = Innovation(
        nis=np.array([report.nis for report in reports]),
        dof=np.array([report.dof for report in reports], dtype=np.int64),
        accepted=np.array([(report.reason == ACCEPTED).sum() for report in reports], dtype=np.int64),
        rejected=np.array([(report.reason != ACCEPTED).sum() for report in reports], dtype=np.int64),
    )
    split = sum(len(report.split) for report in reports)
    counts = {"accepted": int((~rejected).sum()), "rejected": int(rejected.sum()), "split": split}
    for code, name in enumerate(REASONS):
        counts[f"rejected: {name}"] = int((reason == code).sum())
    return innovation, rejections, counts
