"""Live use: velocities and images as they come, at any rates, in any order within a stated delay.

See docs/live.md. An image is processed once a message stamped ``delay_s`` later has arrived; older messages are then
rejected. So the filter, ``live.ekf``, is that of the recording in order. Later poses follow from it by the velocities.

A velocity at stamp s holds since the one before, as in a recording. Those between two images act as one: the constant
velocity that leads to the same pose. Its noise is that of the model at any rate of velocities.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left, bisect_right
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.checks import require_finite, require_shape
from ekfslam.data.interval import Interval
from ekfslam.data.noise import Noise
from ekfslam.errors import ConfigError, DuplicateObservationError, LateError, MissingVelocityError, StampError
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.prediction import predict
from ekfslam.filters.reports import FrameReport
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.sensors.stereo import Rig


class Pose(NamedTuple):
    """A pose (4, 4) at a stamp, with the covariance (6, 6) of its error ``xi``.

    ``is_held`` says that the last velocity was extrapolated because none had arrived for the stamp.
    """

    time_s: float
    T_world_imu: Array
    covariance: Array
    is_held: bool


@dataclasses.dataclass
class LiveCounts:
    """Counts of all messages: none is dropped without being counted.

    Args:
        velocities, images: Messages in time.
        taken_in: Images that the filter has processed.
        late_velocities, late_images: Rejected messages, older than the last processed image.
        out_of_order: Messages in time that came after a later one of their kind.
        held: Images processed with an extrapolated velocity, since none had arrived in time.
        gaps: Images after velocities more than ``gap_s`` apart.
    """

    velocities: int = 0
    images: int = 0
    taken_in: int = 0
    late_velocities: int = 0
    late_images: int = 0
    out_of_order: int = 0
    held: int = 0
    gaps: int = 0


class _Velocities:
    """Velocities in the order of their stamps."""

    def __init__(self) -> None:
        self.stamps: list[float] = []
        self._twists: list[Array] = []

    def add(self, twist: Array, t: float) -> None:
        at = bisect_left(self.stamps, t)
        if at < len(self.stamps) and self.stamps[at] == t:
            raise StampError(f"there are two velocities at {t:.6f} s", field="t")
        self.stamps.insert(at, t)
        self._twists.insert(at, twist)

    def at(self, t: float) -> tuple[Array, bool]:
        """Return the velocity (6,) at a stamp, and whether it is the last one, extrapolated."""
        at = min(bisect_left(self.stamps, t), len(self.stamps) - 1)
        return self._twists[at], self.stamps[-1] < t

    def during(self, begin: float, end: float, gap_s: float) -> tuple[Interval, bool]:
        """Return the velocities between two stamps, and whether the last one is extrapolated.

        The interval is a gap if velocities in it are more than ``gap_s`` apart.
        """
        if not self.stamps:
            raise MissingVelocityError(end)
        stamps, last = self.stamps, len(self.stamps) - 1
        first, stop = bisect_right(stamps, begin), min(bisect_left(stamps, end), last)
        pieces, is_held = range(min(first, stop), stop + 1), stamps[last] < end
        is_gap = any(i > 0 and stamps[i] - stamps[i - 1] > gap_s for i in pieces)
        bounds = np.array([begin, *(stamps[i] for i in pieces[:-1]), end])
        twists = np.array([self._twists[i] for i in pieces])
        return Interval(end - begin, np.diff(bounds), twists, is_gap), is_held

    def forget(self, before: float) -> None:
        """Drop velocities older than a stamp, but keep the newest of them: it marks where the next interval begins."""
        keep = max(bisect_right(self.stamps, before) - 1, 0)
        del self.stamps[:keep], self._twists[:keep]


class LiveEKF:
    """The joint filter behind a window of messages, see the module.

    Args:
        ekf: New filter; with a `MapRevival` if landmarks shall come back.
        delay_s: Time for which an image waits for older messages.
        gap_s: Spacing of velocities above which the noise of a gap applies.
        history_s: Time before the last processed image for which `pose` answers.
        late: ``raise`` an error at a late message, or only ``count`` it.

    Raises:
        ConfigError: A time is negative.

    Attributes:
        ekf: Filter after the last processed image: its ``P``, ``ids``, ``positions_m``, ``covariance_of``.
        counts: `LiveCounts`.
        time_s: Stamp of that image; None before the first.
    """

    def __init__(
        self,
        ekf: JointEKF,
        delay_s: float = 0.0,
        gap_s: float = np.inf,
        history_s: float = 1.0,
        late: Literal["raise", "count"] = "raise",
    ) -> None:
        if not (delay_s >= 0 and gap_s > 0 and history_s >= 0):
            raise ConfigError("delay_s and history_s must not be negative, and gap_s must be positive")
        self.ekf, self.counts = ekf, LiveCounts()
        self.delay_s, self.gap_s, self.history_s, self.late = delay_s, gap_s, history_s, late
        self.time_s: float | None = None
        self._velocities = _Velocities()
        self._waiting: list[tuple[float, IntArray, Array]] = []
        self._newest = {"velocity": -np.inf, "image": -np.inf}
        self._past: list[tuple[float, Estimate]] = []

    @classmethod
    def from_rig(
        cls,
        camera: StereoCamera,
        T_cam_imu: Array,
        noise: Noise,
        T_world_imu: Array | None = None,
        config: FilterConfig | None = None,
        **window: Any,
    ) -> LiveEKF:
        """Return the live filter of a stereo rig with measured velocities.

        Args:
            camera: Rectified pair.
            T_cam_imu: (4, 4) IMU to left optical frame.
            noise: White noise of velocities and pixels.
            T_world_imu: (4, 4) first pose; by default the origin of world.
            config: Settings of the filter; by default landmarks out of view are retired.
            window: ``delay_s``, ``gap_s``, ``history_s`` and ``late`` of `LiveEKF`.
        """
        settings = FilterConfig(retire="unseen") if config is None else config
        start = np.eye(4) if T_world_imu is None else T_world_imu
        return cls(JointEKF(Rig(camera, T_cam_imu, noise), settings, start), **window)

    @property
    def newest_s(self) -> float:
        """The newest stamp of all messages; minus infinity before the first."""
        return max(self._newest.values())

    def predict(self, velocities: ArrayLike, t: float) -> list[FrameReport]:
        """Take a measured velocity, and return reports on the images that could be processed then.

        Args:
            velocities: (6,) ``[v; w]``, m/s and rad/s, which holds since the stamp of the one before.
            t: Stamp in s.

        Raises:
            DataError: No six finite numbers, or a stamp that another velocity has.
            LateError: The filter has had a later image already.
            FilterError: The filter cannot go on.
        """
        twist = np.array(velocities, dtype=float)
        require_shape(twist, (6,), "velocities")
        require_finite(twist, "velocities")
        if not self._in_time("velocity", t):
            return []
        self._velocities.add(twist, t)
        self.counts.velocities += 1
        return self._arrived("velocity", t)

    def update(self, ids: ArrayLike, pixels: ArrayLike, t: float) -> list[FrameReport]:
        """Take the tracks of an image, and return reports on the images that could be processed then.

        Args:
            ids: (n,) landmark ids, distinct.
            pixels: (n, 4) rectified pixels (uL, vL, uR, vR), or the measurements of another sensor.
            t: Stamp in s.

        Raises:
            DataError: Shapes disagree, a number is not finite, an id occurs twice, or another image has the stamp.
            LateError: The filter has had a later image already.
            FilterError: The filter cannot go on.
        """
        landmark, measured = np.array(ids, dtype=np.int64).ravel(), np.array(pixels, dtype=float)
        measured = measured.reshape(0, 4) if not measured.size else measured
        require_shape(measured, (len(landmark), None), "pixels")
        require_finite(measured, "pixels")
        order = np.argsort(landmark, kind="stable")
        landmark, measured = landmark[order], measured[order]
        twice = np.flatnonzero(np.diff(landmark) == 0)
        if len(twice):
            raise DuplicateObservationError(f"landmark {landmark[twice[0]]} is observed twice", field="ids")
        if not self._in_time("image", t):
            return []
        at = bisect_left(self._waiting, t, key=lambda image: image[0])
        if at < len(self._waiting) and self._waiting[at][0] == t:
            raise StampError(f"there are two images at {t:.6f} s", field="t")
        self._waiting.insert(at, (t, landmark, measured))
        self.counts.images += 1
        return self._arrived("image", t)

    def flush(self) -> list[FrameReport]:
        """Process all images that wait, since nothing more will come, and return reports on them.

        Raises:
            MissingVelocityError: No velocity has come at all.
            FilterError: The filter cannot go on.
        """
        if self._waiting and not self._velocities.stamps:
            raise MissingVelocityError(self._waiting[0][0])
        return self._take_in(np.inf)

    def pose(self, t: float | None = None) -> Pose:
        """Return the pose at a stamp, by default the newest one, given the images processed until then.

        Raises:
            LateError: The stamp is over ``history_s`` before the last processed image, or there is none.
            MissingVelocityError: No velocity has come.
        """
        t = self.newest_s if t is None else t
        at = bisect_right(self._past, t, key=lambda past: past[0]) - 1
        if at < 0:
            raise LateError("pose", t, self._past[0][0] if self._past else None)
        begin, then = self._past[at]
        is_held = False
        if t > begin:
            interval, is_held = self._velocities.during(begin, t, self.gap_s)
            then = then.without_landmarks()
            predict(then, _distrusted(interval, is_held), None)
        return Pose(t, then.T_world_imu, then.gaussian.body_covariance[:6, :6].copy(), is_held)

    def _in_time(self, kind: Literal["velocity", "image"], t: float) -> bool:
        """Return whether a message is in time; count it or raise if it is late."""
        require_finite(np.array(t, dtype=float), "t")
        if self.time_s is None or t > self.time_s:
            return True
        self.counts.late_velocities += kind == "velocity"
        self.counts.late_images += kind == "image"
        if self.late == "raise":
            raise LateError(kind, t, self.time_s)
        return False

    def _arrived(self, kind: str, t: float) -> list[FrameReport]:
        self.counts.out_of_order += t < self._newest[kind]
        self._newest[kind] = max(self._newest[kind], t)
        return self._take_in(self.newest_s - self.delay_s)

    def _take_in(self, until: float) -> list[FrameReport]:
        """Process the images up to a stamp, in their order; none before the first velocity."""
        reports = []
        while self._waiting and self._waiting[0][0] <= until and self._velocities.stamps:
            (t, ids, measured), begin = self._waiting[0], self.time_s
            if begin is None:
                twist, is_held = self._velocities.at(t)
                self.ekf.begin(twist)
            else:
                interval, is_held = self._velocities.during(begin, t, self.gap_s)
                self.ekf.predict(_distrusted(interval, is_held))
                self.counts.gaps += interval.is_gap
            self.counts.held += is_held
            del self._waiting[0]
            reports.append(self.ekf.update(self.counts.taken_in, ids, measured))
            self.counts.taken_in += 1
            self.time_s = t
            self._past.append((t, self.ekf.without_landmarks()))
            self._past = [past for past in self._past if past[0] >= t - self.history_s]
            self._velocities.forget(self._past[0][0])
        return reports


def _distrusted(interval: Interval, is_held: bool) -> Interval:
    """Return an interval with the noise of a gap if its velocity is extrapolated."""
    return dataclasses.replace(interval, is_gap=True) if is_held else interval
