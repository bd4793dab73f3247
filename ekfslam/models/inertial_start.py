"""First state of the inertial process, with its joint covariance: at rest, by ordinary rows.

At rest the samples measure ``mean f = -C g + ba + n`` and ``mean w = bg + n``, eq. (13). A broad prior of the tilt,
conditioned on these rows, has the cross-covariance of tilt and accelerometer bias, which no block-diagonal prior has.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.sequence import Sequence
from ekfslam.geometry import se3
from ekfslam.models.blocks import AccelBias, GyroBias, ImuScale, StateBlock, Velocity
from ekfslam.models.model import Model

TILT_RAD = 0.3  # prior standard deviation before the accelerometer has seen gravity, each axis
REST_M_S, SPEED_M_S = 0.02, 1.0  # standard deviations of a velocity at rest, and of an unknown one, each axis
# A rest within the recording: later samples are used again by the steps of the process, so it is short.
_REST_S, _BEFORE_S, _SHARE = (0.5, 0.25), 2.0, 0.8
_MOTION_PX = 0.5  # of images, up to which a rig is at rest
_STEADY = np.repeat([0.02, 0.3], 3)  # rad/s and m/s^2, changes of 0.1 s means that a rest may have (motors shake)
_QUIET = np.repeat([0.005, 0.05], 3)  # the same where no image shows the rest
_LEAST_TRACKS, _BATCH_S, _NOISY = 6, 0.1, 3.0
RHO, THETA, DU, DBG, DBA = (slice(3 * i, 3 * i + 3) for i in range(5))  # of the state's errors


@dataclass(frozen=True)
class InertialStart:
    """First state of the inertial process."""

    T_imu_world: Array  # (4, 4) pose
    velocity_m_s: Array  # (3,) in the IMU frame
    gyro_bias_rad_s: Array  # gyro_bias_rad_s, accel_bias_m_s2: (3,)
    accel_bias_m_s2: Array
    covariance: Array  # (15, 15) of the errors of pose, velocity and biases, in this order
    text: str  # how it was found

    def begun(self, model: Model) -> Model:
        """Return a model whose estimates start here."""
        first = {
            "pose": {"T_imu_world": self.T_imu_world, "covariance": self.covariance[:6, :6]},
            Velocity.name: {"first_m_s": self.velocity_m_s},
            GyroBias.name: {"first_rad_s": self.gyro_bias_rad_s},
            AccelBias.name: {"first_m_s2": self.accel_bias_m_s2},
        }

        def begun(block: StateBlock) -> StateBlock:
            return dataclasses.replace(block, **first[block.name]) if block.name in first else block  # type: ignore

        model = dataclasses.replace(model, blocks=tuple(begun(block) for block in model.blocks), joint_prior=None)
        P, own = model.prior_covariance.copy(), model.process.columns
        P[np.ix_(own, own)] = self.covariance
        return dataclasses.replace(model, joint_prior=P)


@dataclass(frozen=True)
class FirstPrior:
    """What is known before the samples are looked at."""

    T_world_imu: Array  # (4, 4) first pose; of its rotation the heading alone is used
    position_std_m: float  # position_std_m, heading_std_rad: standard deviations
    heading_std_rad: float
    gyro_bias_std_rad_s: float  # gyro_bias_std_rad_s, accel_bias_std_m_s2: of the biases, each axis, whose means are 0
    accel_bias_std_m_s2: float
    gravity_m_s2: float  # magnitude of gravity
    accel_scale_std: float = 0.0  # of the entries of the accelerometer's matrix, see `ImuScale`

    @staticmethod
    def of(T_world_imu: Array, model: Model, gravity_m_s2: float) -> FirstPrior:
        """Return the prior of a model, with position and heading of a first pose (4, 4)."""
        pose, gyro, accel = (model.layout.block(name) for name in ("pose", GyroBias.name, AccelBias.name))
        position, heading, gyro_std, accel_std = np.sqrt(
            [pose.prior_covariance()[0, 0], pose.prior_covariance()[3, 3]]
            + [block.prior_covariance()[0, 0] for block in (gyro, accel)]
        ).tolist()
        scale = 0.0
        if ImuScale.name in model.layout:
            scale = float(np.sqrt(model.layout.block(ImuScale.name).prior_covariance()[9:, 9:].max()))
        return FirstPrior(T_world_imu, position, heading, gyro_std, accel_std, gravity_m_s2, scale)

    def levelled(self, up: Array) -> Array:
        """Return ``T_imu_world`` (4, 4), turned least so that a unit vector (3,) of the IMU frame is up in world."""
        T = self.T_world_imu.copy()
        T[:3, :3] = _least_turn(T[:3, :3] @ up, np.array([0.0, 0.0, 1.0])) @ T[:3, :3]
        return se3.inverse(T)

    def covariance(self, R_imu_world: Array, tilt_rad: float, velocity_std_m_s: float) -> Array:
        """Return the covariance (15, 15) before the samples, with the heading known apart from the tilt."""
        biases = [self.gyro_bias_std_rad_s, self.accel_bias_std_m_s2]
        P = np.diag(np.repeat([self.position_std_m, 0.0, velocity_std_m_s, *biases], 3) ** 2)
        # The error of a least turn by the tilt has a component of second order along gravity.
        second = 0.5 * min(tilt_rad, self.accel_bias_std_m_s2 / self.gravity_m_s2) ** 2
        heading = np.hypot(self.heading_std_rad, second)
        P[THETA, THETA] = R_imu_world @ np.diag([tilt_rad, tilt_rad, heading]) ** 2 @ R_imu_world.T
        return P


def at_rest(
    samples: InertialSamples, begin_s: float, end_s: float, prior: FirstPrior, noise: InertialNoise
) -> InertialStart:
    """Return the state of a unit that rests from one time to another, by the rows of its mean samples.

    Their noise is the density's, or that of the means over 0.1 s if these scatter more by far.
    """
    part = samples.between(begin_s, end_s)
    mean, variance = _mean(part, noise)
    f, g = mean[3:], prior.gravity_m_s2
    up = f / np.linalg.norm(f)
    T = prior.levelled(up)
    P = prior.covariance(T[:3, :3], TILT_RAD, REST_M_S)
    # To second order a bias lengthens f by its level mean square over 2 g; the deviation is as large on each axis.
    longer = prior.accel_bias_std_m_s2**2 / g
    H, residual = np.zeros((6, 15)), np.concatenate([mean[:3], f - (g + longer) * up])
    H[:3, DBG], H[3:, DBA], H[3:, THETA] = np.eye(3), np.eye(3), -se3.skew(g * up)
    R = np.diag(np.repeat(variance, 3))
    R[3:, 3:] += (longer**2 + (prior.accel_scale_std * g) ** 2) * np.eye(3)
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    found, I_KH = K @ residual, np.eye(15) - K @ H
    P = I_KH @ P @ I_KH.T + K @ R @ K.T
    tilt = np.sqrt(np.diag(T[:3, :3].T @ P[THETA, THETA] @ T[:3, :3])[:2].max())
    text = (
        f"at rest for {end_s - begin_s:.2g} s: tilt to {np.rad2deg(tilt):.2g} deg, gyroscope bias "
        f"{_vector(found[DBG])} rad/s, |f| {np.linalg.norm(f):.4g} m/s^2"
    )
    return InertialStart(se3.exp(found[:6]) @ T, found[DU], found[DBG], found[DBA], (P + P.T) / 2, text)


def unknown(samples: InertialSamples, begin_s: float, prior: FirstPrior, why: str) -> InertialStart:
    """Return a state of which nearly nothing is known: level by the mean of a second, and slow."""
    f = samples.between(begin_s, begin_s + 1.0).accel_m_s2.mean(axis=0)
    T = prior.levelled(f / max(float(np.linalg.norm(f)), 1e-9)) if f.any() else se3.inverse(prior.T_world_imu)
    P = prior.covariance(T[:3, :3], TILT_RAD, SPEED_M_S)
    none = np.zeros(3)
    return InertialStart(T, none, none, none, P, f"not found ({why}): slow and level within 17 deg")


def rest_of(sequence: Sequence, is_loose: bool = False) -> tuple[float, float] | None:
    """Return begin and end of a rest that the first frame is in or at the end of, by images and samples; None: motion.

    Samples before the first frame are preferred: no step of the process uses them again. If ``is_loose``, images may
    move twice as far, as a few noisy tracks seem to, but samples have to be quiet.
    """
    samples, first = sequence.inertial, float(sequence.time_s[0])
    assert samples is not None
    most, limit = (2.0 * _MOTION_PX, _QUIET) if is_loose else (_MOTION_PX, _STEADY)
    rests = (
        tau for tau in _REST_S if _images_rest(sequence, tau, most) and _steady_s(samples, first, tau, limit) >= tau
    )
    still = next(rests, 0.0)
    before = _steady_s(samples, first, -_BEFORE_S, _STEADY if still else _QUIET)
    if before >= _SHARE * _REST_S[-1]:
        return first - before, first
    return (first, first + _SHARE * still) if still else None  # its end may be the begin of a motion


def _images_rest(sequence: Sequence, duration_s: float, most_px: float) -> bool:
    motion = image_motion(sequence, 0, int(np.searchsorted(sequence.time_s, sequence.time_s[0] + duration_s, "right")))
    return motion is not None and motion <= most_px


def image_motion(sequence: Sequence, begin: int, end: int) -> float | None:
    """Return the motion (px) of images over frames ``begin`` to ``end - 1``; None: unknown.

    It is the root mean square, over tracks, of one flow, linear in place and time, less twice its expected error.
    A median of tracks would be as large as their noise.
    """
    o = sequence.observations
    inside = np.flatnonzero((o.frame >= begin) & (o.frame < end))
    ids, which, count = np.unique(o.landmark[inside], return_inverse=True, return_counts=True)
    inside, which = inside[count[which] > 1], which[count[which] > 1]
    if end - begin < 2 or len(np.unique(which)) < _LEAST_TRACKS:
        return None
    time = sequence.time_s[o.frame[inside]] - sequence.time_s[begin]
    time, uv = time / (sequence.time_s[end - 1] - sequence.time_s[begin]), o.pixels_px[inside, :2]

    def centred(x: Array) -> Array:
        total = np.zeros((len(ids), x.shape[1]))
        np.add.at(total, which, x)
        return x - (total / np.maximum(count, 1)[:, None])[which]

    place = (uv - uv.mean(axis=0)) / np.maximum(uv.std(axis=0), 1.0)
    basis = np.column_stack([np.ones(len(uv)), place])
    A, d, weight = centred(time[:, None] * basis), centred(uv), np.ones(len(uv))
    for _ in range(5):  # tracks of moving things, and outliers
        by, *_ = np.linalg.lstsq(weight[:, None] * A, weight[:, None] * d, rcond=None)
        r = np.linalg.norm(d - A @ by, axis=1)
        weight = np.sqrt(1.0 / (1.0 + (r / (3.0 * np.median(r) + 1e-6)) ** 2))
    free = max(len(uv) - len(np.unique(which)) - 3, 1)
    variance = float((weight * r) @ (weight * r)) / (2 * free)  # of a coordinate
    flow = float(np.mean(np.sum((basis @ by) ** 2, axis=1)))
    error = 2.0 * variance * float(np.trace(basis.T @ basis @ np.linalg.pinv(A.T @ A))) / len(uv)
    return float(np.sqrt(max(flow - 2.0 * error, 0.0)))


def _steady_s(samples: InertialSamples, from_s: float, reach_s: float, limit: Array = _STEADY) -> float:
    """Return the time from a stamp on, or before it if ``reach_s`` is negative, in which 0.1 s means stay the same."""
    part = samples.between(*sorted((from_s, from_s + reach_s)))
    inside = (part.time_s >= min(from_s, from_s + reach_s)) & (part.time_s <= max(from_s, from_s + reach_s))
    after = np.abs(part.time_s[inside] - from_s)
    values = np.hstack([part.gyro_rad_s, part.accel_m_s2])[inside]
    batch = (after / _BATCH_S + 1e-9).astype(int)
    means = np.array([values[batch == i].mean(axis=0) for i in np.unique(batch)]).reshape(-1, 6)
    if not len(means):
        return 0.0
    apart = (np.abs(means - np.cumsum(means, axis=0) / np.arange(1, len(means) + 1)[:, None]) > limit).any(axis=1)
    steady = int(np.argmax(apart)) if apart.any() else len(means)
    return min(steady * _BATCH_S, float(after.max(initial=0.0)) + samples.step_s, abs(reach_s))


def _mean(part: InertialSamples, noise: InertialNoise) -> tuple[Array, Array]:
    """Return the mean sample (6,), and the variances (2,) of the means of gyroscope and accelerometer."""
    values = np.hstack([part.gyro_rad_s, part.accel_m_s2])
    duration = len(values) * max(part.step_s, 1e-6)
    white, walk = np.array([noise.gyro, noise.accel]), np.array([noise.gyro_walk, noise.accel_walk])
    stated = white**2 / duration + walk**2 * duration / 3.0
    batches = [batch.mean(axis=0) for batch in np.array_split(values, max(2, round(duration / _BATCH_S))) if len(batch)]
    scatter = np.var(batches, axis=0, ddof=1).reshape(2, 3).mean(axis=1) / len(batches) if len(batches) > 1 else stated
    return values.mean(axis=0), np.where(scatter > _NOISY * stated, scatter, stated)


def _least_turn(a: Array, b: Array) -> Array:
    """Return the rotation (3, 3) by the least angle that turns a unit vector a (3,) into b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        other = np.eye(3)[int(np.argmin(np.abs(a)))]
        turn = np.cross(a, other)
        return np.eye(3) if cosine > 0 else se3.so3_exp(np.pi * turn / np.linalg.norm(turn))
    return se3.so3_exp(np.arctan2(sine, cosine) * axis / sine)


def _vector(x: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in x) + ")"
