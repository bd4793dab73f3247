"""Live use: velocities or inertial samples, and images, as they come: at any rates, in any order within a stated delay.

See docs/live.md. An image is processed once a message stamped ``delay_s`` later has arrived; older messages are then
rejected. So the filter, ``live.ekf``, is that of the recording in order. Later poses follow from it by the inputs.

A velocity at stamp s holds since the one before, as in a recording. Those between two images act as one: the constant
velocity that leads to the same pose. Its noise is that of the model at any rate of velocities. Inertial samples are
linear between stamps; an image waits for the first sample at its stamp or later.

Every public call takes one lock. Arguments are checked before anything changes.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.checks import checked_pose
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.noise import Noise, validate_noise
from ekfslam.errors import ClockError, ConfigError, MissingVelocityError
from ekfslam.filters.admission import Admission, Dropped, Kind
from ekfslam.filters.door import ascending, checked_inputs, checked_numbers, checked_observations, checked_stamp
from ekfslam.filters.driven import Driven, copied
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.reports import FrameReport
from ekfslam.filters.streams import Samples, Velocities
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.build import blocks_and_process, model_of
from ekfslam.models.inertial_start import FirstPrior, at_rest
from ekfslam.models.model import Model
from ekfslam.models.process.inertial import GRAVITY_M_S2
from ekfslam.models.sensors.stereo import Rig

MOST_IMAGES = 10_000  # that wait


class Pose(NamedTuple):
    """A pose (4, 4) at a stamp, with the covariance (6, 6) of its error ``xi``.

    ``is_held`` says that the last inputs were extrapolated because none had arrived for the stamp.
    """

    time_s: float
    T_world_imu: Array
    covariance: Array
    is_held: bool

    def __repr__(self) -> str:
        at = " ".join(f"{x:.3f}" for x in self.T_world_imu[:3, 3])
        std = " ".join(f"{s:.2g}" for s in np.sqrt(np.diag(self.covariance)[:3]))
        held = ", inputs held" if self.is_held else ""
        return f"Pose at {self.time_s:.6f} s: position {at} m in world, std {std} m along the axes of the IMU{held}"


def require_window(
    *,
    delay_s: float = 0,
    history_s: float = 0,
    late: str = "raise",
    gap_s: float = 1,
    jump_s: float = 1,
    backlog: float = 1,
    log_frames: float = 1,
) -> None:
    """Raise a `ConfigError` for arguments that `LiveEKF` cannot have."""
    try:
        is_good = min(delay_s, history_s) >= 0 and min(gap_s, jump_s) > 0 and min(backlog, log_frames) >= 1
        has_nan = any(x != x for x in (delay_s, history_s, gap_s, jump_s, backlog, log_frames))
    except TypeError:
        is_good, has_nan = False, False
    if has_nan or not is_good:
        raise ConfigError("delay_s and history_s must not be negative; all other numbers must be positive")
    if late not in ("raise", "count"):
        raise ConfigError(f"late: expected 'raise' or 'count', found {late!r}")


class LiveEKF:
    """The joint filter behind a window of messages, see the module. Threads may share it.

    Args:
        ekf: New filter; with a `MapRevival` if landmarks shall come back.
        delay_s: Time for which an image waits for older messages.
        gap_s: Spacing of inputs above which the noise of a gap applies; for samples at most three times their step.
        history_s: Time before the last processed image for which `pose` answers.
        late: ``raise`` an error at a late, repeated, jumping or surplus message, or only ``count`` it.
        jump_s: Time by which a stamp may be after the newest one.
        backlog: Number of velocities or samples since the last image that may wait.
        log_frames: Frames after which the log and landmarks that have left are dropped; ``inf``: never. A filter with
            map revival or a relinearised window needs its log and always keeps it.

    Raises:
        ConfigError: A time is negative, or a number is not positive.

    Attributes:
        counts: `LiveCounts`.
        dropped: The last messages that were not used, `Dropped`.
        lock: Lock of every call; hold it to read several attributes of one moment.
    """

    def __init__(
        self,
        ekf: JointEKF,
        delay_s: float = 0.0,
        gap_s: float = np.inf,
        history_s: float = 1.0,
        late: Literal["raise", "count"] = "raise",
        *,
        jump_s: float = 10.0,
        backlog: int = 100_000,
        log_frames: float = 10_000,
    ) -> None:
        window = {"gap_s": gap_s, "jump_s": jump_s, "backlog": backlog, "log_frames": log_frames}
        require_window(delay_s=delay_s, history_s=history_s, late=late, **window)
        self.delay_s, self.gap_s, self.history_s = delay_s, gap_s, history_s
        self.jump_s, self.backlog, self.log_frames = jump_s, backlog, log_frames
        self.lock = threading.RLock()
        self._admission = Admission(late, jump_s)
        self.counts, self.dropped = self._admission.counts, self._admission.dropped
        self.is_inertial = ekf.model.process.takes is InertialSamples
        self._new = copied(ekf)
        self._start(ekf)

    def _start(self, ekf: JointEKF) -> None:
        """Begin with a new filter, without messages."""
        self._inputs = (Samples if self.is_inertial else Velocities)(self.gap_s)
        self._driven = Driven(ekf, self._inputs, self.history_s, self.log_frames, self.counts)
        self._waiting: list[tuple[float, IntArray, Array]] = []
        self._admission.start()
        self._reports: list[FrameReport] = []

    @classmethod
    def from_rig(
        cls,
        camera: StereoCamera,
        T_cam_imu: Array,
        noise: Noise,
        T_world_imu: Array | None = None,
        config: FilterConfig | None = None,
        *,
        imu: InertialNoise | None = None,
        rest: InertialSamples | None = None,
        **window: Any,
    ) -> LiveEKF:
        """Return the live filter of a stereo rig with measured velocities or an inertial unit.

        Args:
            camera, T_cam_imu: Rectified pair; (4, 4) IMU to left optical frame.
            noise: White noise of velocities and pixels.
            T_world_imu: (4, 4) first pose, by default the origin; with an inertial unit, gravity is along -z of world.
            config: Settings of the filter; by default landmarks out of view are retired.
            imu: Densities of an inertial unit that gives samples instead of velocities.
            rest: Samples of a rest before the first image, which give tilt and biases; the pose gives the remainder.
            window: Further arguments of `LiveEKF`.
        """
        settings = config or FilterConfig(retire="unseen")
        checked_pose(checked_numbers(T_cam_imu, "T_cam_imu"), "T_cam_imu")
        validate_noise(noise)
        start, rig = np.eye(4) if T_world_imu is None else T_world_imu, Rig(camera, T_cam_imu, noise)
        sensor = rig if imu is None else _inertial(rig, imu, start, settings, rest)
        return cls(JointEKF(sensor, settings, start), **window)

    @property
    def ekf(self) -> JointEKF:
        """Filter after the last processed image: its ``P``, ``ids``, ``positions_m``, ``covariance_of``."""
        return self._driven.ekf

    @property
    def time_s(self) -> float | None:
        """Stamp of the last processed image; None before the first."""
        return self._driven.time_s

    @property
    def newest_s(self) -> float:
        """The newest stamp of all messages; minus infinity before the first."""
        with self.lock:
            return self._admission.newest_s

    def predict(self, velocities: ArrayLike, t: float) -> list[FrameReport]:
        """Take a measured velocity, and return reports on the images that could be processed then.

        Args:
            velocities: (6,) ``[v; w]``, m/s and rad/s, which holds since the stamp of the one before.
            t: Stamp in s.

        Raises:
            ConfigError: The filter takes inertial samples.
            DataError: No six finite numbers, or a stamp that another velocity has.
            LateError: The filter has had a later image already.
            ClockError: The stamp is too far from all others, see docs/live.md.
            BacklogError: No image has come for too long.
            FilterError: The filter cannot process an image; it goes on without it.
        """
        if self.is_inertial:
            raise ConfigError("this filter takes inertial samples: call imu(gyro, accel, t)")
        return self._take_inputs("velocity", checked_inputs(velocities, 6, "velocities"), checked_stamp(t))

    def imu(self, gyro: ArrayLike, accel: ArrayLike, t: float) -> list[FrameReport]:
        """Take an inertial sample, and return reports on the images that could be processed then.

        Args:
            gyro, accel: (3,) angular rates, rad/s, and specific forces, m/s^2, in the IMU frame.
            t: Stamp in s.

        Errors are those of `predict`.
        """
        if not self.is_inertial:
            raise ConfigError("this filter takes velocities: call predict(velocities, t)")
        rows = checked_inputs(gyro, 3, "gyro"), checked_inputs(accel, 3, "accel")
        return self._take_inputs("sample", np.concatenate(rows), checked_stamp(t))

    def update(self, ids: ArrayLike, pixels: ArrayLike, t: float) -> list[FrameReport]:
        """Take the tracks of an image, and return reports on the images that could be processed then.

        Args:
            ids: (n,) landmark ids, distinct.
            pixels: (n, 4) rectified pixels (uL, vL, uR, vR), or the measurements of another sensor.
            t: Stamp in s.

        Errors are those of `predict`.
        """
        landmark, measured = ascending(*checked_observations(self.ekf.sensor, ids, pixels))
        t = checked_stamp(t)
        with self.lock:
            self._watch_clock("image", t)
            at = bisect_left(self._waiting, t, key=lambda image: image[0])
            is_repeated = any(image[0] == t for image in self._waiting[at : at + 1])
            is_full = len(self._waiting) >= MOST_IMAGES
            if not self._admission.accepts("image", t, self.time_s, is_repeated, is_full):
                return []
            self._waiting.insert(at, (t, landmark, measured))
            return self._take_in(self.newest_s - self.delay_s)

    def _take_inputs(self, kind: Kind, row: Array, t: float) -> list[FrameReport]:
        with self.lock:
            self._watch_clock(kind, t)
            inputs, most = self._inputs, self.backlog
            if self.time_s is None and not self._waiting and len(inputs.stamps) >= most:
                self.counts.unused += most // 2 + 1
                inputs.drop(most // 2 + 1)
            is_full = len(inputs.stamps) >= most
            if not self._admission.accepts(kind, t, self._driven.used_s, inputs.has(t), is_full):
                return []
            inputs.add(row, t)
            self._driven.history.arrived(t)
            return self._take_in(self.newest_s - self.delay_s)

    def _watch_clock(self, kind: Kind, t: float) -> None:
        """Start again if a clock jumped before the first image; raise `ClockError` if it did later."""
        if self._admission.has_jumped(kind, t, self.time_s):
            if self.time_s is not None:
                self.counts.jumps += 1
                self.dropped.append(Dropped(kind, t, "jump"))
                raise ClockError(f"a clock has jumped to {t:.6f} s from {self.newest_s:.6f} s: call reset()", field="t")
            self.reset()

    def flush(self) -> list[FrameReport]:
        """Process all images that wait, since nothing more will come, and return reports on them."""
        with self.lock:
            if self._waiting and not self._inputs.stamps:
                raise MissingVelocityError(self._waiting[0][0])
            return self._take_in(np.inf, is_last=True)

    def reset(self) -> None:
        """Start again with a filter as new as the first one; messages that wait are dropped. Counts go on."""
        with self.lock:
            self.dropped.extend(Dropped("image", t, "reset") for t, *_ in self._waiting)
            self.counts.unused += len(self._waiting)
            self.counts.resets += 1
            self._start(copied(self._new))

    def pose(self, t: float | None = None) -> Pose:
        """Return the pose at a stamp, by default the newest one, given the images processed until then.

        Raises:
            LateError: The stamp is over ``history_s`` before the last processed image, or there is none.
            ClockError: The stamp is more than ``jump_s`` after the newest one.
            MissingVelocityError: No velocity or sample has come.
        """
        with self.lock:
            t, then, is_held = self._at(t)
            return Pose(t, then.T_world_imu, then.gaussian.body_covariance[:6, :6].copy(), is_held)

    def block(self, name: str, t: float | None = None) -> tuple[Array, Array]:
        """Return value and covariance of a state block at a stamp, such as ``velocity``, see `pose`."""
        with self.lock:
            layout = self.ekf.model.layout
            if not isinstance(name, str) or name not in layout:
                raise ConfigError(f"no state block {name!r}; known: {', '.join(layout)}")
            _, then, _ = self._at(t)
            at = layout[name]
            return np.array(then.values[name]), then.gaussian.body_covariance[at, at].copy()

    def _at(self, t: float | None) -> tuple[float, Estimate, bool]:
        """Return a stamp, the estimate without landmarks there, and whether its inputs were extrapolated."""
        t = self.newest_s if t is None else checked_stamp(t)
        if t > self.newest_s + self.jump_s:
            raise ClockError(f"{t:.6f} s is {t - self.newest_s:.3g} s after the newest message", field="t")
        return t, *self._driven.history.at(t)

    def _take_in(self, until: float, is_last: bool = False) -> list[FrameReport]:
        """Process the images up to a stamp, in their order; none before its inputs."""
        while self._waiting and (t := self._waiting[0][0]) <= until and (is_last or self._inputs.serves(t, until)):
            image = self._waiting.pop(0)
            if self.time_s is None and self._inputs.begin_after(t):
                self.counts.unused += 1
                self.dropped.append(Dropped("image", t, "before the first sample"))
                continue
            try:
                self._reports.append(self._driven.process(*image))
            except Exception:
                self.counts.failed += 1
                self.dropped.append(Dropped("image", t, "failed"))
                raise
        reports, self._reports = self._reports, []
        return reports


def _inertial(
    rig: Rig, imu: InertialNoise, T_world_imu: Array, settings: FilterConfig, rest: InertialSamples | None
) -> Model:
    """Return the model of a rig with an inertial unit, which starts from a pose or from a rest."""
    blocks, process = blocks_and_process({}, imu)
    P, coordinates = settings.initial_covariance, settings.landmark_coordinates
    model = model_of(rig, rig.noise, se3.inverse(T_world_imu), P, None, blocks, coordinates, False, process)
    if rest is None:
        return model
    prior = FirstPrior.of(T_world_imu, model, GRAVITY_M_S2)
    return at_rest(rest, float(rest.time_s[0]), float(rest.time_s[-1]), prior, imu).begun(model)
