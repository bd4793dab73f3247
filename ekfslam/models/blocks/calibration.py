"""The stereo rig's calibration as a state block: its parameters and their Jacobians.

With nine parameters c the rig sees ``q = exp(c_0..5^) T_cam_imu exp(-c_time u^) T_imu_world m``, eq. (9), its
baseline is ``b exp(c_baseline)``, and its disparities come out larger by ``c_disparity``. All are 0 for the calibration
as given and change additively. ``u`` are the velocities of the IMU: images are exposed ``c_time`` later than stamped.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import CalibrationConfig
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks.base import Layout, StateBlock, Values
from ekfslam.models.observation import linearise
from ekfslam.models.sensors.stereo import Rig

NAMES = (
    *("camera x", "camera y", "camera z", "camera rotation x", "camera rotation y", "camera rotation z"),
    *("ln baseline", "disparity offset", "time offset"),
)
UNITS = ("m", "m", "m", "rad", "rad", "rad", "1", "px", "s")
_EXTRINSIC, _BASELINE, _DISPARITY, TIME = slice(0, 6), 6, 7, 8
_ROTATION = slice(3, 6)


def prior_std(config: CalibrationConfig) -> Array:
    """Return prior standard deviations (9,) of the parameters, in their `UNITS`; 0 takes one as given."""
    camera = np.repeat([config.lever_arm_m, np.deg2rad(config.rotation_deg or 0.0)], 3)
    return np.array([*camera, config.baseline, config.disparity_px or 0.0, config.time_s])


@dataclass(frozen=True)
class Calibration(StateBlock):
    """Calibration parameters of a `Rig`, one set for the drive; its value is all nine, its error the free ones.

    Args:
        std: (9,) prior standard deviations; parameters with 0 are not free.
    """

    std: Array

    name = "calibration"
    coupling = "sensor"
    retraction = "calibration"
    is_seen = True

    @cached_property
    def free(self) -> IntArray:
        """Indices of the free parameters among the nine."""
        return np.flatnonzero(self.std)

    @property
    def size(self) -> int:
        return len(self.free)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(NAMES[i] for i in self.free)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(UNITS[i] for i in self.free)

    def initial(self) -> Array:
        return np.zeros(9)

    def prior_covariance(self) -> Array:
        return np.diag(self.std[self.free] ** 2)

    def retract(self, value: Array, correction: Array) -> Array:
        moved = value.copy()
        moved[..., self.free] += correction
        return moved

    def reported(self, values: Values, covariance: Array, layout: Layout) -> tuple[Array, Array]:
        return values[self.name][self.free], np.sqrt(np.diag(covariance)[layout[self.name]])

    @cached_property
    def extrinsic(self) -> IntArray:
        """Columns of the block that move or turn the camera."""
        return np.flatnonzero(self.free < _EXTRINSIC.stop)

    def camera_by_extrinsic(self, parameters: Array) -> Array:
        """Return the derivative (6, e) of the camera's pose error by the columns `extrinsic`."""
        return np.asarray(se3.left_jacobian(parameters[_EXTRINSIC])[:, self.free[self.extrinsic]], dtype=float)

    @cached_property
    def turns_camera(self) -> IntArray:
        """Columns of the block that turn the camera."""
        return np.flatnonzero((self.free >= _ROTATION.start) & (self.free < _ROTATION.stop))

    def linearise(
        self,
        rig: Rig,
        parameters: Array,
        twist: Array,
        T_imu_world: Array,
        positions_m: Array,
        T_linear: Array,
        linear_positions_m: Array,
    ) -> tuple[Array, Array, Array, Array]:
        """Linearise eq. (4) at parameters (9,), with the `calibrated` rig and velocities (6,) or (n, 6) of the IMU.

        Returns:
            Values of `ekfslam.models.observation.linearise`, with H (n, 3, size) by the free parameters before H_m.
        """
        delay = to_exposure(parameters, twist)
        q, H_x, H_m = linearise(rig, delay @ T_imu_world, positions_m, delay @ T_linear, linear_positions_m)
        T_cam_linear = rig.T_cam_imu @ delay @ T_linear
        H = np.zeros((len(q), 3, 9))
        if len(self.extrinsic):
            # First estimates here, too: turning the camera and all landmarks about it must stay unobservable.
            q_linear = se3.apply(T_cam_linear, linear_positions_m)
            A = H_m @ T_cam_linear[..., :3, :3].swapaxes(-1, -2)
            moved = np.concatenate([A, -A @ se3.skew(q_linear)], axis=-1)
            H[..., _EXTRINSIC] = moved @ se3.left_jacobian(parameters[_EXTRINSIC])
        if len(self.intrinsic):
            H[..., _BASELINE : _DISPARITY + 1] = self.by_intrinsics(rig, q)
        H[..., TIME] = -(H_x @ twist[..., None])[..., 0]
        return q, H_x @ se3.adjoint(delay), H[..., self.free], H_m

    @cached_property
    def intrinsic(self) -> IntArray:
        """Columns of the block that change the rows of a point in the camera."""
        return np.flatnonzero((self.free == _BASELINE) | (self.free == _DISPARITY))

    def by_intrinsics(self, rig: Rig, q: Array) -> Array:
        """Return the derivatives (n, 3, 2) of the rows of points (n, 3) by the parameters of baseline and disparity."""
        return np.stack([rig.by_log_baseline(q), rig.by_disparity(q)], axis=-1)

    def landmarks_by_rotation(self, rig: Rig, parameters: Array, T_imu_world: Array, moved_m: Array) -> Array:
        """Return the landmark errors (n, 3, 3) by the camera's rotation after a correction by ``moved_m`` (n, 3).

        If camera and landmarks turn about it as one, images stay the same. So errors count in the camera's frame; in
        world the filter would learn the rotation from noise. Pose (4, 4) and parameters (9,) are those before the
        correction.
        """
        R_world_cam = (se3.exp(parameters[_EXTRINSIC]) @ rig.T_cam_imu @ T_imu_world)[:3, :3].T
        by_rotation = se3.skew(moved_m) @ R_world_cam @ se3.so3_left_jacobian(parameters[_ROTATION])
        return by_rotation[..., self.free[self.turns_camera] - _ROTATION.start]


def calibrated(rig: Rig, parameters: Array) -> Rig:
    """Return the rig with parameters (9,) applied, all but the time offset."""
    camera = rig.camera
    return dataclasses.replace(
        rig,
        camera=dataclasses.replace(camera, baseline_m=camera.baseline_m * float(np.exp(parameters[_BASELINE]))),
        T_cam_imu=se3.exp(parameters[_EXTRINSIC]) @ rig.T_cam_imu,
        disparity_offset_px=rig.disparity_offset_px + float(parameters[_DISPARITY]),
    )


def to_exposure(parameters: Array, twist: Array) -> Array:
    """Return the motion (..., 4, 4) from stamps to exposures, by which ``T_imu_world`` is premultiplied."""
    return motion.increment(twist, parameters[TIME])
