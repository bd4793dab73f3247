"""Settings that all simulated worlds share, and the tracker that sees their landmarks."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.observations import Observations
from ekfslam.errors import ConfigError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera, project
from ekfslam.names import printable

BORDER_PX = 5.0  # wide enough for the noise not to push a pixel out of the image
OUTLIER_SHIFT_PX = (5.0, 40.0)
_FRAMES_PER_CHUNK = 100  # a stretch of road short enough for most landmarks of a long drive to be out of range

# Beyond these a simulation would take hours or more memory than there is, or say nothing.
_LEAST, _LARGEST = 1e-12, 1e6
_MOST = {
    "seed": float("inf"),
    "frames": 100_000,
    "frame_period_s": 1e3,
    "max_tracks": 10_000,
    "max_range_m": 1e4,
    "landmarks": 20_000,
    "landmarks_per_m": 100.0,
    "radius_m": 1e5,
    "speed_m_s": 1e3,
    "sigma_v_m_s": 1e3,
    "sigma_w_rad_s": 1e3,
    "sigma_px": 1e3,
    "initial_position_std_m": 1e4,
    "initial_rotation_std_rad": 10.0,
}
_KINDS = {"str": str, "int": int, "float": float}
_MOST_IN_VIEW = 20_000_000  # landmarks times frames


def require_kind(name: str, key: str, value: object, kind: type) -> None:
    """Raise a `ConfigError` if a setting is no printable text, no whole number, or no number, as its kind says."""
    if kind is str:
        fits = isinstance(value, str) and value == printable(value)
    else:
        fits = isinstance(value, int | np.integer | (float | np.floating if kind is float else int))
    if not fits or isinstance(value, bool):
        words = {str: "a printable text", int: "a whole number", float: "a number"}[kind]
        raise ConfigError(f"{printable(str(name))}: {key} must be {words}, found {value!r}")


@dataclass(frozen=True)
class Recording:
    """Settings of every world: sampling, noise, and the limits of the tracker."""

    name: str  # name of the sequence
    seed: int = 0  # seed of the generator
    frames: int = 1000  # number of stamps, at least 2
    frame_period_s: float = 0.1  # nominal time between stamps
    stamp_jitter_s: float = 0.001  # standard deviation of a stamp (cut at a third of the period)
    sigma_px: float = 1.0  # white noise of each of the four pixels
    # min_disparity_px, max_range_m: Landmarks with less disparity, or farther from the camera, are not tracked.
    min_disparity_px: float = 6.0
    max_range_m: float = 40.0
    max_tracks: int = 1000  # the tracker follows no more landmarks than this at a time
    loss_probability: float = 0.0  # chance that the tracker misses a visible landmark in a frame
    outlier_fraction: float = 0.0  # share of observations that are grossly displaced

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            require_kind(self.name, field.name, getattr(self, field.name), _KINDS[str(field.type)])
        for key, value in numbers_of(self).items():
            most = _MOST.get(key, _LARGEST)
            if not (value == 0 or _LEAST <= value <= most):
                allowed = f"finite and not negative: 0, or {_LEAST:g} to {most:g}"
                raise ConfigError(f"{self.name}: {key} must be {allowed}, found {value}")
            if value == 0 and key in ("frame_period_s", "radius_m"):
                raise ConfigError(f"{self.name}: {key} must be positive")
        if self.frames < 2:
            raise ConfigError(f"{self.name}: frames must be at least 2, found {self.frames}")
        for key in ("loss_probability", "outlier_fraction"):
            if getattr(self, key) > 1:
                raise ConfigError(f"{self.name}: {key} must be in [0, 1], found {getattr(self, key)}")
        if self.frames * max(self.in_view, 1.0) > _MOST_IN_VIEW:
            found = f"{self.frames} frames of about {self.in_view:.0f} landmarks"
            raise ConfigError(f"{self.name}: {found} are too many, at most {_MOST_IN_VIEW} together")

    @property
    def in_view(self) -> float:
        """Approximate number of landmarks within reach of a frame."""
        return 0.0


class View(NamedTuple):
    """A stereo camera on the body: intrinsics, width and height of its images, and extrinsics (4, 4)."""

    camera: StereoCamera
    size_px: tuple[int, int]
    T_cam_imu: Array


def numbers_of(world: Recording) -> dict[str, int | float]:
    """Return the numeric parameters of a world by name."""
    return {key: value for key, value in dataclasses.asdict(world).items() if type(value) in (int, float)}


def parameters_of(world: Recording) -> dict[str, str | int | float]:
    """Return the parameters of a world that a variation may change: its numbers, and texts but the name."""
    texts = {key: value for key, value in vars(world).items() if type(value) is str and key != "name"}
    return {**numbers_of(world), **texts}


def visible(world: Recording, view: View, T_imu_world: Array, points_m: Array) -> tuple[IntArray, IntArray, Array]:
    """Return frame (K,), index of the point (K,) and exact pixels (K, 4), eq. (3), of all visible points."""
    T_cam_world = view.T_cam_imu @ T_imu_world
    camera_m = se3.inverse(T_cam_world)[:, :3, 3]
    found = []
    for start in range(0, len(T_cam_world), _FRAMES_PER_CHUNK):
        chunk = slice(start, start + _FRAMES_PER_CHUNK)
        low, high = camera_m[chunk].min(axis=0), camera_m[chunk].max(axis=0)
        near = np.abs(points_m - (low + high) / 2) < (high - low) / 2 + world.max_range_m
        candidates = np.flatnonzero(near.all(axis=-1))
        q = T_cam_world[chunk, :3, :3] @ points_m[candidates].T + T_cam_world[chunk, :3, 3:]
        frame, candidate = np.nonzero((q[:, 2] > 0) & (np.sum(q * q, axis=1) < world.max_range_m**2))
        pixels = project(view.camera, q[frame, :, candidate])
        seen = _inside(view, pixels) & (pixels[:, 0] - pixels[:, 2] > world.min_disparity_px)
        found.append((start + frame[seen], candidates[candidate[seen]], pixels[seen]))
    frames, points, all_pixels = zip(*found, strict=True)
    return np.concatenate(frames), np.concatenate(points), np.concatenate(all_pixels)


def tracked(world: Recording, frame: IntArray, point: IntArray, points: int, rng: np.random.Generator) -> BoolArray:
    """Return whether (K,) the tracker makes a visible observation: it prefers some points, and loses some."""
    preference = rng.random(points)
    order = np.lexsort((preference[point], frame))
    place = np.arange(len(order)) - np.searchsorted(frame[order], frame[order])
    kept = rng.random(len(frame)) >= world.loss_probability
    kept[order[place >= world.max_tracks]] = False
    return kept


def _inside(view: View, pixels: Array) -> BoolArray:
    """Return whether (K,) pixels (K, 4) are within both images, off the border."""
    limit = np.tile(view.size_px, 2) - 1 - BORDER_PX
    return np.asarray(((pixels >= BORDER_PX) & (pixels <= limit)).all(axis=-1))


def outlier_shifts(world: Recording, view: View, pixels: Array, rng: np.random.Generator) -> Array:
    """Return displacements of pixels (K, 4): 0, or of outliers, which keep rows and a positive disparity."""
    shifts = np.zeros_like(pixels)
    wrong = np.flatnonzero(rng.random(len(pixels)) < world.outlier_fraction)
    z = pixels[wrong]
    size = rng.uniform(*OUTLIER_SHIFT_PX, len(wrong))
    direction = rng.uniform(0.0, 2 * np.pi, len(wrong))
    du, dv = size * np.cos(direction), size * np.sin(direction)
    stretch = rng.uniform(-0.5, 0.5, len(wrong)) * np.minimum(np.abs(du), z[:, 0] - z[:, 2])
    # A jump out of the image goes the other way; the image is wide enough for one of the two.
    right = z[:, 2] - stretch
    low, high = np.minimum(z[:, 0], right) + du, np.maximum(z[:, 0], right) + du
    du = np.where((low < BORDER_PX) | (high > view.size_px[0] - 1 - BORDER_PX), -du, du)
    row = z[:, 1] + dv
    dv = np.where((row < BORDER_PX) | (row > view.size_px[1] - 1 - BORDER_PX), -dv, dv)
    shifts[wrong] = np.stack([du, dv, du - stretch, dv], axis=-1)
    return shifts


def track_ids(frame: IntArray, point: IntArray) -> IntArray:
    """Return an id (K,) for each unbroken run of frames of a point, counted from 0 in order of appearance."""
    order = np.lexsort((frame, point))
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (np.diff(point[order]) != 0) | (np.diff(frame[order]) != 1)
    appearance = np.lexsort((point[order][starts], frame[order][starts]))
    rank = np.empty(len(appearance), dtype=np.int64)
    rank[appearance] = np.arange(len(appearance))
    ids = np.empty(len(order), dtype=np.int64)
    ids[order] = rank[np.cumsum(starts) - 1]
    return ids


def observed(
    world: Recording, view: View, T_imu_world: Array, points_m: Array, rng: np.random.Generator, ids_last: bool
) -> tuple[Observations, IntArray, Array]:
    """Return what the tracker sees of points (N, 3), and ids (M,) and positions (M, 3) of what is seen."""
    frame, point, pixels = visible(world, view, T_imu_world, points_m)
    kept = tracked(world, frame, point, len(points_m), rng)
    frame, point, pixels = frame[kept], point[kept], pixels[kept]
    pixels = pixels + outlier_shifts(world, view, pixels, rng) + world.sigma_px * rng.standard_normal(pixels.shape)
    landmark = point if ids_last else track_ids(frame, point)
    ids, an_observation = np.unique(landmark, return_index=True)
    return Observations(frame, landmark, pixels), ids, points_m[point[an_observation]]


def stamps(world: Recording, rng: np.random.Generator) -> Array:
    """Return stamps (T,) from 0, with a jitter too small to swap two of them."""
    limit = world.frame_period_s / 3
    jitter = np.clip(world.stamp_jitter_s * rng.standard_normal(world.frames), -limit, limit)
    time_s = world.frame_period_s * np.arange(world.frames) + jitter
    return time_s - time_s[0]
