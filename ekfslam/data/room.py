"""The built-in world ``room``: a hand-held stereo rig or one camera, with an inertial unit, between walls of landmarks.

The trajectory is made from the seed and begins at rest, or is a TUM file of poses, resampled to 10 Hz. The truth is the
cumulative cubic B-spline through the poses, so that samples and images agree exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.noise import Noise
from ekfslam.data.observations import TrueMotion, Truth
from ekfslam.data.sequence import Sequence, of_left_camera
from ekfslam.data.spline import PoseSpline, resampled
from ekfslam.data.worlds import Recording, View, numbers_of, observed, stamps
from ekfslam.errors import ConfigError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

GRAVITY_M_S2 = 9.81
KNOT_S = 0.1
MAX_GAP_S = 0.5  # of a trajectory: over longer, a straight line is no motion of a hand
CAMERA = StereoCamera(fu_px=435.0, fv_px=435.0, cu_px=376.0, cv_px=240.0, baseline_m=0.11)
IMAGE_SIZE_PX = (752, 480)
_CAMERA_IN_IMU_M = np.array([0.05, 0.04, -0.02])
_MISALIGNMENT = se3.so3_exp(np.deg2rad([0.8, -1.3, 0.6]))
_WALL_RELIEF_M = 0.3
_MARGIN_S = 0.02  # of samples before the first image and after the last


@dataclass(frozen=True)
class Room(Recording):
    """A box around the trajectory, with landmarks on its six sides. Tracks that are lost come back under other ids."""

    name: str = "room"
    frames: int = 250
    stamp_jitter_s: float = 0.0
    min_disparity_px: float = 5.0
    max_range_m: float = 8.0
    max_tracks: int = 40
    cameras: int = 2  # 2, or 1: the left camera of the rig, with the tracks and the noise of the rig
    landmarks: int = 1500  # number of landmarks
    wall_m: float = 2.5  # wall_m, ceiling_m: least distances of walls, and of floor and ceiling, from the trajectory
    ceiling_m: float = 1.5
    imu_rate_hz: float = 200.0  # rate of gyroscope and accelerometer
    # gyro, accel, gyro_walk, accel_walk: Densities, see `InertialNoise`; by default those of EuRoC.
    gyro: float = 1.6968e-4
    accel: float = 2.0e-3
    gyro_walk: float = 1.9393e-5
    accel_walk: float = 3.0e-3
    # gyro_bias_std_rad_s, accel_bias_std_m_s2: Standard deviations of the first biases.
    gyro_bias_std_rad_s: float = 0.01
    accel_bias_std_m_s2: float = 0.1
    trajectory: str = ""  # TUM file of poses with gravity along -z; "" for a trajectory made from the seed
    start_s: float = 0.0  # time in the trajectory at which the recording begins

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1.0 <= self.imu_rate_hz <= 10_000.0:
            raise ConfigError(f"{self.name}: imu_rate_hz must be from 1 to 10000, found {self.imu_rate_hz}")
        if self.cameras not in (1, 2):
            raise ConfigError(f"{self.name}: cameras must be 1 or 2, found {self.cameras}")
        if self.frames * self.frame_period_s > 1e5:
            raise ConfigError(f"{self.name}: frames * frame_period_s must be at most 1e5 s")

    @property
    def in_view(self) -> float:
        return float(self.landmarks)

    @property
    def inertial_noise(self) -> InertialNoise:
        """Densities of the samples."""
        return InertialNoise(self.gyro, self.accel, self.gyro_walk, self.accel_walk)


def simulate_room(world: Room, rng: np.random.Generator | None = None) -> Sequence:
    """Record a world once; see `ekfslam.data.simulate.simulate`."""
    geometry = np.random.default_rng(world.seed)
    noise = geometry if rng is None else rng
    time_s = stamps(world, geometry)
    spline = _trajectory(world, float(time_s[-1]), geometry)
    motion = spline.at(time_s)
    view = View(CAMERA, IMAGE_SIZE_PX, _extrinsics(motion.T_world_imu[:, :3, :3]))
    points_m = _landmarks(world, motion.T_world_imu[:, :3, 3], geometry)
    samples, gyro_bias, accel_bias = _samples(world, spline, time_s, noise)

    T_imu_world = se3.inverse(motion.T_world_imu)
    observations, ids, position_m = observed(world, view, T_imu_world, points_m, noise, ids_last=False)
    sequence = Sequence(
        name=world.name,
        source=f"builtin:{world.name}",
        time_s=time_s,
        camera=CAMERA,
        T_cam_imu=view.T_cam_imu,
        observations=observations,
        inputs=(samples,),
        truth=Truth(
            frame=np.arange(world.frames),
            T_world_imu=motion.T_world_imu,
            landmark=ids,
            position_m=position_m,
            motion=TrueMotion(motion.velocity_m_s, gyro_bias, accel_bias),
        ),
        noise=Noise.isotropic(0.0, 0.0, world.sigma_px),
        attributes={"world": world.name, **numbers_of(world), "trajectory": Path(world.trajectory).name},
    )
    return sequence if world.cameras == 2 else of_left_camera(sequence)


def _trajectory(world: Room, duration_s: float, rng: np.random.Generator) -> PoseSpline:
    """Return the spline from before the first sample until after the last one, its time from the first frame."""
    begin = -KNOT_S * np.ceil(2 * _MARGIN_S / KNOT_S)
    knots = begin + KNOT_S * np.arange(-1, int(np.ceil((duration_s - 2 * begin) / KNOT_S)) + 3)
    if not world.trajectory:
        return PoseSpline(begin, KNOT_S, _hand_held(np.maximum(knots + world.start_s, 0.0), rng))
    path = Path(world.trajectory)
    given, T = _poses(path)
    wanted = knots - knots[0] + world.start_s
    if wanted[-1] > given[-1]:
        raise ConfigError(f"{path}: the trajectory ends after {given[-1]:.1f} s, {wanted[-1]:.1f} s are needed")
    k = np.flatnonzero((np.diff(given) > MAX_GAP_S) & (given[1:] > wanted[0]) & (given[:-1] < wanted[-1]))
    if len(k):
        raise ConfigError(f"{path}: the trajectory has a gap from {given[k[0]]:.1f} to {given[k[0] + 1]:.1f} s")
    return PoseSpline(begin, KNOT_S, resampled(given, T, wanted))


def _poses(path: Path) -> tuple[Array, Array]:
    """Return stamps (n,) from 0 and poses ``T_world_imu`` (n, 4, 4) of a TUM file (time tx ty tz qx qy qz qw)."""
    from scipy.spatial.transform import Rotation

    try:
        table = np.loadtxt(path, ndmin=2)
        stamps, position, quaternion = np.split(table, [1, 4], axis=1)
        rotation = Rotation.from_quat(quaternion).as_matrix()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a trajectory in the form of TUM ({error})") from None
    if len(table) < 2 or not np.isfinite(table).all() or (np.diff(stamps[:, 0]) <= 0).any():
        raise ConfigError(f"{path}: the trajectory needs finite poses at stamps that increase")
    return stamps[:, 0] - stamps[0, 0], se3.transform(rotation, position)


def _hand_held(time_s: Array, rng: np.random.Generator) -> Array:
    """Return poses (n, 4, 4) of a walk about a room: at rest first, then sums of sines of random phase."""
    # Time on the path: at rest until 0.5 s, at full speed from 2.5 s.
    x = np.clip((time_s - 0.5) / 2.0, 0.0, 1.0)
    path_s = 2.0 * (x**3 - x**4 / 2) + np.maximum(time_s - 2.5, 0.0)
    # Rows: x, y, z (m), yaw, pitch, roll (rad); columns: a slow, a medium and a fast motion.
    amplitude = np.array(
        [[1.8, 0.3, 0.02], [1.5, 0.3, 0.02], [0.15, 0.1, 0.03], [1.5, 0.4, 0.03], [0.1, 0.15, 0.03], [0.1, 0.15, 0.03]]
    )
    frequency_hz = np.array([0.08, 0.3, 1.5]) * rng.uniform(0.8, 1.2, (6, 3))
    phase = rng.uniform(0.0, 2 * np.pi, (6, 3))
    waves = np.sin(2 * np.pi * frequency_hz * path_s[:, None, None] + phase)
    position, (yaw, pitch, roll) = np.split((amplitude * waves).sum(axis=-1).T, 2)
    yaw = yaw + 0.2 * path_s
    turns = [se3.so3_exp(angle[:, None] * np.eye(3)[axis]) for angle, axis in ((yaw, 2), (pitch, 1), (roll, 0))]
    return se3.transform(turns[0] @ turns[1] @ turns[2], position.T + np.array([0.0, 0.0, 1.5]))


def _extrinsics(R_world_imu: Array) -> Array:
    """Return ``T_cam_imu`` of a camera that looks level: along an axis that follows the most upright one of the IMU."""
    upright = R_world_imu[:, 2].mean(axis=0)
    axis = int(np.argmax(np.abs(upright)))
    up, forward = np.sign(upright[axis]) * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
    R = _MISALIGNMENT @ np.array([np.cross(forward, up), -up, forward])
    return se3.transform(R, -R @ _CAMERA_IN_IMU_M)


def _landmarks(world: Room, position_m: Array, rng: np.random.Generator) -> Array:
    """Return points (N, 3) on the sides of a box about the trajectory (T, 3), with some relief inwards."""
    margin = np.array([world.wall_m, world.wall_m, world.ceiling_m])
    low, high = position_m.min(axis=0) - margin, position_m.max(axis=0) + margin
    area = np.prod(high - low) / (high - low)
    axis = rng.choice(3, world.landmarks, p=area / area.sum())
    is_high, relief = rng.random(world.landmarks) < 0.5, rng.uniform(0.0, _WALL_RELIEF_M, world.landmarks)
    points = rng.uniform(low, high, (world.landmarks, 3))
    points[np.arange(world.landmarks), axis] = np.where(is_high, high[axis] - relief, low[axis] + relief)
    return points


def _samples(
    world: Room, spline: PoseSpline, time_s: Array, rng: np.random.Generator
) -> tuple[InertialSamples, Array, Array]:
    """Return the samples, and the true biases of gyroscope and accelerometer (T, 3) at the frames."""
    step, noise = 1.0 / world.imu_rate_hz, world.inertial_noise
    begin = -_MARGIN_S - step * rng.random()
    stamps = np.asarray(begin + step * np.arange((time_s[-1] + 2 * _MARGIN_S) // step + 3), dtype=float)
    grid = np.union1d(stamps, time_s)
    walk = np.sqrt(np.diff(grid, prepend=grid[0]))[:, None]
    density = np.repeat([noise.gyro_walk, noise.accel_walk], 3)
    first = np.repeat([world.gyro_bias_std_rad_s, world.accel_bias_std_m_s2], 3) * rng.standard_normal(6)
    bias = first + np.cumsum(walk * density * rng.standard_normal((len(grid), 6)), axis=0)
    motion = spline.at(stamps)
    true = np.hstack([motion.rate_rad_s, motion.specific_force(GRAVITY_M_S2)])
    std = np.sqrt(world.imu_rate_hz) * np.repeat([noise.gyro, noise.accel], 3)
    measured = true + bias[np.searchsorted(grid, stamps)] + std * rng.standard_normal(true.shape)
    at_frames = bias[np.searchsorted(grid, time_s)]
    return InertialSamples(stamps, measured[:, :3], measured[:, 3:], noise), at_frames[:, :3], at_frames[:, 3:]
