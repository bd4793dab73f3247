"""What the joint filter knows at one moment: the blocks, the landmarks, and their joint covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.errors import ConfigError
from ekfslam.filters.conditional import ConditionalGaussian
from ekfslam.filters.coordinates import CameraCoordinates, Change, View
from ekfslam.filters.dense import DenseGaussian
from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.models.build import has_image_coordinates
from ekfslam.models.model import Model, Moment, Seen
from ekfslam.models.sensors.base import Sensor

# Calibration parameters where they are as given.
GIVEN = np.zeros(9)


@dataclass(frozen=True)
class Moved:
    """What a correction leads to.

    Args:
        values: Of the blocks.
        position_m: (n, 3) landmarks.
        awake, asleep: Slots of those that were moved in the camera, eq. (7'), and of all others, moved in world.
        in_image: Which of the former (k,) by their images.
        before: How the camera had them before; None: none was moved in it.
    """

    values: dict[str, Array]
    position_m: Array
    awake: IntArray
    asleep: IntArray
    in_image: BoolArray
    before: View | None


class Estimate:
    """Mean and covariance of all state blocks and active landmarks.

    Args:
        model: Blocks, sensor and noise.
        config: Variant, gate, limits, and the form of the covariance (``auto`` counts as ``dense``).

    Raises:
        ConfigError: Landmarks in image coordinates, but no clone of the last pose in the model.

    Attributes:
        model, config: As given.
        variant: What is the variant's own.
        values: Estimate of every state block by name.
        coordinates: (body,) of the blocks, as in the log.
        table: The active landmarks, in the order of their blocks in P.
        gaussian: The covariance.
        T_predicted, T_predicted_before: (4, 4) ``T_imu_world`` before the last update, and before the one before.
        updated_pose: Block of the pose that was updated last: ``pose`` itself between an update and the next
            prediction, then ``previous_pose``. None: what was seen in the frame before has not updated it.
        T_departed: (4, 4) pose from which the last prediction led.
        imu_twist, imu_twist_before: (6,) velocities of the IMU that led to the last frame, and to the one before.
        tau_s, way_m: How long the last prediction took, and how far it led; 0 before the first one.
        step: Number of predictions so far.
    """

    def __init__(self, model: Model, config: FilterConfig) -> None:
        self.model, self.config = model, config
        self.variant = VARIANTS[config.variant]
        self.values = model.initial_values()
        self.coordinates = np.zeros(model.layout.body)
        self.table = LandmarkTable(model.sensor.dimension)
        form = ConditionalGaussian if config.covariance_form == "conditional" else DenseGaussian
        self.gaussian: Gaussian = form(model.prior_covariance, model.layout.seen)
        self.T_predicted = self.T_predicted_before = self.T_departed = self.values["pose"]
        self.imu_twist = self.imu_twist_before = np.zeros(6)
        self.tau_s, self.way_m, self.step = 0.0, np.zeros(()), 0
        self.updated_pose: str | None = "pose"
        self._cameras: dict[str, CameraCoordinates] = {}
        if has_image_coordinates(model.sensor, config.landmark_coordinates):
            if not model.has_clone:
                raise ConfigError("filter.landmark_coordinates: 'image' needs previous_pose in the model, see model_of")
            for name in ("pose", "previous_pose"):
                self._cameras[name] = CameraCoordinates(model, name, config.min_depth_m)

    @property
    def P(self) -> Array:
        """(b+3n, b+3n) covariance of the blocks, in the columns of ``model.layout``, and of ``(d_1, ..., d_n)``.

        ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. The pose has the first six columns. Columns that are only
        considered (`ekfslam.filters.references`) stand between blocks and landmarks where a run asks for them.
        """
        return self.gaussian.P

    @P.setter
    def P(self, P: Array) -> None:
        self.gaussian.replace(np.ascontiguousarray(P, dtype=float))

    @property
    def sensor(self) -> Sensor:
        """What observes the landmarks, with the calibration as given."""
        return self.model.sensor

    @property
    def T_imu_world(self) -> Array:
        """(4, 4) estimate of the report's inverse pose."""
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
        return self.variant.linear(self.T_imu_world, self.T_predicted)

    @property
    def up_world(self) -> Array:
        """(3,) direction against gravity where it is estimated, else (0,)."""
        return self.values.get("up", np.empty(0))

    def covariance_of(self, ids: IntArray) -> Array:
        """Joint covariance (b+3k, b+3k) of the blocks and of some active landmarks.

        Raises:
            KeyError: An id is not active.
        """
        joint = self.gaussian.covariance_of(self._slots(ids))
        kept = np.delete(np.arange(len(joint)), slice(self.model.layout.body, self.gaussian.body))
        return joint[np.ix_(kept, kept)]

    def measurement_jacobian(self, ids: IntArray) -> sp.csr_array:
        """Full-width H (3k, b+3n) of the sensor's rows of active landmarks ``ids`` (k,), for inspection and tests.

        Raises:
            KeyError: An id is not active.
        """
        slot = self._slots(ids)
        seen = self.model.see(self.moment(), self.positions_m[slot], self.linear_positions_m[slot])
        k, d, width = seen.H_x.shape
        row = np.broadcast_to(np.arange(k * d).reshape(k, d, 1), (k, d, width + 3))
        body = np.broadcast_to(np.arange(width), (k, d, width))
        own = np.broadcast_to((self.gaussian.body + 3 * slot)[:, None, None] + np.arange(3), (k, d, 3))
        columns = np.concatenate([body, own], axis=-1)
        values = np.concatenate([seen.H_x, seen.H_m], axis=-1)
        return sp.csr_array((values.ravel(), (row.ravel(), columns.ravel())), shape=(k * d, len(self.P)))

    def transition_jacobian(self, twist: Array, tau_s: float) -> sp.csr_array:
        """Return the full-width F (b+3n, b+3n) of a step by a velocity (6,), identity but for the rows of the body."""
        interval = Interval.of_one(twist, tau_s)
        step = self.model.step(self.values, interval, self.linear_T_imu_world, self.variant.first_estimates)
        full = sp.lil_array(sp.identity(len(self.P)))
        full[: len(step.Phi), : len(step.Phi)] = step.Phi
        return sp.csr_array(full)

    def _slots(self, ids: IntArray) -> IntArray:
        slot, is_known = self.table.lookup(np.asarray(ids))
        if not is_known.all():
            raise KeyError(f"landmark ids {np.asarray(ids)[~is_known].tolist()} are not active")
        return slot

    # --- what is seen from here ---------------------------------------------------------------------------------------

    def moment(self) -> Moment:
        """From where landmarks are seen now."""
        shared = {block.name: self.values[block.name] for block in self.model.shared}
        calibration = self.values.get("calibration", GIVEN)
        return Moment(self.T_imu_world, self.linear_T_imu_world, calibration, self.imu_twist, shared, self.way_m)

    def moment_before(self) -> Moment:
        """From where they were seen in the frame before, as far as the clone knows."""
        T = self.values["previous_pose"]
        T_linear = self.variant.linear(T, self.T_predicted_before)
        clones = self.model.layout.clones
        shared = {block.name: self.values[clones.get(block.name, block.name)] for block in self.model.shared}
        return Moment(T, T_linear, self.values.get("calibration", GIVEN), self.imu_twist_before, shared)

    def observe(self, slot: IntArray, measured: Array) -> tuple[Seen, Rows]:
        """Landmarks at the slots (k,) as they are seen now, and the measurement rows of what was ``measured`` (k, d).

        Where tracks err, eq. (10), an observation that follows another one is the difference from it.
        """
        positions, linear = self.table.position_m[slot], self.linear_positions_m[slot]
        error = self.model.track_error
        is_difference = (self.table.last_step[slot] == self.step - 1) & (error is not None)
        seen = self.model.see(self.moment(), positions, linear, is_difference=is_difference)
        H_x, H_m, residual = seen.H_x, seen.H_m, measured - seen.z
        if error is None:
            return seen, Rows(slot, H_x, H_m, residual, self.sensor.variance(measured))
        variance = error.absolute_variance(self.step - self.table.first_step[slot])
        follows = np.flatnonzero(is_difference)
        if len(follows):
            before = self.model.see(self.moment_before(), positions[follows], linear[follows], "previous_pose")
            rows_before = self.table.seen_rows[slot[follows]]
            H_x, H_m = H_x.copy(), H_m.copy()
            residual[follows] -= error.memory * (rows_before - before.z)
            H_x[follows] -= error.memory * before.H_x
            H_m[follows] -= error.memory * before.H_m
            variance[follows] = error.step_variance(measured[follows] - rows_before)
        return seen, Rows(slot, H_x, H_m, residual, variance)

    # --- how a correction changes it ----------------------------------------------------------------------------------

    def parts(self, correction: Array) -> tuple[Array, Array]:
        """What observations depend on (seen,), and the landmarks' part (n, 3) of a correction."""
        return correction[: self.gaussian.seen], correction[self.gaussian.body :].reshape(-1, 3)

    def retracted(self, correction: Array) -> Moved:
        """Blocks and landmarks after a correction (b+3n,); the estimate stays.

        Landmarks that are awake move in the camera that was updated last. Those that are asleep move in world: their
        images are of no account, and would lose digits far from the camera.
        """
        x, d = self.parts(correction)
        after, positions = self.model.retract(self.values, correction), self.table.position_m.copy()
        camera, asleep = self._camera, self.table.asleep.astype(bool)
        awake, others = np.flatnonzero(~asleep), np.flatnonzero(asleep)
        if camera is None:
            awake, others = others[:0], np.arange(len(positions))
        before, in_image = None, np.empty(0, dtype=bool)
        if len(others):
            positions[others] = self.variant.retract_landmarks(
                self.T_imu_world, positions[others], correction[:6], d[others]
            )
        if camera is not None:
            before = camera.view(self.values, positions[awake], self.values[camera.pose], positions[awake])
            positions[awake], in_image = camera.retract(before, after, x, d[awake])
        return Moved(after, positions, awake, others, in_image, before)

    def retract(self, correction: Array) -> None:
        """Move the mean, and re-express the covariance where the variant does."""
        moved = self.retracted(correction)
        changes = self._changes(moved, self.variant.turned)
        self.variant.transport(self.gaussian, self.model, self.values, moved.values, changes)
        self.values, self.table.position_m = moved.values, moved.position_m
        self.coordinates = self.coordinates + correction[: len(self.coordinates)]

    def carried_back(self, rows: Rows, moved: Moved) -> Rows:
        """Rows taken where a correction leads, in the errors at the estimate."""
        change = self._changes(moved, self.variant.derivative)[0].only(rows.slot)
        return self.variant.carry_back(rows, self.model, self.values, moved.values, change)

    @property
    def _camera(self) -> CameraCoordinates | None:
        """Coordinates of landmarks in the last updated camera; None: they count by their positions in world."""
        return None if self.updated_pose is None else self._cameras.get(self.updated_pose)

    def _changes(self, moved: Moved, turned: Callable[[Array, Array], Array]) -> tuple[Change, ...]:
        """How errors of landmarks change where a correction leads; landmarks that can be seen come first."""
        positions, values, after, camera = self.table.position_m, self.values, moved.values, self._camera
        others, awake = moved.asleep, moved.awake
        in_world = self.variant.change(self.model, values, others, moved.position_m[others] - positions[others])
        if camera is None or moved.before is None:
            return (in_world,)
        T, T_after, before = values[camera.pose], after[camera.pose], moved.before
        positions_after = moved.position_m[awake]
        if self.variant.first_estimates:
            T_first, initial = self.T_predicted_before, self.table.initial_m[awake]
            T_first = self.T_predicted if camera.pose == "pose" else T_first
            before = camera.view(values, positions[awake], T_first, initial)
            then = camera.view(after, positions_after, T_first, initial)
        else:
            then = camera.view(after, positions_after, T_after, positions_after)
        return camera.change(awake, before, then, moved.in_image, turned(T, T_after)), in_world
