"""The batch problem: all factors of a filter's log, as filtered or linearised at any state.

*As filtered*, unknowns are the coordinates of the log: a pose counts from its prediction, a landmark from its
initialisation. A standard or first-estimates EKF that never retires a landmark has exactly the solution of these
factors as its estimate. *Relinearised*, all unknowns are errors of one state.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import PosteriorError
from ekfslam.filters.log import Log
from ekfslam.geometry import se3
from ekfslam.models.model import Model
from ekfslam.models.sensors.base import DelayedSensor
from ekfslam.smoother.landmarks import moved_in_image
from ekfslam.smoother.observations import ObservationFactors
from ekfslam.smoother.process import ProcessFactors
from ekfslam.smoother.sparse.dense import DenseInformation
from ekfslam.smoother.sparse.factors import Factor, LinearSystem
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.smoother.unknowns import State, Unknowns
from ekfslam.smoother.views import Views

__all__ = ["BatchProblem", "State"]

Information = JointInformation | DenseInformation


class BatchProblem:
    """All factors of a log.

    Raises:
        IllPosedError: The velocities have no noise, so that steps have no weight; names frames.
    """

    def __init__(self, log: Log, model: Model) -> None:
        self.log, self.model = log, model
        self.unknowns = Unknowns(model, log.initial_covariance, log.departed[0])
        self.process = ProcessFactors(log, model, self.unknowns)
        self.observations = ObservationFactors(log, model, self.unknowns)

    def as_filtered(self) -> LinearSystem:
        """Return the system where the filter linearised it."""
        if isinstance(self.model.sensor, DelayedSensor):
            raise PosteriorError(
                "landmarks that waited for a second view have no rows as filtered; there is only 'map'"
            )
        zeta = np.zeros(len(self.unknowns.B))
        return self._system([*self.process.frozen(), *self.observations.frozen()], zeta)

    def relinearised(self, state: State) -> LinearSystem:
        """Return the system linearised at a state."""
        factors, views = self.observations.factors(state), self.observations.at(state).views
        return self._system([*self.process.factors(state), *factors], state.zeta, views)

    def _system(self, factors: list[Factor], zeta: Array, views: Views | None = None) -> LinearSystem:
        u, log = self.unknowns, self.log
        first = u.first_frame(zeta[: len(u.B)])
        of_views = () if views is None else (views.by_frame, views.seen)
        return LinearSystem.of(tuple(factors), first, log.frames, len(u.drive_columns), log.id, *of_views)

    def first_frame(self, zeta: Array) -> tuple[Array, Array, Array]:
        """Return pose (4, 4), shared blocks (w-6,) and further blocks (a,) of the first frame at zeta."""
        u, first = self.unknowns, self.unknowns.B @ zeta
        T = se3.exp(first[:6]) @ self.log.T_predicted[0]
        return T, u.shared_mean + first[6 : u.width], u.aux_mean + first[u.width :]

    def moved(self, state: State, step: Information) -> State:
        """Return a state moved by a solution of its system.

        Landmarks move in the image of the camera that saw them first, eq. (7'). If a long stretch of the trajectory
        moves and turns as a whole, its landmarks go along to all orders.
        """
        u, before, zeta, sensor = self.unknowns, state.T_imu_world, state.zeta + step.zeta, self.model.sensor
        T = se3.exp(step.eps[:, :6]) @ before
        shared, aux = state.shared + step.eps[:, 6:], state.aux + step.aux
        # zeta gives the first frame exactly; eps is its first order.
        T[0], shared[0], aux[0] = self.first_frame(zeta)
        k, C = self.observations.first_frame, sensor.T_cam_imu
        xi = se3.log(T @ se3.inverse(before)) @ se3.adjoint(C).T
        camera, camera_after = (C @ before)[k], (C @ T)[k]
        turned = np.cross(xi[k, 3:], se3.apply(camera, state.positions_m))
        by = xi[k, :3] + turned + (camera[:, :3, :3] @ step.d[..., None])[..., 0]
        positions = moved_in_image(sensor, camera, camera_after, state.positions_m, by)
        drive = u.drive_values(step.drive, state.drive_values)
        return State(T, positions, zeta, shared, aux, state.drive + step.drive, drive)

    def filtered_state(self, positions_m: Array) -> State:
        """Return the filter's estimates as a state: its blocks after each update, and a map (M, 3)."""
        u, log = self.unknowns, self.log
        xi = se3.log(log.T_updated[0] @ se3.inverse(log.T_predicted[0]))
        drive, shared, aux = (log.updated[:, at] for at in (u.drive_columns, u.frame_columns[6:], u.aux_columns))
        zeta = np.linalg.pinv(u.B) @ np.concatenate([xi, shared[0] - u.shared_mean, aux[0] - u.aux_mean])
        return State(log.T_updated, positions_m, zeta, shared, aux, drive[-1], u.drive_values(drive[-1]))

    def solved_as_filtered(self, solution: JointInformation) -> State:
        """Return the state of a solution of `as_filtered`."""
        T = se3.exp(solution.eps[:, :6]) @ self.log.T_predicted
        u = self.unknowns
        positions, drive = self.log.first_position_m + solution.d, u.drive_values(solution.drive)
        shared, aux = u.shared_mean + solution.eps[:, 6:], u.aux_mean + solution.aux
        return State(T, positions, solution.zeta, shared, aux, solution.drive, drive)
