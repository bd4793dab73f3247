"""The state of the joint filter: blocks, landmarks, and their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.engine.choice import uses_engine
from ekfslam.engine.face import Engine
from ekfslam.errors import ConfigError
from ekfslam.filters.coordinates import CameraCoordinates
from ekfslam.filters.gaussian import Gaussian
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.models.blocks import PreviousView, View
from ekfslam.models.build import has_image_coordinates
from ekfslam.models.model import Model
from ekfslam.models.sensors.base import Sensor


@dataclass(frozen=True)
class Mean:
    """Mean at which observations are linearised."""

    values: dict[str, Array]  # values of the blocks
    position_m: Array  # (n, 3) landmarks
    imu_twist: Array  # (6,) velocity of the IMU at the image, for a time offset, eq. (9).


@dataclass(frozen=True)
class Motion:
    """The last prediction, eq. (1); before the first one, an empty one."""

    T_departed: Array  # (4, 4) T_imu_world before it
    T_predicted: Array  # (4, 4) predicted T_imu_world of this frame
    # W_predicted, W_predicted_before: (4, 4) first estimates of the view of this frame and of that of the one before.
    W_predicted: Array
    W_predicted_before: Array
    interval: Interval  # inputs
    way_m: Array  # length of the way
    T_cam_imu_before: Array  # (4, 4) extrinsics of the frame before, after its update: the view's for the pose
    # (body, body) covariance of the noise that the process added, to the view, too; empty if the engine predicts.
    Q: Array
    # (4, 4) motion over the interval before, T_departed = last T, and its duration in s, if there was one.
    last: tuple[Array, float] | None = None

    @staticmethod
    def none(T_imu_world: Array) -> Motion:
        """Return the motion before the first prediction."""
        nowhere = Interval.of_one(np.zeros(6), 0.0)
        T, one = T_imu_world, np.eye(4)
        return Motion(T, T, one, one, nowhere, np.zeros(()), one, np.zeros((0, 0)))

    def doubted(self, doubt: float) -> Motion:
        """Return the motion with a factor of the inputs' standard deviations."""
        return replace(self, interval=replace(self.interval, doubt=doubt), Q=doubt**2 * self.Q)

    @property
    def tau_s(self) -> float:
        """Duration of the interval."""
        return self.interval.tau_s


