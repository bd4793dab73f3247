"""Scale and misalignment of the axes of a gyroscope and an accelerometer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import ConfigError
from ekfslam.models.blocks.base import StateBlock, optional_block

_ROW, _COLUMN = (np.array(part) for part in ((0, 1, 1, 2, 2, 2), (0, 0, 1, 0, 1, 2)))  # of the accelerometer
_AXES = "xyz"


@optional_block
@dataclass(frozen=True)
class ImuScale(StateBlock):
    """Matrices of an inertial unit, one set for the drive: ``w = (I + D_g) w_m - bg``, ``f = (I + D_a) f_m - ba``.

    ``D_g`` (3, 3) is full: it turns the gyroscope's axes against those of the accelerometer, too. ``D_a`` is lower
    triangular: the accelerometer's x axis, and the plane of x and y, are those of the IMU. The value has the nine
    entries of ``D_g``, row by row, then the six of ``D_a``; they are 0 for a unit as calibrated. Source: Rehder,
    Nikolic, Schneider, Hinzmann, Siegwart, "Extending kalibr", ICRA 2016.

    Args:
        gyro_scale, accel_scale: Standard deviations of the scales, each axis.
        gyro_misalignment_rad, accel_misalignment_rad: Those of the other entries.
    """

    gyro_scale: float = 0.01
    gyro_misalignment_rad: float = 0.01
    accel_scale: float = 0.01
    accel_misalignment_rad: float = 0.01

    name = "imu_scale"
    size = 15
    labels = (
        *(f"gyroscope {i}{j}" for i in _AXES for j in _AXES),
        *(f"accelerometer {_AXES[i]}{_AXES[j]}" for i, j in zip(_ROW, _COLUMN, strict=True)),
    )
    units = ("1",) * 15

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if not 0 < value < np.inf:
                raise ConfigError(f"blocks.{self.name}.{key} must be positive, found {value}")

    def prior_covariance(self) -> Array:
        gyro = np.where(np.eye(3, dtype=bool), self.gyro_scale, self.gyro_misalignment_rad).ravel()
        accel = np.where(_ROW == _COLUMN, self.accel_scale, self.accel_misalignment_rad)
        return np.diag(np.concatenate([gyro, accel]) ** 2)


def applied(value: Array, inputs: Array) -> Array:
    """Return samples ``[w; f]`` (..., 6) with the matrices of a value (15,) applied."""
    return inputs + np.einsum("...ij,j->...i", by_value(inputs), value)


def by_value(inputs: Array) -> Array:
    """Return the derivative (..., 6, 15) of samples (..., 6) with the matrices applied, by their value."""
    by = np.zeros((*inputs.shape, 15))
    for i in range(3):
        by[..., i, 3 * i : 3 * i + 3] = inputs[..., :3]
    by[..., 3 + _ROW, 9 + np.arange(6)] = inputs[..., 3 + _COLUMN]
    return by
