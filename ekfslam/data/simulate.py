"""Simulated drives with exact truth: the embedded default data, and the raw material of Monte Carlo studies.

``city`` is a drive through streets with short tracks, whose ids never come back, and some gross outliers. ``loop`` is a
ring driven several times past the same few landmarks, which keep their ids. ``room`` is hand-held, with inertial
samples, see `ekfslam.data.room`. The truth of a drive obeys eq. (1) exactly, with one velocity an interval. The world
frame is the IMU frame of the first stamp, x forward, y left, z up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any
from urllib.parse import parse_qsl

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.room import Room, simulate_room
from ekfslam.data.sequence import Noise, Sequence, Truth
from ekfslam.data.worlds import Recording, View, numbers_of, observed, parameters_of, stamps
from ekfslam.errors import ConfigError, UnknownFormatError
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import StereoCamera

CAMERA = StereoCamera(fu_px=707.0, fv_px=707.0, cu_px=602.0, cv_px=183.0, baseline_m=0.537)
IMAGE_SIZE_PX = (1241, 376)
_CAMERA_IN_IMU_M = np.array([1.1, -0.3, 0.7])
_R_CAM_IMU = se3.so3_exp(np.deg2rad([0.8, -1.3, 0.6])) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
T_CAM_IMU = se3.transform(_R_CAM_IMU, -_R_CAM_IMU @ _CAMERA_IN_IMU_M)

GROUND_M = -0.95  # height of the road in the IMU frame
ROAD_HALF_WIDTH_M = 4.0
TURN_SPEED_M_S = 5.0
# Typical unevenness of a road: pitch, roll (rad), sideways and vertical speed per forward speed.
_UNEVENNESS = np.array([0.025, 0.010, 0.004, 0.008])
_MOST_STREETS_M = 1e6
_FASTEST_M_S = 15.0  # in the city
_VIEW = View(CAMERA, IMAGE_SIZE_PX, T_CAM_IMU)


@dataclass(frozen=True)
class Drive(Recording):
    """Settings of drives with measured velocities.

    Args:
        sigma_v_m_s, sigma_w_rad_s: White noise of the velocities, per sample and axis.
        initial_position_std_m, initial_rotation_std_rad: Prior of the first pose, each axis, from which the truth is
            drawn. Unless both are 0, estimates start at identity, and the truth starts at frame 1.
    """

    sigma_v_m_s: float = 0.5
    sigma_w_rad_s: float = 0.05
    initial_position_std_m: float = 0.0
    initial_rotation_std_rad: float = 0.0


@dataclass(frozen=True)
class City(Drive):
    """Streets between crossings with a stop in every third; each unbroken track has its own id."""

    name: str = "city"
    sigma_px: float = 0.7
    min_disparity_px: float = 4.0
    max_range_m: float = 50.0
    max_tracks: int = 66
    loss_probability: float = 0.02
    outlier_fraction: float = 0.03
    landmarks_per_m: float = 4.0  # physical points along each metre of street, both sides together

    def __post_init__(self) -> None:
        super().__post_init__()
        length_m = _FASTEST_M_S * self.frames * self.frame_period_s
        if length_m * max(self.landmarks_per_m, 1.0) > _MOST_STREETS_M * 4.0:
            raise ConfigError(f"{self.name}: streets of about {length_m:.3g} m have too many landmarks")

    @property
    def in_view(self) -> float:
        return 2.0 * self.landmarks_per_m * self.max_range_m


@dataclass(frozen=True)
class Loop(Drive):
    """A ring driven at constant speed; landmarks keep their ids, loop after loop (157 frames each by default)."""

    name: str = "loop"
    frames: int = 472
    radius_m: float = 20.0  # radius_m, speed_m_s: radius of the ring, and speed along it
    speed_m_s: float = 8.0
    landmarks: int = 100  # number of landmarks inside and outside of the ring
    # Largest distance of landmarks outside of the ring; inside it is a fifth of the radius.
    landmark_offset_m: float = 16.0
    landmark_height_m: float = 4.0  # largest height of landmarks above the ground

    def __post_init__(self) -> None:
        super().__post_init__()
        least = ROAD_HALF_WIDTH_M - 0.2 * self.radius_m
        if self.landmark_offset_m < least:
            must = f"must be at least {least:g} where radius_m is {self.radius_m:g}, found {self.landmark_offset_m:g}"
            raise ConfigError(f"{self.name}: landmark_offset_m leaves no room beside the road: {must}")

    @property
    def in_view(self) -> float:
        return float(self.landmarks)


World = City | Loop | Room

BUILTIN: Mapping[str, World] = MappingProxyType({"city": City(), "loop": Loop(), "room": Room()})


def builtin(name: str) -> Sequence:
    """Return the sequence of a built-in world, ``city``, or of a variation of it, ``city?seed=3&frames=200``."""
    base, _, query = name.partition("?")
    if base not in BUILTIN:
        raise UnknownFormatError(f"no built-in world {base!r}; known: {', '.join(BUILTIN)}")
    defaults = parameters_of(BUILTIN[base])
    changes: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in defaults:
            raise ConfigError(f"{name}: unknown parameter {key!r}; known: {', '.join(defaults)}")
        try:
            changes[key] = type(defaults[key])(text)
        except ValueError:
            raise ConfigError(f"{name}: {key} must be a number like {defaults[key]}, found {text!r}") from None
    return simulate(dataclasses.replace(BUILTIN[base], **changes))


def simulate(world: World, rng: np.random.Generator | None = None) -> Sequence:
    """Record a world once, with the true noise, all true poses (but see `Drive` on the prior) and landmarks.

    Args:
        world: World, whose seed decides stamps, drive and landmarks.
        rng: Generator of first pose, noise, losses and outliers, to record the same drive again with other noise. By
            default the world's own generator goes on: every call gives the same bits.
    """
    if isinstance(world, Room):
        return simulate_room(world, rng)
    geometry = np.random.default_rng(world.seed)
    noise = geometry if rng is None else rng

    time_s, twist, T_imu_world, points_m = _drive(world, geometry)
    # The first pose is exp(xi^), not the identity. The truth moves with it, so that no measurement changes.
    prior_std = np.repeat([world.initial_position_std_m, world.initial_rotation_std_rad], 3)
    T_first = se3.exp(prior_std * noise.standard_normal(6))
    T_imu_world = T_imu_world @ T_first
    points_m = se3.apply(se3.inverse(T_first), points_m)
    first_known = 1 if prior_std.any() else 0  # estimates must not start from a first pose that is drawn

    stated = Noise.isotropic(world.sigma_v_m_s, world.sigma_w_rad_s, world.sigma_px)
    measured_twist = twist + stated.twist_std * noise.standard_normal(twist.shape)

    observations, ids, position_m = observed(world, _VIEW, T_imu_world, points_m, noise, isinstance(world, Loop))
    known = np.arange(first_known, world.frames)
    truth = Truth(known, se3.inverse(T_imu_world)[first_known:], ids, position_m)
    return Sequence(
        world.name,
        f"builtin:{world.name}",
        time_s,
        twist=measured_twist,
        camera=CAMERA,
        T_cam_imu=T_CAM_IMU,
        observations=observations,
        truth=truth,
        noise=stated,
        attributes={"world": world.name, **numbers_of(world)},
    )


def _drive(world: Loop | City, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Return stamps (T,), true velocities (T, 6), poses ``T_imu_world`` (T, 4, 4) and landmarks (M, 3) of a world."""
    time_s = stamps(world, rng)
    if isinstance(world, Loop):
        distance_m, wavelength_m = world.speed_m_s * time_s, 2 * np.pi * world.radius_m
        yaw_rad = distance_m / world.radius_m
    else:
        (distance_m, yaw_rad), wavelength_m = _drive_streets(time_s, rng), 150.0
    twist = _twists(time_s, distance_m, yaw_rad, wavelength_m, rng)
    T_imu_world = motion.integrate(np.eye(4), twist, np.diff(time_s))
    if isinstance(world, Loop):
        points_m = _around_ring(world, rng)
    else:
        points_m = _line_streets(world, distance_m, yaw_rad, se3.inverse(T_imu_world)[:, :3, 3], rng)
    return time_s, twist, T_imu_world, points_m


