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
from ekfslam.models.sensors.stereo import Rig

NAMES = (
    *("camera x", "camera y", "camera z", "camera rotation x", "camera rotation y", "camera rotation z"),
    *("ln baseline", "disparity offset", "time offset"),
)
UNITS = ("m", "m", "m", "rad", "rad", "rad", "1", "px", "s")
_EXTRINSIC, _BASELINE, _DISPARITY, TIME = slice(0, 6), 6, 7, 8


def prior_std(config: CalibrationConfig) -> Array:
    """Return prior standard deviations (9,) of the parameters, in their `UNITS`; 0 takes one as given."""
    camera = np.repeat([config.lever_arm_m, np.deg2rad(config.rotation_deg or 0.0)], 3)
    return np.array([*camera, config.baseline, config.disparity_px or 0.0, config.time_s])


@dataclass(frozen=True)
class Calibration(StateBlock):
    """Calibration parameters of a `Rig`, one set for the drive; its value is all nine, its error the free ones."""

    std: Array  # (9,) prior standard deviations; parameters with 0 are not free

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
        return values[self.name][self.free], np.sqrt(covariance.diagonal()[layout[self.name]])

    def camera_by(self, parameters: Array, T_cam_imu: Array, twist: Array) -> Array:
        """Return the derivative (..., 6, size) of the error of the camera in world, eq. (9), by the free parameters.

        ``T_cam_imu`` (4, 4) has the parameters (9,) applied; ``twist`` (..., 6) are velocities of the IMU.
        """
        by = np.zeros((*twist.shape, 9))
        by[..., _EXTRINSIC] = se3.left_jacobian(parameters[_EXTRINSIC])
        by[..., TIME] = -(se3.adjoint(T_cam_imu) @ twist[..., None])[..., 0]
        return by[..., self.free]

    @cached_property
    def intrinsic(self) -> IntArray:
        """Columns of the block that change the rows of a camera that stays where it is."""
        return np.flatnonzero((self.free == _BASELINE) | (self.free == _DISPARITY))

    def rows_by_intrinsic(self, rig: Rig, q: Array) -> Array:
        """Return the derivative (n, 3, i) of the rows of a `calibrated` rig by the columns `intrinsic`."""
        by = {_BASELINE: rig.by_log_baseline, _DISPARITY: rig.by_disparity}
        columns = [by[i](q) for i in self.free[self.intrinsic]]
        return np.stack(columns, axis=-1) if columns else np.empty((*q.shape, 0))


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
