"""What mapping-only and the joint filter share: screening, innovations, the gate, first sight, and the books.

All functions treat the observations of one frame at once.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.sequence import Noise
from ekfslam.errors import InnovationError
from ekfslam.filters.result import REASONS, Innovation, Rejections
from ekfslam.geometry import camera as cam
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

ACCEPTED = -1
GATE, DISPARITY, _, BEHIND_CAMERA, MOVING = range(len(REASONS))


class Sensor(Protocol):
    """Anything that sees point landmarks in three rows each, regular in the point: ``z = h(q)``, ``q = T_cam_imu s``.

    `Rig` is the one the library is about; experiments bring their own.
    """

    @property
    def T_cam_imu(self) -> Array:
        """(4, 4) extrinsics, IMU to the frame of ``q``."""

    @property
    def noise(self) -> Noise:
        """Noise of velocities and measurements."""

    def screen(self, measured: Array, config: FilterConfig) -> IntArray:
        """Reason codes (n,) of what can be judged from the measurements alone."""

    def in_view(self, q: Array, config: FilterConfig) -> NDArray[np.bool_]:
        """Whether (n,) points (n, 3) can be seen at all."""

    def rows(self, measured: Array) -> Array:
        """The three rows (n, 3) of each measurement."""

    def variance(self, rows: Array) -> Array:
        """Variances (n, 3) of the rows."""

    def predict(self, q: Array) -> Array:
        """``h(q)``: points (n, 3) m to rows (n, 3)."""

    def jacobian(self, q: Array) -> Array:
        """``dh/dq`` (n, 3, 3), regular."""

    def invert(self, rows: Array) -> Array:
        """The points (n, 3) m that rows (n, 3) see."""


@dataclass(frozen=True)
class Rig:
    """The report's stereo rig as a `Sensor`: measurements are pixels (n, 4), rows the rectified rows (uL, v, uR).

    Disparities come out larger by ``disparity_offset_px`` than the camera's matrix says.
    """

    camera: StereoCamera
    T_cam_imu: Array
    noise: Noise
    disparity_offset_px: float = 0.0

    @cached_property
    def variance_px2(self) -> Array:
        """Variances (3,) of the rectified rows."""
        return cam.rectified_rows(np.zeros(4), self.noise.pixel_std_px)[1]

    @property
    def _offset(self) -> Array:
        return np.array([0.0, 0.0, self.disparity_offset_px])

    def screen(self, measured: Array, config: FilterConfig) -> IntArray:
        reason = np.full(len(measured), ACCEPTED)
        # Limits tied to noise are the business of `ekfslam.data.hygiene`; here is only what no depth can be computed
        # from.
        reason[measured[:, 0] <= measured[:, 2]] = DISPARITY
        return reason

    def in_view(self, q: Array, config: FilterConfig) -> NDArray[np.bool_]:
        return q[:, 2] > config.min_depth_m

    def rows(self, measured: Array) -> Array:
        return cam.rectified_rows(measured, self.noise.pixel_std_px)[0]

    def variance(self, rows: Array) -> Array:
        return np.broadcast_to(self.variance_px2, rows.shape)

    def predict(self, q: Array) -> Array:
        return cam.project(self.camera, q)[:, :3] - self._offset

    def jacobian(self, q: Array) -> Array:
        return cam.rectified_jacobian(self.camera, q)

    def invert(self, rows: Array) -> Array:
        return cam.triangulate(self.camera, rows + self._offset)


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
        log_likelihood: Log-density of the frame's innovations, of accepted updates and, where velocities are in the
            state, of their measurement; see `log_density`. Landmarks that start are without prior and contribute 0.
    """

    frame: int
    ids: IntArray
    reason: IntArray
    nis: float
    dof: int
    split: IntArray
    log_likelihood: float


def log_density(nis: float, log_det: float, dof: int) -> float:
    """``log N(r; 0, S) = -(r^T S^-1 r + log det S + n log 2 pi) / 2`` from the NIS, ``log det S`` and n.

    Summed over a run it is the log-likelihood of the filter's parameters: the prediction error decomposition, Schweppe,
    "Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11, 1965.
    """
    return -0.5 * float(nis + log_det + dof * np.log(2 * np.pi))


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


def linearise(
    sensor: Sensor, T_imu_world: Array, positions_m: Array, linear_positions_m: Array
) -> tuple[Array, Array, Array]:
    """Eq. (4): landmarks (n, 3) in world as the sensor sees them, with their Jacobians.

    Args:
        sensor: What sees them.
        T_imu_world: (4, 4) pose.
        positions_m: (n, 3) estimates, at which A is taken.
        linear_positions_m: (n, 3) positions for the rest of H: the estimates themselves, or (FEJ) the first ones.

    Returns:
        The points in the camera frame (n, 3) m; ``H_x`` (n, 3, 6), derivative by the pose error ``xi`` of
        ``T_imu_world = exp(xi^) T_hat``; ``H_m`` (n, 3, 3), derivative by the landmark position.
    """
    q = se3.apply(sensor.T_cam_imu @ T_imu_world, positions_m)
    A = sensor.jacobian(q) @ sensor.T_cam_imu[:3, :3]
    s = se3.apply(T_imu_world, linear_positions_m)
    return q, np.concatenate([A, -A @ se3.skew(s)], axis=-1), A @ T_imu_world[..., :3, :3]


def first_sight(
    sensor: Sensor, T_imu_world: Array, rows: Array, T_linear: Array | None = None
) -> tuple[Array, Array, Array]:
    """Eq. (5): landmarks from one observation each, rows (n, 3).

    Args:
        sensor: What saw them.
        T_imu_world: (4, 4) pose.
        rows: (n, 3) what was seen.
        T_linear: (4, 4) pose at which G is taken, if not ``T_imu_world`` (FEJ: the predicted pose).

    Returns:
        Positions (n, 3) in world; ``G`` (n, 3, 6), their derivative by the pose error; the part (n, 3, 3) of their
        covariance that the measurement causes, ``C^T (A^T V^-1 A)^-1 C``, the exact limit of a diffuse prior.
    """
    q = sensor.invert(rows)
    T_world_cam = se3.inverse(sensor.T_cam_imu @ T_imu_world)
    positions = se3.apply(T_world_cam, q)
    G = landmark_by_pose(T_imu_world if T_linear is None else T_linear, positions)
    A_inverse = T_world_cam[:3, :3] @ np.linalg.inv(sensor.jacobian(q))
    covariance = (A_inverse * sensor.variance(rows)[:, None, :]) @ np.swapaxes(A_inverse, -1, -2)
    return positions, G, 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def landmark_by_pose(T_imu_world: Array, positions_m: Array) -> Array:
    """``G = -C^T [I, -s^]`` (n, 3, 6) of eq. (5): how new landmarks (n, 3) follow the error of the pose that saw them.

    The pose is (4, 4) for all, or (n, 4, 4).
    """
    s = se3.apply(T_imu_world, positions_m)
    minus_C_transposed = np.broadcast_to(-T_imu_world[..., :3, :3].swapaxes(-1, -2), (len(s), 3, 3))
    return np.concatenate([minus_C_transposed, -minus_C_transposed @ se3.skew(s)], axis=-1)


def diagonal(variance: Array) -> Array:
    """V as blocks: variances (n, 3) to diagonal matrices (n, 3, 3)."""
    return variance[:, :, None] * np.eye(3)


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
