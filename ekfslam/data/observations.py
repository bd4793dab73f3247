"""Observations of tracks and ground truth, from flat or dense arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import (
    LARGEST,
    LARGEST_DISTANCE_M,
    LARGEST_PX,
    LARGEST_VELOCITY,
    frozen,
    require_finite,
    require_rigid,
    require_shape,
)
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.errors import (
    DataError,
    DuplicateObservationError,
    EmptyTracksError,
    NonFiniteError,
    ShapeError,
    TruthError,
)
from ekfslam.shown import count
from ekfslam.stored import COUNTS, stored

LARGEST_ID = 1 << 62  # pieces of cut tracks count on from the largest
_WORDS = {2: "two", 4: "four"}
UNSEEN = -1.0  # all four pixels of an unseen track in dense formats; or NaN


@dataclass(frozen=True)
class Observations:
    """Observations of point landmarks as flat arrays, sorted by frame and, within a frame, by landmark id.

    Args:
        frame: (K,) frame index of each observation.
        landmark: (K,) id of the landmark; any non-negative integers.
        pixels_px: (K, 4) rectified pixels (uL, vL, uR, vR), or (K, 2) undistorted pixels (u, v) of one camera.
    """

    frame: IntArray = field(metadata=stored("K", "frame index", check=COUNTS))
    landmark: IntArray = field(metadata=stored("K", "landmark id", check=COUNTS))
    pixels_px: Array = field(metadata=stored("K pixels", "px", "image: uL, vL, uR, vR", name="pixels"))

    def __post_init__(self) -> None:
        frame = np.asarray(self.frame, dtype=np.int64).ravel()
        landmark = np.asarray(self.landmark, dtype=np.int64).ravel()
        pixels = np.asarray(self.pixels_px, dtype=float)
        if not len(frame) == len(landmark) == len(pixels) or pixels.shape not in ((len(frame), 4), (len(frame), 2)):
            found = f"{len(frame)} frames, {len(landmark)} landmarks and pixels of shape {pixels.shape}"
            raise ShapeError(f"{found} do not agree", field="observations")
        order = np.lexsort((landmark, frame))
        for name, value in (("frame", frame), ("landmark", landmark), ("pixels_px", pixels)):
            object.__setattr__(self, name, frozen(value[order]))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def is_monocular(self) -> bool:
        """Whether one camera saw them."""
        return self.pixels_px.shape[1] == 2

    @property
    def of_left_camera(self) -> Observations:
        """The observations of the left camera alone."""
        return Observations(self.frame, self.landmark, self.pixels_px[:, :2])

    @cached_property
    def ids(self) -> IntArray:
        """Distinct landmark ids, ascending."""
        return np.unique(self.landmark)

    def at(self, frame: int) -> tuple[IntArray, Array]:
        """Return landmark ids (n,) and pixels (n, 4) or (n, 2) of one frame."""
        start, stop = self.frame.searchsorted((frame, frame + 1))
        return self.landmark[start:stop], self.pixels_px[start:stop]

    def stretch(self, begin: int, end: int) -> Observations:
        """Return the observations of frames ``begin`` to ``end - 1``, which count from 0 again."""
        seen = slice(*np.searchsorted(self.frame, (begin, end)))
        return Observations(self.frame[seen] - begin, self.landmark[seen], self.pixels_px[seen])


@dataclass(frozen=True)
class TrueMotion:
    """True velocities (F, 3) of the IMU in world, and biases (F, 3) of its samples."""

    velocity_m_s: Array = field(metadata=stored("F xyz", "m/s", "world"))
    gyro_bias_rad_s: Array = field(metadata=stored("F xyz", "rad/s", "imu"))
    accel_bias_m_s2: Array = field(metadata=stored("F xyz", "m/s^2", "imu"))

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, frozen(np.asarray(value, dtype=float)))


@dataclass(frozen=True)
class Truth:
    """Ground truth: poses of some or all frames, and of landmarks where known.

    Args:
        frame: (F,) ascending frame indices for which the pose is known.
        T_world_imu: (F, 4, 4) true poses.
        landmark: (M,) ids of landmarks with known position (may be empty).
        position_m: (M, 3) their positions in world.
        noise: Errors of the poses themselves; None if they are exact, or their errors are unknown.
        motion: Velocities and biases of the same frames; None if unknown.
    """

    frame: IntArray = field(metadata=stored("F", "frame index", check=COUNTS))
    T_world_imu: Array = field(metadata=stored("F row column", "m (translation)", "world from imu"))
    landmark: IntArray = field(
        default_factory=lambda: np.empty(0, dtype=np.int64),
        metadata=stored("M", "landmark id", check=COUNTS, name="landmarks/id"),
    )
    position_m: Array = field(
        default_factory=lambda: np.empty((0, 3)), metadata=stored("M xyz", "m", "world", name="landmarks/position")
    )
    noise: TruthNoise | None = None
    motion: TrueMotion | None = None

    def __post_init__(self) -> None:
        types = {"frame": np.int64, "landmark": np.int64, "T_world_imu": np.float64, "position_m": np.float64}
        for name, dtype in types.items():
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), dtype=dtype)))

    @property
    def text(self) -> str:
        """Numbers of poses and landmarks in words."""
        landmarks = f", {count(len(self.landmark), 'landmark')}" if len(self.landmark) else ""
        return count(len(self.frame), "pose") + landmarks

    def stretch(self, begin: int, end: int) -> Truth | None:
        """Return the truth of frames ``begin`` to ``end - 1``, which count from 0 again; None: no pose is known."""
        known = (self.frame >= begin) & (self.frame < end)
        if not known.any():
            return None
        motion = None if self.motion is None else TrueMotion(*(value[known] for value in vars(self.motion).values()))
        return replace(self, frame=self.frame[known] - begin, T_world_imu=self.T_world_imu[known], motion=motion)


def flat_observations(dense: Array, frame_axis: int, field: str) -> tuple[Observations, tuple[str, ...]]:
    """Return the observations, and notes, of a dense 4 x T x M (``frame_axis`` 1) or 4 x M x T (2) array of pixels.

    The index of a track is its landmark id. A track is unseen if all its pixels are -1 or NaN. If only the right two
    are, there is no depth: the observation is left out. Any other missing pixel is an error. One camera has 2 pixels.
    """
    missing = np.isnan(dense)
    missing |= dense == UNSEEN
    # Most entries are of tracks out of view: only the others are looked at more closely.
    first, second = np.nonzero(~missing.all(axis=0))
    pixels, unknown = dense[:, first, second], missing[:, first, second]
    seen, only_left = ~unknown.any(axis=0), unknown[2:].all(axis=0) & ~unknown[:2].any(axis=0) & (len(dense) > 2)
    partly = np.flatnonzero(~(seen | only_left))
    if len(partly):
        k = int(partly[0])
        row = int(np.argmax(unknown[:, k]))
        error: type[DataError] = ShapeError
        kind = f"have some but not all of their {_WORDS[len(dense)]} pixels equal to -1 (unseen)"
        if np.isnan(pixels[row, k]):
            error, kind = NonFiniteError, "are NaN in some of their pixels"
        raise error(f"{len(partly)} observations {kind}", field=field, index=(row, int(first[k]), int(second[k])))
    if not (unknown | (np.abs(pixels) <= LARGEST)).all():
        require_finite(np.where(missing, 0.0, dense), field)
    frame, landmark = (first, second) if frame_axis == 1 else (second, first)
    tracks = dense.shape[3 - frame_axis]
    never = tracks - np.count_nonzero(np.bincount(landmark, minlength=tracks))
    if tracks and not seen.any():
        raise EmptyTracksError(f"{never} tracks are never seen, which is all of them", field=field, index=0)
    notes = []
    if never:
        notes.append(f"{never} of {tracks} tracks are never seen and are left out.")
    if only_left.any():
        notes.append(f"{int(only_left.sum())} observations have no right pixels and are left out.")
    return Observations(frame[seen], landmark[seen], pixels[:, seen].T), tuple(notes)


def numbers(value: ArrayLike, name: str) -> Array:
    """Return an array of floating-point numbers; raise `ShapeError` if it is none."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"not an array of numbers ({error})", field=name) from None


