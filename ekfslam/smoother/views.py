"""Cameras of all frames at a state, and how their errors follow from the unknowns: the only way to landmarks.

A camera is ``W = C(c) D(c_time) exp(o^) T_imu_world`` with extrinsics C, motion to the exposure D, and the offset o of
blocks that move the camera, eq. (9) and (11). Its error z, ``W_true = exp(z^) W``, is linear in those of the unknowns.
A difference of observations, eq. (10), may see the present frame through another camera than a single observation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.geometry import se3
from ekfslam.models.blocks.calibration import TIME, to_exposure
from ekfslam.models.observer import Moment, Observer
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.unknowns import Unknowns


@dataclass(frozen=True)
class Views:
    """Cameras of T frames, h of each: that of single observations and, if it differs, that of differences.

    Args:
        sensor: Sensor with its calibration.
        T_view_world: (T h, 4, 4) cameras.
        by_frame: (T, 6 h, w) derivative of their errors by the unknowns of their frame.
        by_drive: (T h, 6, g) derivative by the unknowns of the drive.
        seen: (s,) columns of a frame by which its views are regular: the pose and, if there are two views, a block of
            which they have different shares. All, if there is none.
    """

    sensor: Sensor
    T_view_world: Array
    by_frame: Array
    by_drive: Array
    seen: IntArray

    @staticmethod
    def of(observer: Observer, unknowns: Unknowns, moment: Moment) -> Views:
        """Return the views at the moments of all frames."""
        sensor, kinds, w = observer.sensor_at(moment.calibration), range(views_of_frame(observer)), unknowns.width
        T_body, frames = np.broadcast_to(sensor.T_cam_imu, moment.T_imu_world.shape), len(moment.T_imu_world)
        if observer.calibration is not None:
            T_body = T_body @ to_exposure(moment.calibration, moment.twist)
        turn, columns = se3.adjoint(T_body), _columns(unknowns)
        T, by_frame = np.empty((frames, len(kinds), 4, 4)), np.zeros((frames, len(kinds), 6, w))
        of_kinds = []
        for kind in kinds:
            T[:, kind], by_frame[:, kind, :, :6] = T_body @ moment.T_imu_world, turn
            if observer.moves_camera:
                offset, shares = observer.camera_offset(moment, np.full(frames, bool(kind)))
                moved = se3.exp(offset)
                T[:, kind], by_offset = T_body @ moved @ moment.T_imu_world, turn @ se3.left_jacobian(offset)
                by_frame[:, kind, :, :6] = turn @ se3.adjoint(moved)
                for block, share in zip(observer.moves_camera, shares, strict=True):
                    by_frame[:, kind, :, columns[block.name]] = share[:, None, None] * by_offset
                of_kinds.append(shares)
        seen = np.arange(6) if len(kinds) == 1 else np.arange(w)
        if len(kinds) == 2:
            apart = [np.abs(one - other).min() for one, other in zip(*of_kinds, strict=True)]
            if max(apart) > 0:
                own = columns[observer.moves_camera[int(np.argmax(apart))].name]
                seen = np.concatenate([np.arange(6), np.arange(own.start, own.stop)])
        by_drive = np.repeat(_by_drive(observer, unknowns, moment), len(kinds), axis=0)
        return Views(sensor, T.reshape(-1, 4, 4), by_frame.reshape(frames, -1, w), by_drive, seen)

    @property
    def rig(self) -> Rig:
        """The sensor, which must be a stereo rig."""
        assert isinstance(self.sensor, Rig)
        return self.sensor

    def points(self, view: IntArray, positions_m: Array) -> Array:
        """Return landmarks (n, 3) in the cameras of views (n,)."""
        T = self.T_view_world[view]
        return np.einsum("nij,nj->ni", T[:, :3, :3], positions_m) + T[:, :3, 3]

    def linearised(self, q: Array, scale: Array) -> tuple[Array, Array]:
        """Return the derivatives of rows by points q (n, 3) and by the errors of their views, (n, d, 3) and (n, d, 6).

        Rows are multiplied by ``scale`` (n, d).
        """
        A = scale[..., None] * self.sensor.jacobian(q)
        x, y, z = q[:, None, 0], q[:, None, 1], q[:, None, 2]
        by_view = np.empty((*A.shape[:2], 6))
        by_view[..., :3] = A
        by_view[..., 3] = y * A[..., 2] - z * A[..., 1]
        by_view[..., 4] = z * A[..., 0] - x * A[..., 2]
        by_view[..., 5] = x * A[..., 1] - y * A[..., 0]
        return A, by_view


def views_of_frame(observer: Observer) -> int:
    """Return the number h of views of a frame."""
    return 2 if observer.has_drift else 1


def _columns(unknowns: Unknowns) -> dict[str, slice]:
    """Return the columns of each shared block among those of a frame."""
    ends = 6 + np.cumsum([block.size for block in unknowns.shared]).astype(int)
    return {b.name: slice(end - b.size, end) for b, end in zip(unknowns.shared, ends.tolist(), strict=True)}


def _by_drive(observer: Observer, unknowns: Unknowns, moment: Moment) -> Array:
    """Return the derivative (T, 6, g) of the errors of all cameras by the unknowns of the drive."""
    frames, calibration = len(moment.T_imu_world), observer.calibration
    found = np.zeros((frames, 6, len(unknowns.drive_columns)))
    if calibration is None:
        return found
    own = drive_place(observer, unknowns)
    found[..., own[calibration.extrinsic]] = calibration.camera_by_extrinsic(moment.calibration)
    if observer.has_time_offset:
        turn = se3.adjoint(observer.sensor_at(moment.calibration).T_cam_imu)
        found[..., own[calibration.free == TIME]] = -(moment.twist @ turn.T)[..., None]
    return found


def drive_place(observer: Observer, unknowns: Unknowns) -> IntArray:
    """Return the places of the calibration's columns among those of the drive."""
    calibration = observer.calibration
    assert calibration is not None
    at = observer.layout[calibration.name]
    return np.searchsorted(unknowns.drive_columns, np.arange(at.start, at.stop))
