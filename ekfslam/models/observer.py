"""Landmarks as a sensor sees them, given the blocks that observations depend on: eq. (3) to (5), (9) and (11)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.blocks import Calibration, Layout, StateBlock, Values
from ekfslam.models.blocks.calibration import TIME, calibrated, to_exposure
from ekfslam.models.observation import landmark_by_pose
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig

# Calibration parameters that are as given.
GIVEN = np.zeros(9)


@dataclass(frozen=True)
class Moment:
    """Everything but landmarks that observations of one frame depend on."""

    T_imu_world: Array  # (..., 4, 4) pose
    T_linear: Array  # (..., 4, 4) pose at which its error is linearised: the same, or (FEJ) the predicted one
    calibration: Array = field(default_factory=lambda: np.zeros(9))  # (9,) parameters
    twist: Array = field(default_factory=lambda: np.zeros(6))  # (..., 6) velocities of the IMU, for the time offset
    shared: Values = field(default_factory=dict)  # values (..., size) of the blocks in `Model.shared`, by name
    way_m: Array = field(default_factory=lambda: np.zeros(()))  # (...) way driven since the frame before

    def at(self, index: IntArray | int) -> Moment:
        """Return the moments of observations, given the frame (n,) of each, from a moment of all frames."""
        shared = {name: value[index] for name, value in self.shared.items()}
        way = self.way_m[index] if self.way_m.ndim else self.way_m
        return Moment(self.T_imu_world[index], self.T_linear[index], self.calibration, self.twist[index], shared, way)


@dataclass(frozen=True)
class Camera:
    """The camera of a frame: ``W = T_cam_imu T_imu_world``, with the error ``W_true = exp(z^) W``, ``z = by x``."""

    T_cam_imu: Array  # (..., 4, 4) extrinsics of that frame, with calibration, time offset and shared errors
    by: Array  # (..., 6, seen) Y, derivative of z by the leading columns of the layout

    def at(self, *index: IntArray | int) -> Camera:
        """Return the cameras at indices of the leading dimensions."""
        return Camera(self.T_cam_imu[index], self.by[index])


@dataclass(frozen=True)
class Projected:
    """Landmarks as projected into a camera in world: points ``q`` (n, 3), rows ``z`` (n, d), and Jacobians of the rows.

    ``H_z`` (n, d, 6) is by the error of the camera, ``H_i`` (n, d, i) by the columns `Observer.intrinsic`, ``H_m``
    (n, d, 3) by the landmark positions.
    """

    q: Array
    z: Array
    H_z: Array
    H_i: Array
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
    def intrinsic(self) -> IntArray:
        """Columns (i,) of the layout that change rows while the camera stays where it is."""
        calibration = self.calibration
        if calibration is None:
            return np.empty(0, dtype=np.int64)
        return self.layout[calibration.name].start + calibration.intrinsic

    # --- the camera in world ------------------------------------------------------------------------------------------

    def camera(self, moment: Moment, is_difference: BoolArray | bool = False) -> Camera:
        """Return the camera ``C D exp(o^)`` of a moment and its derivative, eq. (9) and (11).

        ``C = exp(c^) T_cam_imu`` has the calibration, D leads to the exposure, o is the sum of the shares of blocks. A
        difference of observations (...), eq. (10), may see another one than a single observation.
        """
        C, CD, offset, shares = self._parts(moment, is_difference)
        T, layout = CD, self.layout
        if offset is not None:
            T = CD @ se3.exp(offset)
        shape = np.broadcast_shapes(moment.T_imu_world.shape[:-2], T.shape[:-2], np.shape(is_difference))
        by = np.zeros((*shape, 6, layout.seen))
        by[..., layout["pose"]] = se3.adjoint(T)
        if offset is not None:
            by_offset = se3.adjoint(CD) @ se3.left_jacobian(offset)
            for block, share in zip(self.moves_camera, shares, strict=True):
                by[..., layout[block.name]] = share[..., None, None] * by_offset
        if self.calibration is not None:
            by[..., layout[self.calibration.name]] = self.calibration.camera_by(moment.calibration, C, moment.twist)
        return Camera(np.broadcast_to(T, (*shape, 4, 4)), by)

    def cameras(self, moment: Moment) -> Camera:
        """Return the cameras (2, ...) of single observations and of differences."""
        shape = moment.T_imu_world.shape[:-2]
        if not self.has_drift:
            one = self.camera(moment)
            return Camera(*(np.broadcast_to(part, (2, *part.shape)) for part in (one.T_cam_imu, one.by)))
        is_difference = np.array([False, True]).reshape(2, *(1 for _ in shape))
        return self.camera(moment, np.broadcast_to(is_difference, (2, *shape)))

    @cached_property
    def moves_camera(self) -> tuple[StateBlock, ...]:
        """Blocks that move the camera."""
        return tuple(block for block in self.layout.coupled("camera") if block in self.shared)

    def _parts(self, moment: Moment, is_difference: BoolArray | bool) -> tuple[Array, Array, Array | None, list[Array]]:
        """Return C, C D, o (..., 6) or None, and the shares (...) of blocks in o."""
        C = CD = self.sensor_at(moment.calibration).T_cam_imu
        if self.calibration is not None:
            CD = C @ to_exposure(moment.calibration, moment.twist)
        if not self.moves_camera:
            return C, CD, None, []
        shape = np.broadcast_shapes(np.shape(is_difference), np.shape(moment.way_m))
        kind = np.broadcast_to(np.asarray(is_difference), shape)
        shares = [np.asarray(block.camera_share(moment.way_m, kind)) for block in self.moves_camera]
        parts = [s[..., None] * moment.shared[block.name] for s, block in zip(shares, self.moves_camera, strict=True)]
        return C, CD, sum(parts[1:], parts[0]), shares

    @cached_property
    def has_drift(self) -> bool:
        """Whether a difference of observations sees the present frame otherwise than a single one does."""
        one = np.ones(())
        differs = (block.camera_share(one, one > 0) != block.camera_share(one, one < 0) for block in self.moves_camera)
        return any(differs)

    # --- landmarks ----------------------------------------------------------------------------------------------------

    def project(
        self,
        parameters: Array,
        T_cam_world: Array,
        positions_m: Array,
        T_linear: Array | None = None,
        linear_positions_m: Array | None = None,
    ) -> Projected:
        """Return landmarks (n, 3) as a camera in world sees them, eq. (3) and (4).

        The calibration (9,) counts by its intrinsics. A is taken at the estimates, the rest at the linear ones: by
        default the same, or (FEJ) the first ones.
        """
        sensor, q = self.sensor_at(parameters), se3.apply(T_cam_world, positions_m)
        if T_linear is None or linear_positions_m is None:
            T_linear, linear_positions_m = T_cam_world, positions_m
        A, q_linear = sensor.jacobian(q), se3.apply(T_linear, linear_positions_m)
        H_z = np.concatenate([A, -A @ se3.skew(q_linear)], axis=-1)
        H_i = np.empty((*A.shape[:-1], 0))
        if self.calibration is not None:
            assert isinstance(sensor, Rig)
            H_i = self.calibration.rows_by_intrinsic(sensor, q)
        return Projected(q, sensor.predict(q), H_z, H_i, A @ T_linear[..., :3, :3])

    def by_body(self, seen: Projected, by: Array) -> Array:
        """Return the rows' derivative H_x (n, d, seen), given that of the camera's error (6, seen) or (n, 6, seen)."""
        H_x = seen.H_z @ by
        H_x[..., self.intrinsic] += seen.H_i
        return H_x

    def inverted(self, parameters: Array, rows: Array) -> tuple[Array, BoolArray]:
        """Return the points (n, 3) in the sensor's frame that rows (n, 3) see, and whether (n,) they have a depth.

        A calibrated sensor may see disparities below that of infinity, which `screen` of the given one accepts.
        """
        sensor = self.sensor_at(parameters)
        q = sensor.invert(rows)
        if sensor is self.sensor:
            return q, np.ones(len(rows), dtype=bool)
        assert isinstance(sensor, Rig)
        return q, sensor.has_depth(q)

    def initialise(
        self, parameters: Array, T_cam_world: Array, T_linear: Array, by: Array, q: Array, variance: Array
    ) -> tuple[Array, Array, Array]:
        """Return positions (n, 3) of new landmarks, G (n, 3, seen), and the measurement's part (n, 3, 3), eq. (5).

        Rows stay the same, ``H_z z + H_i x + H_m d = 0``. G is taken at ``T_linear``: the camera, or (FEJ) the
        predicted one. ``by`` (6, seen) is the derivative of the camera's error, q (n, 3) are points of `inverted`.
        """
        positions = se3.apply(se3.inverse(T_cam_world), q)
        here = self.project(parameters, T_cam_world, positions)
        by_rows = np.linalg.inv(here.H_m)
        covariance = (by_rows * variance[:, None, :]) @ by_rows.swapaxes(-1, -2)
        G = landmark_by_pose(T_linear, positions) @ by
        G[..., self.intrinsic] -= by_rows @ here.H_i
        return positions, G, 0.5 * (covariance + covariance.swapaxes(-1, -2))

    def sensor_at(self, parameters: Array) -> Sensor:
        """Return the sensor with a calibration (9,) applied."""
        return self.sensor if self.calibration is None else calibrated(self.rig, parameters)

    @property
    def rig(self) -> Rig:
        """The sensor, which must be a stereo rig."""
        assert isinstance(self.sensor, Rig)
        return self.sensor
