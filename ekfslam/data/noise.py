"""Standard deviations of velocities, pixels and tracks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.checks import LARGEST_VELOCITY, require_finite, require_shape
from ekfslam.errors import DataError
from ekfslam.stored import stored

# Share of the squared motion of a track's other rows that counts for a row, see `TrackError.step_variance`.
ACROSS = 0.35


@dataclass(frozen=True)
class ProcessNoise:
    """Errors of the velocities that move the pose."""

    twist_std: Array  # (6,) white noise of a sample, m/s and rad/s
    motion_std: Array  # (6,) error of the motion beyond it, which no averaging of velocities removes
    # (6,) change of the true velocities from one sample to the next. None: nothing is assumed of it.
    walk_std: Array | None
    gap_std: Array  # (6,) further error of samples that were interpolated across a gap

    def pose_std_during(self, is_gap: BoolArray | bool, doubt: Array | float = 1.0) -> Array:
        """Return the error (..., 6) of velocities that move the pose, interpolated or not, times ``doubt`` (...)."""
        std = np.hypot(self.pose_std, np.where(np.asarray(is_gap)[..., None], self.gap_std, 0.0))
        return std * np.asarray(doubt)[..., None]

    @property
    def velocity_std(self) -> Array:
        """(6,) error of one sample as a whole: ``twist_std`` and ``motion_std`` together."""
        return np.hypot(self.twist_std, self.motion_std)

    @property
    def pose_std(self) -> Array:
        """(6,) error of the velocities that move the pose: ``motion_std`` alone where the twist is a state block."""
        return self.velocity_std if self.walk_std is None else self.motion_std


@dataclass(frozen=True)
class TrackError:
    """Error of a track in the image, eq. (10): it starts with the track and then walks.

    ``z(k) = h(k) + e(k)`` with ``e ~ N(0, first^2)`` at landmark initialisation, then ``e(k) = e(k-1) + N(0, walk^2 (1
    + (flow / flow_px)^2 + (way / depth / parallax)^2))``: features are followed worse the further they move, and the
    more their surroundings are deformed.
    """

    first_std: Array  # (3,) standard deviation at landmark initialisation, in the sensor's rows, px
    walk_std: Array  # (3,) of the innovation from one frame to the next, px
    flow_px: float  # motion in the image at which the variance of the walk has doubled; infinite: it never grows
    # Way of the camera, as a share of the depth, at which the variance of the walk has doubled.
    parallax: float = np.inf

    def step_variance(self, motion_px: Array, parallax: Array, frames: int = 1) -> Array:
        """Return the variances (n, d) of differences from the frame before, or from one some frames before.

        The error of a row grows with its own motion (n, d) px, and with the share `ACROSS` of the others'; ``parallax``
        (n,) is the way of the camera over the depth. Over several frames the motion is taken as even.
        """
        square = (np.asarray(motion_px) / frames) ** 2
        flow = (1.0 - ACROSS) * square + ACROSS * square.sum(axis=1, keepdims=True)
        way = parallax[:, None] / frames
        return frames * self.walk_std**2 * (1.0 + flow / self.flow_px**2 + (way / self.parallax) ** 2)

    def of_rows(self, dimension: int) -> TrackError:
        """Return the error of the first rows of a sensor: those of one camera are (u, v)."""
        return replace(self, first_std=self.first_std[:dimension], walk_std=self.walk_std[:dimension])

    def absolute_variance(self, age: IntArray) -> Array:
        """Return variances (n, 3) of observations that follow none: the spread of tracks of this age (n,)."""
        return self.first_std**2 + age[:, None] * self.walk_std**2


@dataclass(frozen=True)
class Noise:
    """Standard deviations of everything measured, one flat record that is kept with sequences and results.

    Args:
        twist_std: (6,) white noise of the velocities per sample, m/s and rad/s.
        pixel_std_px: (4,) white noise of the pixels (uL, vL, uR, vR).
        twist_walk_std: (6,) change of the true velocities from one sample to the next, which the joint filter then
            estimates. None: nothing is assumed of it.
        motion_std: (6,) error of the motion beyond ``twist_std``, which no averaging of velocities removes.
        tilt_rad: First roll and pitch against gravity of velocities in a level frame, which the joint filter then
            estimates. 0: the velocities are taken as those of the IMU frame.
        first_tilt: (2, 2) roll and pitch of the first pose against gravity, and their standard deviations, rad. None:
            level within ``tilt_rad``.
        track_first_px: (3,) error of a track at landmark initialisation (u, v, disparity), see `TrackError`. None:
            pixel noise is white.
        track_walk_px: (3,) change of that error from frame to frame (u, v, disparity).
        track_flow_px: Motion in the image at which the variance of the walk has doubled.
        track_parallax: Way of the camera over the depth at which the variance of the walk has doubled.
        gap_std: (6,) further error of velocities that were interpolated across a gap.
    """

    twist_std: Array = field(metadata=stored("u", "m/s (0-2), rad/s (3-5)", "imu"))
    pixel_std_px: Array = field(metadata=stored("pixels", "px", "image: uL, vL, uR, vR", name="pixel_std"))
    twist_walk_std: Array | None = None
    motion_std: Array = field(default_factory=lambda: np.zeros(6))
    tilt_rad: float = 0.0
    first_tilt: Array | None = None
    track_first_px: Array | None = None
    track_walk_px: Array | None = None
    track_flow_px: float = np.inf
    track_parallax: float = np.inf
    gap_std: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def process(self) -> ProcessNoise:
        """The part that belongs to the velocities."""
        return ProcessNoise(self.twist_std, self.motion_std, self.twist_walk_std, self.gap_std)

    @property
    def track_error(self) -> TrackError | None:
        """The part that belongs to tracks; None where pixel noise is white."""
        if self.track_first_px is None or self.track_walk_px is None:
            return None
        first, walk = np.asarray(self.track_first_px), np.asarray(self.track_walk_px)
        return TrackError(first, walk, self.track_flow_px, self.track_parallax)

    @property
    def velocity_std(self) -> Array:
        """(6,) error of one sample as a whole: ``twist_std`` and ``motion_std`` together."""
        return self.process.velocity_std

    @staticmethod
    def isotropic(sigma_v_m_s: float, sigma_w_rad_s: float, sigma_px: float) -> Noise:
        """Return white noise with one standard deviation each for linear velocities, angular velocities and pixels."""
        return Noise(np.repeat([sigma_v_m_s, sigma_w_rad_s], 3), np.full(4, float(sigma_px)))


def validate_noise(noise: Noise) -> None:
    """Raise a `DataError` for standard deviations of other shapes, or that are none."""
    sizes = {"twist_std": 6, "pixel_std_px": 4, "motion_std": 6, "gap_std": 6}
    optional = {"twist_walk_std": 6, "track_first_px": 3, "track_walk_px": 3}
    for name, size in (sizes | optional).items():
        if name in optional and getattr(noise, name) is None:
            continue
        value = np.asarray(getattr(noise, name), dtype=float)
        require_shape(value, (size,), f"noise.{name}")
        require_finite(value, f"noise.{name}", LARGEST_VELOCITY)
        if (value < 0).any():
            raise DataError("standard deviations must not be negative", field=f"noise.{name}")
    if not (np.isfinite(noise.tilt_rad) and noise.tilt_rad >= 0):
        raise DataError(f"must be finite and not negative, found {noise.tilt_rad}", field="noise.tilt_rad")
    if noise.first_tilt is not None:
        tilt = np.asarray(noise.first_tilt, dtype=float)
        require_shape(tilt, (2, 2), "noise.first_tilt")
        require_finite(tilt, "noise.first_tilt", np.pi)
        if not (tilt[1] > 0).all():
            raise DataError("standard deviations must be positive", field="noise.first_tilt")
    if (noise.track_first_px is None) != (noise.track_walk_px is None):
        raise DataError("track_first_px and track_walk_px belong together", field="noise.track_walk_px")
    for name in ("track_flow_px", "track_parallax"):
        if not getattr(noise, name) > 0:
            raise DataError(f"must be positive, found {getattr(noise, name)}", field=f"noise.{name}")