class Estimate:
    """Mean and covariance of all state blocks and active landmarks.

    Args:
        model: Blocks, sensor and noise.
        config: Settings of the filter.
        is_joint: Whether landmarks will come; blocks alone need no engine.

    Raises:
        ConfigError: Landmarks in image coordinates, but no view in the model.

    Attributes:
        values: Estimate of every state block by name.
        coordinates: (body,) coordinates of the blocks, as in the log.
        imu_twist: (6,) velocity of the IMU at the last frame, for a time offset, eq. (9).
        engine: Mean and covariance in C++; None in the reference filter.
        step: Number of predictions so far.
        updated_view: Block of the last updated view: ``view`` between an update and the next prediction, then
            ``previous_view``. None: the observations of the frame before have not updated it.
        images: Image coordinates, eq. (7'); None with ``xyz``.
    """

    def __init__(self, model: Model, config: FilterConfig, is_joint: bool = True) -> None:
        self.model, self.config = model, config
        self.variant = VARIANTS[config.variant]
        self.values = model.initial_values()
        self.coordinates, self.imu_twist = model.initial_coordinates, np.zeros(6)
        self._table: LandmarkTable | None = LandmarkTable(model.sensor.dimension)
        self.engine = Engine(model, config) if is_joint and uses_engine(model, config) else None
        if self.engine is not None:
            self.gaussian = cast(Gaussian, self.engine)  # it has the verbs that are used outside of a frame
        else:
            self.gaussian = Gaussian(model.prior_covariance, model.layout.seen)
        self.motion, self.step = Motion.none(self.values["pose"]), 0
        self.updated_view: str | None = View.name
        self.images: CameraCoordinates | None = None
        if has_image_coordinates(model.sensor, config.landmark_coordinates):
            if not {View.name, PreviousView.name} <= model.layout.keys():
                raise ConfigError("filter.landmark_coordinates: 'image' needs views, see model_of")
            self.images = CameraCoordinates(model.sensor, config.min_depth_m)

    @property
    def table(self) -> LandmarkTable:
        """The active landmarks, in the order of their blocks in P; a copy of the engine's."""
        if self._table is None:
            assert self.engine is not None
            self._table = LandmarkTable(self.sensor.dimension)
            self._table.append(**self.engine.table())
        return self._table

    def forget_table(self) -> None:
        """Forget the copy of the engine's table, which changes."""
        self._table = None

    @property
    def mean(self) -> Mean:
        """The present mean."""
        return Mean(self.values, self.table.position_m, self.imu_twist)

    def without_landmarks(self) -> Estimate:
        """Return an estimate of the blocks alone, to look ahead with `ekfslam.filters.prediction.predict`."""
        alone, body = Estimate(self.model, self.config, False), self.model.layout.body
        alone.values, alone.coordinates, alone.imu_twist = self.values, self.coordinates, self.imu_twist
        alone.motion, alone.step, alone.updated_view = self.motion, self.step, self.updated_view
        alone.gaussian = Gaussian(self.gaussian.body_covariance[:body, :body], self.model.layout.seen)
        return alone

    @property
    def P(self) -> Array:
        """(b+3n, b+3n) covariance of the blocks, in the columns of ``model.layout``, and of ``(d_1, ..., d_n)``.

        The pose has the first six columns. Considered columns, if any (`ekfslam.filters.references`), stand between
        blocks and landmarks.
        """
        return self.gaussian.P

    @P.setter
    def P(self, P: Array) -> None:
        self.gaussian.replace(np.ascontiguousarray(P, dtype=float))

    @property
    def sensor(self) -> Sensor:
        """Sensor of the landmarks, with the given calibration."""
        return self.model.sensor

    @property
    def T_imu_world(self) -> Array:
        """(4, 4) estimated inverse pose of the IMU, as in the report."""
        return self.values["pose"]

    @property
    def T_world_imu(self) -> Array:
        """(4, 4) estimated pose of the IMU."""
        return se3.inverse(self.T_imu_world)

    @property
    def ids(self) -> IntArray:
        """(n,) ids of the active landmarks, in the order of their blocks in P."""
        return self.table.id

    @property
    def positions_m(self) -> Array:
        """(n, 3) their positions in world."""
        return self.table.position_m.copy()

    @property
    def linear_positions_m(self) -> Array:
        """(n, 3) positions at which H is taken, eq. (4)."""
        return self.variant.linear(self.table.position_m, self.table.initial_m)

    @property
    def linear_T_imu_world(self) -> Array:
        """(4, 4) pose at which H is taken."""
        return self.variant.linear(self.T_imu_world, self.motion.T_predicted)

    @property
    def curved(self) -> Array:
        """(v,) values of the curved blocks, as in the log."""
        return np.concatenate([np.empty(0), *(self.values[block.name] for block in self.model.layout.curved)])

    def covariance_of(self, ids: IntArray) -> Array:
        """Return the joint covariance (b+3k, b+3k) of the blocks and of some active landmarks."""
        joint = self.gaussian.covariance_of(self.slots(ids))
        kept = np.delete(np.arange(len(joint)), slice(self.model.layout.body, self.gaussian.body))
        return joint[np.ix_(kept, kept)]

    def slots(self, ids: IntArray) -> IntArray:
        """Return the slots (k,) of active landmarks; raise a `KeyError` for others."""
        slot, is_known = self.table.lookup(np.asarray(ids))
        if not is_known.all():
            raise KeyError(f"landmark ids {np.asarray(ids)[~is_known].tolist()} are not active")
        return slot
