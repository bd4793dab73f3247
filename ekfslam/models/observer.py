"""Landmarks as a sensor sees them, given the blocks that observations depend on: eq. (3) to (5), (9) and (11)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.blocks import Calibration, Layout, StateBlock, Values
from ekfslam.models.blocks.calibration import TIME, calibrated, to_exposure
from ekfslam.models.observation import linearise
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig

# Calibration parameters that are as given.
GIVEN = np.zeros(9)


@dataclass(frozen=True)
class Moment:
    """Everything but landmarks that observations of one frame depend on.

    Args:
        T_imu_world: (..., 4, 4) pose.
        T_linear: (..., 4, 4) pose at which its error is linearised: the same, or (FEJ) the predicted one.
        calibration: (9,) parameters.
        twist: (..., 6) velocities of the IMU, for the time offset.
        shared: Values (..., size) of the blocks in `Model.shared`, by name.
        way_m: (...) way driven since the frame before.
    """

    T_imu_world: Array
    T_linear: Array
    calibration: Array = field(default_factory=lambda: np.zeros(9))
    twist: Array = field(default_factory=lambda: np.zeros(6))
    shared: Values = field(default_factory=dict)
    way_m: Array = field(default_factory=lambda: np.zeros(()))

    def at(self, index: IntArray) -> Moment:
        """Return the moments of observations, given the frame (n,) of each, from a moment of all frames."""
        shared = {name: value[index] for name, value in self.shared.items()}
        way = self.way_m[index] if self.way_m.ndim else self.way_m
        return Moment(self.T_imu_world[index], self.T_linear[index], self.calibration, self.twist[index], shared, way)

    def linearised_at(self, T_linear: Array) -> Moment:
        """Return the moment with its error linearised at another pose."""
        return dataclasses.replace(self, T_linear=T_linear)


@dataclass(frozen=True)
class Seen:
    """Landmarks as the sensor sees them: points ``q`` (n, 3), rows ``z`` (n, d), and Jacobians of the rows.

    ``H_x`` (n, d, seen) is by the leading columns of the layout, ``H_m`` (n, d, 3) by the landmark positions.
    """

    q: Array
    z: Array
    H_x: Array
    H_m: Array


@dataclass(frozen=True)
class Observer:
    """A sensor of landmarks, and the blocks that its observations depend on."""

    sensor: Sensor
    layout: Layout

    @cached_property
    def calibration(self) -> Calibration | None:
        """The block of the sensor's parameters, if it is in the state."""
        return cast(Calibration | None, next(iter(self.layout.coupled("sensor")), None))

    def parameters(self, values: Values) -> Array:
        """Return the calibration parameters (9,), which are 0 if they are not in the state."""
        return GIVEN if self.calibration is None else values[self.calibration.name]

    @property
    def has_time_offset(self) -> bool:
        """Whether observations depend on velocities."""
        return self.calibration is not None and bool(self.calibration.std[TIME])

    @cached_property
    def shared(self) -> tuple[StateBlock, ...]:
        """Blocks of each frame, besides the pose, that observations of all landmarks depend on."""
        return tuple(block for block in self.layout.blocks if block.is_seen and block.per_frame and not block.is_pose)

    @cached_property
    def moves_camera(self) -> tuple[StateBlock, ...]:
        """Blocks that move the camera."""
        return tuple(block for block in self.layout.coupled("camera") if block in self.shared)

    @cached_property
    def has_drift(self) -> bool:
        """Whether a difference of observations sees the present frame otherwise than a single one does."""
        one = np.ones(())
        differs = (block.camera_share(one, one > 0) != block.camera_share(one, one < 0) for block in self.moves_camera)
        return any(differs)

    def see(
        self,
        moment: Moment,
        positions_m: Array,
        linear_positions_m: Array,
        pose: str = "pose",
        is_difference: BoolArray | None = None,
    ) -> Seen:
        """Return landmarks (n, 3) as the sensor sees them, eq. (3), (4), (9) and (11).

        Args:
            positions_m, linear_positions_m: As in `ekfslam.models.observation.linearise`.
            pose: Block whose columns the pose of the moment has: the pose, or a clone. With the clone of the previous
                pose, shared blocks have the columns of their clones, too.
            is_difference: (n,) whether observations are differences from the frame before; None: none is.
        """
        layout, sensor = self.layout, self.sensor_at(moment.calibration)
        T, T_linear, offset = moment.T_imu_world, moment.T_linear, None
        if self.moves_camera:
            offset, shares = self.camera_offset(moment, is_difference)
            moved = se3.exp(offset)
            T, T_linear = moved @ T, moved @ T_linear
        if self.calibration is None:
            q, H_pose, H_m = linearise(sensor, T, positions_m, T_linear, linear_positions_m)
        else:
            assert isinstance(sensor, Rig)
            q, H_pose, H_c, H_m = self.calibration.linearise(
                sensor, moment.calibration, moment.twist, T, positions_m, T_linear, linear_positions_m
            )
        if layout.seen == 6:
            return Seen(q, sensor.predict(q), H_pose, H_m)
        H_x = np.zeros((*H_pose.shape[:2], layout.seen))
        H_x[..., layout[pose]] = H_pose if offset is None else H_pose @ se3.adjoint(moved)
        if self.calibration is not None:
            H_x[..., layout[self.calibration.name]] = H_c
        if offset is not None:
            H_offset = H_pose @ se3.left_jacobian(offset)
            for block, share in zip(self.moves_camera, shares, strict=True):
                if (at := self._columns_in(block, pose)) is not None:
                    H_x[..., at] = share[..., None, None] * H_offset
        return Seen(q, sensor.predict(q), H_x, H_m)

    def _columns_in(self, block: StateBlock, pose: str) -> slice | None:
        """Return the columns of a shared block in a view from a pose; None: the view does not depend on the block."""
        if pose != self.layout.clones.get("pose"):
            return self.layout[block.name]
        clone = self.layout.clones.get(block.name)
        return None if clone is None else self.layout[clone]

    def camera_offset(self, moment: Moment, is_difference: BoolArray | None) -> tuple[Array, list[Array]]:
        """Return the tangent by which shared blocks move the camera, and the share of each, eq. (11).

        Shapes are (n, 6) and (n,) only where observations of one frame differ, and otherwise without n.
        """
        if is_difference is None or not self.has_drift or not is_difference.any():
            is_difference = np.zeros(np.shape(moment.way_m), dtype=bool)
        elif is_difference.all():
            is_difference = np.ones(np.shape(moment.way_m), dtype=bool)
        shares = [block.camera_share(moment.way_m, is_difference) for block in self.moves_camera]
        parts = [
            np.asarray(share)[..., None] * moment.shared[block.name]
            for block, share in zip(self.moves_camera, shares, strict=True)
        ]
        return sum(parts[1:], parts[0]), [np.asarray(share) for share in shares]

    def points(self, moment: Moment, positions_m: Array, is_difference: BoolArray | None = None) -> Array:
        """Return landmarks (n, 3) in the frame of the sensor; arguments as of `see`."""
        return se3.apply(self._T_cam_world(moment, is_difference), positions_m)

    def _T_cam_world(self, moment: Moment, is_difference: BoolArray | None) -> Array:
        T = moment.T_imu_world
        if self.moves_camera:
            T = se3.exp(self.camera_offset(moment, is_difference)[0]) @ T
        if self.calibration is not None:
            T = to_exposure(moment.calibration, moment.twist) @ T
        return self.sensor_at(moment.calibration).T_cam_imu @ T

    def predicted(self, moment: Moment, q: Array) -> Array:
        """Return the rows (n, d) of points (n, 3) in the frame of the sensor."""
        return self.sensor_at(moment.calibration).predict(q)

    def inverted(self, moment: Moment, rows: Array) -> tuple[Array, BoolArray]:
        """Return the points (n, 3) in the sensor's frame that rows (n, 3) see, and whether (n,) they have a depth.

        A calibrated sensor may see disparities below that of infinity, which `screen` of the given one accepts.
        """
        sensor = self.sensor_at(moment.calibration)
        q = sensor.invert(rows)
        if sensor is self.sensor:
            return q, np.ones(len(rows), dtype=bool)
        assert isinstance(sensor, Rig)
        return q, sensor.has_depth(q)

    def initialise(self, moment: Moment, q: Array, variance: Array) -> tuple[Array, Array, Array]:
        """Return positions (n, 3) of new landmarks, G (n, 3, seen), and the measurement's part (n, 3, 3), eq. (5).

        Rows stay the same, ``H_x x + H_m d = 0``, hence ``G = -H_m^-1 H_x``. The moment is that of the first
        observations, q (n, 3) are points of `inverted`, and variance (n, 3) is that of the rows.
        """
        positions = se3.apply(se3.inverse(self._T_cam_world(moment, None)), q)
        here = self.see(moment.linearised_at(moment.T_imu_world), positions, positions)
        by_rows = np.linalg.inv(here.H_m)
        covariance = (by_rows * variance[:, None, :]) @ by_rows.swapaxes(-1, -2)
        G = -by_rows @ here.H_x
        if moment.T_linear is not moment.T_imu_world:
            pose, there = self.layout["pose"], self.see(moment, positions, positions)
            G[..., pose] = -np.linalg.solve(there.H_m, there.H_x[..., pose])
        return positions, G, 0.5 * (covariance + covariance.swapaxes(-1, -2))

    def sensor_at(self, parameters: Array) -> Sensor:
        """Return the sensor with a calibration (9,) applied."""
        return self.sensor if self.calibration is None else calibrated(self.rig, parameters)

    @property
    def rig(self) -> Rig:
        """The sensor, which must be a stereo rig."""
        assert isinstance(self.sensor, Rig)
        return self.sensor