def observations_of(
    pixels: Array, frame: ArrayLike | None, landmark: ArrayLike | None, frames: int
) -> tuple[Observations, tuple[str, ...]]:
    """Return the observations in arrays, and notes; for arguments and errors see `Sequence.from_tracks`."""
    if frame is None and landmark is None:
        require_shape(pixels, (frames, None, _columns(pixels)), "pixels_px")
        return flat_observations(np.moveaxis(pixels, -1, 0), frame_axis=1, field="pixels_px")
    if frame is None or landmark is None:
        raise ShapeError("frame and landmark belong together", field="landmark" if landmark is None else "frame")
    require_shape(pixels, (None, _columns(pixels)), "pixels_px")
    indices: list[IntArray] = []
    for name, value in (("frame", frame), ("landmark", landmark)):
        whole = numbers(value, name)
        require_shape(whole, (len(pixels),), name)
        require_finite(whole, name)
        if (whole != np.round(whole)).any():
            raise ShapeError("not whole numbers", field=name, index=int(np.argmax(whole != np.round(whole))))
        indices.append(np.asarray(value).astype(np.int64))
    return Observations(indices[0], indices[1], pixels), ()


def _columns(pixels: Array) -> int:
    """Return the columns that pixels of this shape should have."""
    return 2 if pixels.shape[-1:] == (2,) else 4


