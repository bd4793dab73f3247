"""Equations (3), (4), (9), (10) and (11): views of the present frame, and the rows of its observations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Rows
from ekfslam.models.blocks import PreviousView, Values, View
from ekfslam.models.observer import Moment, Projected


@dataclass(frozen=True)
class Present:
    """The camera of the present frame in the errors of the state: ``W_true = exp(z^) W``, ``z = by x``."""

    T_cam_world: Array  # (4, 4) W
    T_linear: Array  # (4, 4) camera at which the rest of H is taken: the same, or (FEJ) the predicted one
    by: Array  # (6, seen); if the view is in the state, it selects its columns


def moment(e: Estimate, at: Mean) -> Moment:
    """Return the moment of the present frame."""
    shared = {block.name: at.values[block.name] for block in e.model.observer.shared}
    T = at.values["pose"]
    T_linear = e.variant.linear(T, e.motion.T_predicted)
    return Moment(T, T_linear, e.model.observer.parameters(at.values), at.imu_twist, shared, e.motion.way_m)


def camera_of(e: Estimate, at: Mean) -> Array:
    """Return the camera ``T_cam_world`` (4, 4) of the present frame at a mean."""
    now = moment(e, at)
    return np.asarray(e.model.observer.camera(now).T_cam_imu @ now.T_imu_world, dtype=float)


def corrected_twist(e: Estimate, after: Values) -> Array:
    """Return the velocity (6,) of the IMU at this frame by corrected values, for eq. (9).

    The noise of the measured one is in the innovations, so that with it a time offset would come out too small.
    """
    return e.model.process.imu_twist({"pose": e.motion.T_departed}, after, e.motion.interval)


def look(e: Estimate) -> Array | None:
    """Set the view to the camera of the present frame, and return E (body, body) with ``x <- E x``; None: no view.

    E has ``z = Y x`` in the rows of the view. The caller re-expresses the covariance.
    """
    layout = e.model.layout
    if View.name not in layout:
        return None
    now, at = moment(e, e.mean), layout[View.name]
    camera = e.model.observer.camera(now)
    E = np.eye(layout.body)
    E[at], E[at, : layout.seen] = 0.0, camera.by
    T_first = camera.T_cam_imu @ e.motion.T_predicted
    e.values = {**e.values, View.name: camera.T_cam_imu @ now.T_imu_world}
    e.coordinates, e.motion = E @ e.coordinates, replace(e.motion, W_predicted=T_first)
    return E


def look_again(e: Estimate) -> Array | None:
    """Set the view as `look` does, in the covariance, too."""
    if (E := look(e)) is not None:
        e.gaussian.propagate(E, np.zeros_like(E))
    return E


def present(e: Estimate) -> Present:
    """Return the camera of the present frame."""
    layout = e.model.layout
    if View.name in layout:
        W, by = e.values[View.name], np.zeros((6, layout.seen))
        by[:, layout[View.name]] = np.eye(6)
        return Present(W, e.variant.linear(W, e.motion.W_predicted), by)
    now = moment(e, e.mean)
    camera = e.model.observer.camera(now)
    return Present(camera.T_cam_imu @ now.T_imu_world, camera.T_cam_imu @ now.T_linear, camera.by)


def observe(
    e: Estimate, at: Mean, slot: IntArray, measured: Array, prior: Mean | None = None
) -> tuple[Projected, Rows]:
    """Return landmarks at slots (k,) as seen from a mean, eq. (3) and (4), and the rows of measurements (k, d).

    If tracks have errors, eq. (10), an observation that follows another one becomes its difference from it.

    Args:
        prior: Mean whose errors of the body the rows count by: by default ``at``. Those of landmarks are at ``at``.
    """
    model, table, observer = e.model, e.table, e.model.observer
    positions = at.position_m[slot]
    linear = e.variant.linear(positions, table.initial_m[slot])
    error, now = model.track_error, moment(e, at)
    is_difference = (table.last_step[slot] == e.step - 1) & (error is not None)
    kind, cameras = is_difference.astype(np.int64), observer.cameras(now)
    W, W_linear, by = cameras.T_cam_imu @ now.T_imu_world, cameras.T_cam_imu @ now.T_linear, cameras.by
    if prior is not None:
        start = moment(e, prior)
        cameras = observer.cameras(start)
        by = e.variant.derivative(cameras.T_cam_imu @ start.T_imu_world, W) @ cameras.by
    seen = observer.project(now.calibration, W[kind], positions, W_linear[kind], linear)
    H_x, H_m, residual = observer.by_body(seen, by[kind]), seen.H_m, measured - seen.z
    if error is None:
        return seen, Rows(slot, H_x, H_m, residual, e.sensor.variance(measured))
    variance = error.absolute_variance(e.step - table.first_step[slot])
    follows = np.flatnonzero(is_difference)
    if len(follows):
        W, view = at.values[PreviousView.name], np.zeros((6, model.layout.seen))
        W_linear = e.variant.linear(W, e.motion.W_predicted_before)
        D = np.eye(6) if prior is None else e.variant.derivative(prior.values[PreviousView.name], W)
        view[:, model.layout[PreviousView.name]] = D
        before = observer.project(now.calibration, W, positions[follows], W_linear, linear[follows])
        rows_before = table.seen_rows[slot[follows]]
        H_m = H_m.copy()
        residual[follows] -= rows_before - before.z
        H_x[follows] -= observer.by_body(before, view)
        H_m[follows] -= before.H_m
        parallax = e.motion.way_m / np.maximum(seen.q[follows, 2], e.config.min_depth_m)
        variance[follows] = error.step_variance(measured[follows] - rows_before, parallax)
    return seen, Rows(slot, H_x, H_m, residual, variance)