def _drive_streets(time_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return distance (T,) m and heading (T,) rad in a city, both 0 at the first stamp."""
    accelerate_s, brake_s, stand_s, start_s, turn_s = 3.5, 3.5, 3.0, 3.0, 5.0
    streets = int(time_s[-1] / (accelerate_s + brake_s + turn_s)) + 1
    cruise_m_s = rng.uniform(9.0, 12.0, (streets, 2))
    stops = np.arange(streets) % 3 == 1
    angle = np.deg2rad(np.resize([90.0, 90.0, -90.0, -90.0], streets) + 3.0 * rng.standard_normal(streets))
    brake_to = np.where(stops, 0.0, TURN_SPEED_M_S)

    manoeuvres = np.zeros((streets, 6, 3))
    manoeuvres[:, 0, 0], manoeuvres[:, 0, 1] = accelerate_s, cruise_m_s[:, 0]
    manoeuvres[:, 1, 0], manoeuvres[:, 1, 1] = rng.uniform(1.5, 5.0, streets), cruise_m_s[:, 1]
    manoeuvres[:, 2, 0], manoeuvres[:, 2, 1] = brake_s, brake_to
    manoeuvres[:, 3, 0], manoeuvres[:, 3, 1] = stand_s * stops, brake_to
    manoeuvres[:, 4, 0], manoeuvres[:, 4, 1] = start_s * stops, TURN_SPEED_M_S
    manoeuvres[:, 5] = np.stack([np.full(streets, turn_s), np.full(streets, TURN_SPEED_M_S), angle], axis=-1)
    duration, end_speed, turn = manoeuvres.reshape(-1, 3).T

    start_speed = np.concatenate([[TURN_SPEED_M_S], end_speed[:-1]])
    length = duration * (start_speed + end_speed) / 2
    start_time, start_distance, start_yaw = (np.cumsum(x) - x for x in (duration, length, turn))
    i = np.searchsorted(start_time, time_s, side="right") - 1
    x = (time_s - start_time[i]) / duration[i]
    # Integrals of a speed that goes over by the smooth step 3x^2 - 2x^3, and a yaw rate that swells as 1 - cos(2 pi x).
    ramp = x**3 - x**4 / 2
    distance = start_distance[i] + duration[i] * (start_speed[i] * x + (end_speed[i] - start_speed[i]) * ramp)
    return distance, start_yaw[i] + turn[i] * (x - np.sin(2 * np.pi * x) / (2 * np.pi))


def _twists(time_s: Array, distance_m: Array, yaw_rad: Array, wavelength_m: float, rng: np.random.Generator) -> Array:
    """Return true velocities (T, 6) of the drive on an uneven road, whose waves depend on the place alone."""
    harmonics = np.arange(1, 4)
    amplitude = _UNEVENNESS * rng.standard_normal((len(harmonics), 4)) / np.sqrt(len(harmonics))
    waves = np.sin(2 * np.pi / wavelength_m * distance_m[:, None] * harmonics) @ amplitude
    x_axis, y_axis, z_axis = np.eye(3)
    turns = (yaw_rad[:, None] * z_axis, waves[:, :1] * y_axis, waves[:, 1:2] * x_axis)
    yaw, pitch, roll = (se3.so3_exp(turn) for turn in turns)
    R_world_imu = yaw @ pitch @ roll
    tau = np.diff(time_s)[:, None]
    speed = np.diff(distance_m)[:, None] / tau
    v = speed * np.concatenate([np.ones_like(speed), waves[1:, 2:]], axis=-1)
    w = se3.so3_log(np.swapaxes(R_world_imu[:-1], -1, -2) @ R_world_imu[1:]) / tau
    twist = np.concatenate([v, w], axis=-1)
    return np.concatenate([twist[:1], twist])  # the first sample drives an interval before the recording


def _around_ring(world: Loop, rng: np.random.Generator) -> Array:
    """Return landmark positions (N, 3) in world."""
    # The camera's field of view never reaches points nearer to the centre than 0.77 radii.
    verge, inner, outer = ROAD_HALF_WIDTH_M / 2, 0.2 * world.radius_m, world.landmark_offset_m
    offset = rng.uniform(verge - inner, outer - verge, world.landmarks)
    radius = world.radius_m + offset + np.where(offset > 0, verge, -verge)
    angle = rng.uniform(0.0, 2 * np.pi, world.landmarks)
    height = GROUND_M + rng.uniform(0.0, world.landmark_height_m, world.landmarks)
    return np.stack([radius * np.cos(angle), world.radius_m + radius * np.sin(angle), height], axis=-1)


def _line_streets(world: City, distance_m: Array, yaw_rad: Array, position_m: Array, rng: np.random.Generator) -> Array:
    """Return points (N, 3) in world: facades on both sides, street furniture in front of them, and kerbs."""
    # The street goes on past the last frame, where the vehicle still looks ahead.
    ahead = np.array([np.cos(yaw_rad[-1]), np.sin(yaw_rad[-1]), 0.0])
    path_s = np.append(distance_m, distance_m[-1] + world.max_range_m)
    path = np.concatenate([position_m, [position_m[-1] + world.max_range_m * ahead]])
    path_yaw = np.append(yaw_rad, yaw_rad[-1])

    count = rng.poisson(world.landmarks_per_m * path_s[-1])
    s = rng.uniform(0.0, path_s[-1], count)
    side = rng.integers(0, 2, count)
    building = (s / 17.0).astype(int)
    facade_m = rng.uniform(7.0, 19.5, (int(path_s[-1] / 17.0) + 1, 2))[building, side]
    kind = rng.choice(3, count, p=[0.6, 0.2, 0.2])
    aside = [facade_m + rng.uniform(0.0, 0.5, count), rng.uniform(ROAD_HALF_WIDTH_M, facade_m)]
    lateral = np.choose(kind, [*aside, rng.uniform(ROAD_HALF_WIDTH_M, 7.0, count)])
    height = np.choose(kind, [rng.uniform(0.0, 8.0, count), rng.uniform(0.0, 3.0, count), rng.uniform(0, 0.15, count)])

    yaw = np.interp(s, path_s, path_yaw)
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    points = np.stack([np.interp(s, path_s, coordinate) for coordinate in path.T], axis=-1)
    points[:, :2] += np.where(side, 1.0, -1.0)[:, None] * lateral[:, None] * left
    points[:, 2] += GROUND_M + height
    return points
