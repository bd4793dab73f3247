"""Equations (1) and (2): one interval. Landmarks stay unchanged, unless inputs measure a block, eq. (6)."""

from __future__ import annotations

from dataclasses import dataclass

from ekfslam.arrays import Array
from ekfslam.data.interval import Interval
from ekfslam.errors import ConfigError
from ekfslam.filters.estimate import Estimate, Motion
from ekfslam.filters.reports import log_density
from ekfslam.filters.retraction import retract
from ekfslam.geometry import se3
from ekfslam.models.model import Transition
from ekfslam.models.process import Measured


@dataclass(frozen=True)
class Prediction:
    """Results of a prediction that are not part of the estimate.

    Args:
        departed: (body,) coordinates before the process moved its blocks.
        measured: Measurements of blocks during the interval, if any.
        log_likelihood: Log-density of these measurements, or 0.
    """

    departed: Array
    measured: Measured | None
    log_likelihood: float


def predict(e: Estimate, interval: Interval, also: Measured | None) -> Prediction:
    """Predict over an interval: clones and walking blocks, then measurements of blocks, then the process.

    Args:
        e: Estimate that changes.
        interval: Inputs.
        also: Measurements by further sensors.

    Raises:
        ConfigError: Measurements by further sensors of a velocity that is not in the state.
    """
    model, process = e.model, e.model.process
    if also is not None and not process.estimates_velocity:
        raise ConfigError("velocities of further sensors need the twist in the state: set twist_walk_std")
    way_m = process.way_m(e.values, interval)
    # Clones and walking blocks, then the first or measured inputs, eq. (6).
    moved = model.wander(e.values, interval.tau_s, way_m)
    e.coordinates = e.coordinates.copy()  # the log has those after the update
    if moved is not None:
        e.coordinates, e.values = moved.Phi @ e.coordinates, moved.values
    moved, measured, log_likelihood = _measure(e, moved, interval, also)
    # Eq. (1): the mean, and Phi and Q of eq. (2).
    step = model.step(e.values, interval, e.linear_T_imu_world, e.variant.first_estimates)
    whole = step if moved is None else step.after(moved)
    e.gaussian.propagate(whole.Phi, whole.Q)
    departed, T_departed = e.coordinates, e.T_imu_world
    e.coordinates, e.values = model.coordinates_after(step, departed), step.values
    last = (T_departed @ se3.inverse(e.motion.T_departed), e.motion.tau_s) if e.motion.tau_s else None
    e.motion = Motion(T_departed, e.T_imu_world, e.motion.T_predicted, interval, way_m, e.imu_twist, step.Q, last)
    e.imu_twist, e.step = step.imu_twist, e.step + 1
    e.updated_pose = model.layout.clones.get("pose") if e.updated_pose == "pose" else None
    return Prediction(departed, measured, log_likelihood)


def _measure(
    e: Estimate, moved: Transition | None, interval: Interval, also: Measured | None
) -> tuple[Transition | None, Measured | None, float]:
    """Condition on measurements of blocks by the inputs, eq. (6); the first inputs start blocks instead.

    Returns:
        The transition that the covariance still has to follow; the measurements, and their log-density.
    """
    process, is_first = e.model.process, e.step == 0
    parts = [some for some in (process.measured(interval, is_first), also) if some is not None]
    measured = Measured.concatenate(parts) if parts else None
    if is_first and (start := process.start(e.values, interval)) is not None:
        begun = e.model.widened(e.values, start)
        moved = begun if moved is None else begun.after(moved)
        e.values = moved.values
        for name, value in start.values.items():
            e.coordinates[e.model.layout[name]] = value
        parts = [] if also is None else [also]
    if not parts:
        return moved, measured, 0.0
    if moved is not None:
        e.gaussian.propagate(moved.Phi, moved.Q)
    used = Measured.concatenate(parts)
    H = process.jacobian(used)
    residual = used.value - H @ e.coordinates
    solution = e.gaussian.solve_body(H, residual, used.std**2, e.step + 1)
    e.gaussian.apply(solution)
    retract(e, solution.done.correction)
    return None, measured, log_density(solution.done.nis, solution.done.log_det, len(residual))