def truth_of(T_world_imu: Array, frames: int) -> Truth | None:
    """Return the poses (T, 4, 4) without NaN; None if there are none."""
    require_shape(T_world_imu, (frames, 4, 4), "T_world_imu")
    known = np.flatnonzero(~np.isnan(T_world_imu).any(axis=(1, 2)))
    return Truth(known, T_world_imu[known]) if len(known) else None


def _require_ids(landmark: IntArray, name: str) -> None:
    wrong = (landmark < 0) | (landmark > LARGEST_ID)
    if wrong.any():
        index = int(np.argmax(wrong))
        message = f"landmark ids must be from 0 to {LARGEST_ID}, found {landmark[index]}"
        raise ShapeError(message, field=name, index=index)


def validate_observations(observations: Observations, frames: int) -> None:
    """Raise a `DataError` for observations of unknown frames or ids, twice in a frame, or none at all."""
    if len(observations) == 0:
        raise EmptyTracksError("there is not one observation", field="observations")
    require_finite(observations.pixels_px, "observations.pixels_px", LARGEST_PX)
    outside = (observations.frame < 0) | (observations.frame >= frames)
    if outside.any():
        index = int(np.argmax(outside))
        message = f"frame {observations.frame[index]} does not exist, there are {frames}"
        raise ShapeError(message, field="observations.frame", index=index)
    _require_ids(observations.landmark, "observations.landmark")
    twice = (np.diff(observations.frame) == 0) & (np.diff(observations.landmark) == 0)
    if twice.any():
        index = int(np.argmax(twice)) + 1
        message = f"landmark {observations.landmark[index]} is observed twice in frame {observations.frame[index]}"
        raise DuplicateObservationError(message, field="observations", index=index)


def validate_truth(truth: Truth, frames: int) -> None:
    """Raise a `DataError` for true poses or landmarks of other shapes, or of other frames than these."""
    require_shape(truth.frame, (None,), "truth.frame")
    if np.shape(truth.T_world_imu) != (len(truth.frame), 4, 4):
        message = f"{len(truth.frame)} frames but poses of shape {np.shape(truth.T_world_imu)}"
        raise TruthError(message, field="truth.T_world_imu")
    if len(truth.frame) and (truth.frame[0] < 0 or truth.frame[-1] >= frames or (np.diff(truth.frame) <= 0).any()):
        raise TruthError(f"frames must ascend within 0..{frames - 1}", field="truth.frame")
    require_finite(truth.T_world_imu, "truth.T_world_imu", LARGEST_DISTANCE_M)
    require_rigid(truth.T_world_imu, "truth.T_world_imu", TruthError)
    for name, value in vars(truth.motion).items() if truth.motion is not None else ():
        require_shape(value, (len(truth.frame), 3), f"truth.motion.{name}")
        require_finite(value, f"truth.motion.{name}", LARGEST_VELOCITY)
    if np.shape(truth.position_m) != (len(truth.landmark), 3):
        message = f"{len(truth.landmark)} landmarks but positions of shape {np.shape(truth.position_m)}"
        raise TruthError(message, field="truth.position_m")
    _require_ids(truth.landmark, "truth.landmark")
    require_finite(truth.position_m, "truth.position_m", LARGEST_DISTANCE_M)
    for name, value in vars(truth.noise).items() if truth.noise is not None else ():
        if not (np.isfinite(value) and value >= 0):
            raise DataError(f"must be finite and not negative, found {value}", field=f"truth.noise.{name}")
