"""Equations (1) and (2): one interval. Landmarks stay unchanged, unless inputs measure a block, eq. (6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.interval import Interval
from ekfslam.engine.face import Engine
from ekfslam.errors import ConfigError
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate, Motion
from ekfslam.filters.observing import look
from ekfslam.filters.reports import log_density
from ekfslam.filters.retraction import retract
from ekfslam.geometry import se3
from ekfslam.models.blocks import PreviousView, View
from ekfslam.models.model import Transition
from ekfslam.models.process import Measured


@dataclass(frozen=True)
class Prediction:
    """Results of a prediction that are not part of the estimate."""

    departed: Array  # (body,) coordinates before the process moved its blocks
    measured: Measured | None  # measurements of blocks during the interval, if any
    log_likelihood: float  # log-density of these measurements, or 0
    doubt: float = 1.0  # largest factor of the standard deviations of measurements that the state contradicts, or 1


def predict(e: Estimate, interval: Interval, also: Measured | None, at_rest: Measured | None = None) -> Prediction:
    """Predict over an interval: clones and walking blocks, then measurements of blocks, then the process.

    ``also`` are measurements by further sensors; ``at_rest`` rows of a rig that stood, see `ekfslam.filters.standing`.
    """
    model, process = e.model, e.model.process
    if also is not None:
        if not process.velocity:
            raise ConfigError("velocities of further sensors need the twist in the state: set twist_walk_std")
        also = process.referred(also, e.values, interval)
    extra = [some for some in (also, at_rest) if some is not None]
    if e.engine is not None and not extra and (arrived := e.engine.predict(interval)) is not None:
        return _arrived(e, e.engine, interval, arrived)
    way_m, T_cam_imu = process.way_m(e.values, interval), np.eye(4)
    if View.name in model.layout:
        T_cam_imu = e.values[View.name] @ se3.inverse(e.T_imu_world)
    # Clones and walking blocks, then the first or measured inputs, eq. (6).
    moved = model.wander(e.values, interval.tau_s, way_m)
    e.updated_view = PreviousView.name if e.updated_view == View.name else None
    e.coordinates = e.coordinates.copy()  # the log has those after the update
    if moved is not None:
        e.coordinates, e.values = moved.Phi @ e.coordinates, moved.values
    moved, measured, log_likelihood, doubt = _measure(e, moved, interval, extra)
    # Eq. (1): the mean, and Phi and Q of eq. (2).
    step = model.step(e.values, interval, e.linear_T_imu_world, e.variant.first_estimates)
    whole = step if moved is None else step.after(moved)
    departed, T_departed, last = e.coordinates, e.T_imu_world, None
    e.coordinates, e.values = model.coordinates_after(step, departed), step.values
    if e.motion.tau_s:
        last = T_departed @ se3.inverse(e.motion.T_departed), e.motion.tau_s
    W_before = e.motion.W_predicted
    e.motion = Motion(T_departed, e.T_imu_world, W_before, W_before, interval, way_m, T_cam_imu, step.Q, last)
    e.imu_twist, e.step = step.imu_twist, e.step + 1
    # The view of this frame is where its camera is now.
    if e.engine is not None:
        e.forget_table()
        e.values, e.coordinates = e.engine.arrive(e.values, e.coordinates, e.imu_twist, whole.Phi, whole.Q, e.motion)
        return Prediction(departed, measured, log_likelihood, doubt)
    if (E := look(e)) is not None:
        whole = replace(whole, Phi=E @ whole.Phi, Q=E @ whole.Q @ E.T)
        e.motion = replace(e.motion, Q=E @ step.Q @ E.T)
    e.gaussian.propagate(whole.Phi, whole.Q)
    return Prediction(departed, measured, log_likelihood, doubt)


def _arrived(e: Estimate, engine: Engine, interval: Interval, found: dict[str, Any]) -> Prediction:
    """Take in a prediction of the engine, which keeps what it needs of the motion."""
    e.forget_table()
    T_departed, W = found["T_departed"].reshape(4, 4), e.motion.W_predicted
    e.updated_view = PreviousView.name if e.updated_view == View.name else None
    e.values, e.coordinates = engine.named(found["values"]), found["coordinates"]
    T_cam_imu = found["T_cam_imu"].reshape(4, 4)
    e.motion = Motion(T_departed, e.T_imu_world, W, W, interval, found["way_m"], T_cam_imu, np.zeros((0, 0)))
    measured, doubt = e.model.process.measured(interval, e.step == 0), found["doubt"]
    log_likelihood = 0.0
    if measured is not None and e.step:
        measured = replace(measured, std=doubt * measured.std)
        log_likelihood = log_density(found["nis"], found["log_det"], len(measured.value))
    e.imu_twist, e.step = found["imu_twist"], e.step + 1
    return Prediction(found["departed"], measured, log_likelihood, doubt)


def _measure(
    e: Estimate, moved: Transition | None, interval: Interval, extra: list[Measured]
) -> tuple[Transition | None, Measured | None, float, float]:
    """Condition on measurements of blocks by the inputs, eq. (6); the first inputs start blocks instead.

    Returns:
        The transition that the covariance still has to follow; the measurements, their log-density, and their doubt.
    """
    process, is_first = e.model.process, e.step == 0
    own = process.measured(interval, is_first)
    parts = [*([] if own is None else [own]), *extra]
    begin: list[Measured] = []
    if is_first and (start := process.start(e.values, interval)) is not None:
        begun = e.model.widened(e.values, start)
        moved = begun if moved is None else begun.after(moved)
        e.values = moved.values
        for name, value in start.values.items():
            e.coordinates[e.model.layout[name]] = value
        begin, parts = parts[:1], parts[1:]
    if not parts:
        return moved, begin[0] if begin else None, 0.0, 1.0
    if moved is not None:
        e.gaussian.propagate(moved.Phi, moved.Q)
    doubts = [_doubt(e, part) for part in parts]
    parts = [replace(part, std=doubt * part.std) for part, doubt in zip(parts, doubts, strict=True)]
    used = Measured.concatenate(parts)
    H = process.jacobian(used)
    residual = used.value - H @ e.coordinates
    if e.engine is not None:
        e.forget_table()
        e.values, e.coordinates, nis, log_det = e.engine.measure(e.values, e.coordinates, H, residual, used.std**2)
    else:
        solution = e.gaussian.solve_body(H, residual, used.std**2, e.step + 1)
        e.gaussian.apply(solution)
        retract(e, solution.done.correction)
        nis, log_det = solution.done.nis, solution.done.log_det
    log_likelihood = log_density(nis, log_det, len(residual))
    return None, Measured.concatenate([*begin, *parts]), log_likelihood, max(doubts)


def _doubt(e: Estimate, measured: Measured) -> float:
    """Return the factor of the standard deviations of measurements at which their innovations are at the gate.

    Its square is the normalised innovation squared over the gate, so that the pull of a wild measurement falls with its
    size, as with Cauchy's kernel.
    """
    if e.config.gate_probability == 1.0:
        return 1.0
    return max(1.0, float(np.sqrt(squared(e, measured) / gates.of_inputs(len(measured.value)))))


def squared(e: Estimate, measured: Measured) -> float:
    """Return the normalised innovation squared of measurements of blocks."""
    H = e.model.process.jacobian(measured)
    P, residual = e.gaussian.body_covariance[: H.shape[1], : H.shape[1]], measured.value - H @ e.coordinates
    return float(residual @ np.linalg.solve(H @ P @ H.T + np.diag(measured.std**2), residual))
