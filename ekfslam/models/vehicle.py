"""Velocities that a vehicle's odometry does not measure: a zero with the standard deviation of a vehicle's slip.

The twist of a wheel odometry has axes that are exactly 0: a differential drive or a car measures v_x and w_z, a
holonomic base v_y, too. The others are non-holonomic constraints: a vehicle hardly slides sideways or jumps, and rolls
and pitches a little. They are white noise of a density that does not depend on the rate of the samples:

- Lateral and vertical velocity: Brossard, Barrau and Bonnabel, "AI-IMU Dead-Reckoning", IEEE Transactions on
  Intelligent Vehicles 5 (2020), start from 1 and sqrt(10) m/s at 100 Hz for a car.
- Roll and pitch rate: a car's body swings at 1 to 1.5 Hz (Gillespie, "Fundamentals of Vehicle Dynamics", 1992), by a
  degree or less: some 5 deg/s, taken at 10 Hz.

Slip also persists: the frame of the odometry is mounted askew, and roads are cambered. So the zeros have a slow bias,
too: sideways one degree of the speed, vertically more by the same factor sqrt(10).
"""

from __future__ import annotations

import math

import numpy as np

from ekfslam.arrays import Array, BoolArray

_VERTICAL_SHARE = 10.0**0.5  # of lateral slip
_LATERAL, _VERTICAL = 0.1, 0.1 * _VERTICAL_SHARE  # m/s/sqrt(Hz)
_SLOW_SLIP = math.radians(1.0)  # share of the speed
_TILT = math.radians(5.0) / 10.0**0.5  # rad/s/sqrt(Hz)
AXES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
_PLANAR = {1: "differential drive", 2: "holonomic"}  # by the number of linear velocities


def up_axis(measured: BoolArray) -> int | None:
    """Return the axis of the only angular velocity that is measured; None if the odometry is not planar."""
    axes = np.flatnonzero(measured[3:])
    is_planar = len(axes) == 1 and measured[:3].any() and not measured[axes[0]]
    return int(axes[0]) if is_planar else None


def vehicle_std(measured: BoolArray, step_s: float) -> Array:
    """Return standard deviations (6,) of velocities (m/s, rad/s) that are not measured, of one sample."""
    up, density = up_axis(measured), np.repeat([_VERTICAL, _TILT], 3)
    if up is not None:
        density[[axis for axis in range(3) if axis != up]] = _LATERAL
    return density / np.sqrt(step_s)


def with_vehicle(std: Array, measured: BoolArray, step_s: float) -> Array:
    """Return standard deviations (6,), those of a vehicle for the axes that are not measured."""
    return np.where(measured, std, vehicle_std(measured, step_s))


def slow_slip(measured: BoolArray, twist: Array, least_m_s: float) -> dict[str, float]:
    """Return settings of the block `TwistBias` for the linear velocities (T, 6) that are not measured."""
    speed = float(np.sqrt((np.where(measured, twist, 0.0)[:, :3] ** 2).sum(axis=1).mean()))
    up, lateral = up_axis(measured), max(least_m_s, _SLOW_SLIP * speed)
    axes = np.flatnonzero(~measured[:3]).tolist() if measured[:3].any() else []
    return {f"slip_{'xyz'[axis]}_m_s": lateral * (_VERTICAL_SHARE if up in (None, axis) else 1.0) for axis in axes}


def odometry_text(measured: BoolArray, std: Array) -> str:
    """Return in words which axes are measured and how the others are taken; empty if all are."""
    if measured.all() or not measured.any():
        return ""
    up = up_axis(measured)
    kind = "partly measured velocities" if up is None else f"planar odometry ({_PLANAR[int(measured[:3].sum())]})"
    names = ", ".join(name for name, is_measured in zip(AXES, measured, strict=True) if is_measured)
    shown = [
        f"{name} {value:.2g} m/s" if axis < 3 else f"{name} {np.degrees(value):.2g} deg/s"
        for axis, (name, value) in enumerate(zip(AXES, std, strict=True))
        if not measured[axis]
    ]
    return f"{kind}: {names} are measured; the others are exactly 0, taken as slip and tilt with {', '.join(shown)}"
