"""Trajectories with covariances: poses of the body or of the left camera in world, as other programs exchange them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import frozen, require_shape
from ekfslam.geometry import se3
from ekfslam.shown import Card, Shown, count, figure

Moving = Literal["body", "camera"]


@dataclass(frozen=True, repr=False)
class Trajectory(Shown):
    """Stamped poses of a moving frame, the body (IMU) or the left camera, in world.

    Args:
        time_s: (F,) stamps.
        T_world: (F, 4, 4) poses of the moving frame in world.
        covariance: (F, 6, 6) of the errors of the position (m) and of the rotation (rad), both along the axes of
            world: ``p = p_hat + d``, ``R = exp(w^) R_hat``, the error is ``[d; w]`` as in ROS. None if unknown.
        moving: The moving frame.
    """

    time_s: Array
    T_world: Array
    covariance: Array | None = None
    moving: Moving = "body"

    def __post_init__(self) -> None:
        shapes = {"time_s": (None,), "T_world": (len(self.time_s), 4, 4), "covariance": (len(self.time_s), 6, 6)}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                value = np.asarray(getattr(self, name), dtype=float)
                require_shape(value, shape, name)
                object.__setattr__(self, name, frozen(value))

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        poses = count(len(self.time_s), "pose")
        if not len(self.time_s):
            return Card(poses, {})
        way_m = np.linalg.norm(np.diff(self.T_world[:, :3, 3], axis=0), axis=1).sum()
        facts = {
            "stamps": f"{self.time_s[0]:.10g} to {self.time_s[-1]:.10g} s",
            "way": f"{figure(float(way_m))} m of the {self.moving}",
            "covariance": "none" if self.covariance is None else "of every pose",
        }
        return Card(poses, facts, (".time_s", ".T_world", ".covariance"))

    def of_camera(self, T_cam_imu: Array) -> Trajectory:
        """Return the trajectory of the left camera on a body; the extrinsics count as known."""
        T_imu_cam = se3.inverse(T_cam_imu)
        covariance = None
        if self.covariance is not None:
            # d of the camera = d + w x (R lever)
            J = np.broadcast_to(np.eye(6), self.covariance.shape).copy()
            J[:, :3, 3:] = -se3.skew(self.T_world[:, :3, :3] @ T_imu_cam[:3, 3])
            covariance = J @ self.covariance @ np.swapaxes(J, 1, 2)
        return Trajectory(self.time_s, self.T_world @ T_imu_cam, covariance, "camera")


def from_left_error(time_s: Array, T_world_imu: Array, covariance: Array) -> Trajectory:
    """Return a trajectory with covariances (F, 6, 6) of ``xi``: to first order ``[d; w] = -diag(R, R) xi``."""
    R = np.zeros_like(covariance)
    R[:, :3, :3] = R[:, 3:, 3:] = T_world_imu[:, :3, :3]
    return Trajectory(time_s, T_world_imu, R @ covariance @ np.swapaxes(R, 1, 2))


def left_error_covariance(trajectory: Trajectory, T_cam_imu: Array) -> Array | None:
    """Return the covariances (F, 6, 6) of ``xi`` of the body, the inverse of `from_left_error`; None if unknown.

    They are the same in every world. Those of a camera are turned by the adjoint of ``T_imu_cam``.
    """
    if trajectory.covariance is None:
        return None
    A = np.zeros_like(trajectory.covariance)
    A[:, :3, :3] = A[:, 3:, 3:] = np.swapaxes(trajectory.T_world[:, :3, :3], 1, 2)
    if trajectory.moving == "camera":
        A = se3.adjoint(se3.inverse(T_cam_imu)) @ A
    covariance = A @ trajectory.covariance @ np.swapaxes(A, 1, 2)
    return 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
