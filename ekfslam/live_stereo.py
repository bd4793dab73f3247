"""Live use from images: pairs of images and velocities or inertial samples in, poses with covariance out.

See docs/live.md. The front end tracks each pair as it comes. The first frames are only collected: from them and their
inputs, `ekfslam.resolve` finds noise, model and start, as for a recording. They are then processed at once, and later
ones as they come, by `ekfslam.LiveEKF`.

Without threads, `LiveStereo.images` returns when its frame is processed. Within the context manager, one thread tracks
and another one filters, so that calls return at once. A pair that arrives while too many others wait displaces the
oldest of them.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, Queue
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.config import Config, FrontEndConfig
from ekfslam.data import inputs
from ekfslam.data.checks import checked_pose, require_shape
from ekfslam.data.images import Image, ImageRecording, PairCalibration
from ekfslam.data.inputs import InertialNoise, InertialSamples, VelocityFrame
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ClockError, ConfigError, DataError, LateError, NoVelocitiesError
from ekfslam.filters.admission import Admission, Kind, LiveCounts
from ekfslam.filters.door import checked_inputs, checked_numbers, checked_stamp
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.live import LiveEKF, Pose, require_window
from ekfslam.filters.streams import Velocities
from ekfslam.frontend.track import Tracking
from ekfslam.geometry import se3
from ekfslam.resolve import Problem, resolve

MOST_TRACKED = 600  # frames that wait for the filter: half a minute at 20 Hz
MOST_INPUTS = 100_000  # that wait for the first frames
# Memory stays bounded: landmarks leave, none comes back from the log, no frame is linearised again.
_BOUNDED = {"retire": "unseen", "retire_after": 10, "dormant": 0, "revive": -1, "lag": 0}


class Learner:
    """The filter behind the tracker, which the first frames configure; ``live`` and ``problem`` are None until then."""

    def __init__(self, config: Config, window: dict[str, Any]) -> None:
        self.live: LiveEKF | None = None
        self.problem: Problem | None = None
        self.kind: Kind | None = None
        self._config, self._window, self._lock = config, window, threading.Lock()
        self._inputs: deque[tuple[float, Array]] = deque(maxlen=MOST_INPUTS)

    def require(self, kind: Kind) -> None:
        """Raise a `ConfigError` for inputs of another kind than the first ones."""
        if self.kind not in (None, kind):
            raise ConfigError(f"this filter has a {self.kind} for an input: it cannot take a {kind}")
        self.kind = kind

    def take(self, row: Array, t: float) -> None:
        """Take inputs (6,)."""
        with self._lock:
            if self.live is None:
                self._inputs.append((t, row))
                return
        self._feed(self.live, t, row)

    def recorded(self, time_s: Array, noise: InertialNoise | None) -> tuple[Array | None, InertialSamples | None]:
        """Return velocities (T, 6) at the stamps of the first frames, or the samples so far, if there are any."""
        with self._lock:
            found = dict(sorted(self._inputs))
        if not found:
            return None, None
        stamps, rows = np.array(list(found)), np.array(list(found.values()))
        if self.kind == "velocity":
            return inputs.Velocities(stamps, rows).mean(time_s), None
        return None, InertialSamples(stamps, rows[:, :3], rows[:, 3:], noise)

    def learn(self, sequence: Sequence) -> None:
        """Resolve the first frames, process them, and go live."""
        problem = self.problem = resolve(sequence, self._config)
        live, known = LiveEKF(JointEKF(problem.model, problem.config.filter), **self._window), problem.sequence
        if self.kind == "velocity" and (sequence.measured_axes != known.measured_axes).any():
            raise NoVelocitiesError("only a part of the velocities is measured: give all of them, or none")
        frames = iter(range(len(known)))
        k = next(frames, None)
        while True:
            with self._lock:
                waiting = sorted(self._inputs)
                self._inputs.clear()
                if not waiting and k is None:
                    self.live = live
                    return
            for t, row in waiting or [(np.inf, np.empty(0))]:
                while k is not None and known.time_s[k] < t:
                    self._update(live, float(known.time_s[k]), *known.observations.at(k), known.twist[k])
                    k = next(frames, None)
                if len(row):
                    self._feed(live, t, row)

    def filter(self, t: float, ids: IntArray, pixels: Array, twist: Array) -> None:
        """Process the tracks of a later frame, with the mean velocity (6,) of the IMU before it by vision alone."""
        live, problem = self.live, self.problem
        assert live is not None and problem is not None
        # Rules of `ekfslam.data.hygiene` that need one frame alone.
        std, rules = problem.model.noise.pixel_std_px, problem.config.hygiene
        least = 1.0 if rules.min_disparity_sigma is None else rules.min_disparity_sigma
        good = (pixels[:, 0] - pixels[:, 2] > least * np.hypot(std[0], std[2])) | (least <= 0)
        if rules.max_row_mismatch_sigma:
            good &= np.abs(pixels[:, 1] - pixels[:, 3]) <= rules.max_row_mismatch_sigma * np.hypot(std[1], std[3])
        self._update(live, t, ids[good], pixels[good], twist)

    def _update(self, live: LiveEKF, t: float, ids: IntArray, pixels: Array, twist: Array) -> None:
        if not (live.is_inertial or self._uses_velocities):
            live.predict(twist, t)
        live.update(ids, pixels, t)

    def _feed(self, live: LiveEKF, t: float, row: Array) -> None:
        if live.is_inertial:
            live.imu(row[:3], row[3:], t)
        elif self._uses_velocities:
            live.predict(row, t)

    @property
    def _uses_velocities(self) -> bool:
        return self.kind == "velocity" and self.problem is not None and self.problem.sequence.has_velocities


class Line:
    """Two threads behind each other: one tracks pairs of images, one does jobs of the filter.

    At most ``most_pairs`` wait. ``errors`` are those of the threads that nobody has seen yet, ``skipped`` counts pairs
    that were displaced, or whose tracks the filter could not take.
    """

    def __init__(self, track: Callable[..., None], most_pairs: int) -> None:
        self._track, self._most_pairs, self.skipped = track, most_pairs, 0
        self.errors: deque[Exception] = deque(maxlen=100)
        self._lock = threading.RLock()  # of the threads' begin and end: nothing is queued behind their end
        self._pairs: Queue[tuple[Any, ...] | None] = Queue()
        self._jobs: Queue[Callable[[], None] | None] = Queue()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start both threads."""
        targets: list[tuple[Queue[Any], Callable[[Any], None]]]
        targets = [(self._pairs, lambda pair: self._track(*pair)), (self._jobs, lambda job: job())]
        with self._lock:
            if self._threads:
                raise ConfigError("the threads run already: enter the context once")
            self._threads = [threading.Thread(target=self._work, args=target, daemon=True) for target in targets]
            for thread in self._threads:
                thread.start()

    def stop(self) -> None:
        """Process everything that waits, and end both threads."""
        queues: tuple[Queue[Any], ...] = self._pairs, self._jobs
        with self._lock:
            for queue, thread in zip(queues, self._threads, strict=False):
                queue.put(None)
                thread.join()
            self._threads = []

    def wait(self) -> None:
        """Wait until nothing waits."""
        self._pairs.join()
        self._jobs.join()

    def _work(self, queue: Queue[Any], do: Callable[[Any], None]) -> None:
        while (work := queue.get()) is not None:
            try:
                do(work)
            except Exception as error:
                self.errors.append(error)
            finally:
                queue.task_done()
        queue.task_done()

    def offer(self, *pair: Any) -> None:
        """Track a pair, at once or in its thread; there it displaces the oldest one if too many wait."""
        with self._lock:
            while self._threads and self._pairs.qsize() >= self._most_pairs:
                with suppress(Empty):
                    self._pairs.get_nowait()
                    self._pairs.task_done()
                    self.skipped += 1
            if self._threads:
                self._pairs.put(pair)
                return
        self._track(*pair)

    def do(self, job: Callable[[], None]) -> None:
        """Do a job of the filter, at once or in its thread."""
        if not self._threads:
            job()
        elif self._jobs.qsize() >= MOST_TRACKED:
            self.skipped += 1
        else:
            self._jobs.put(job)


class LiveStereo:
    """Live filter of a stereo camera, see the module. Threads may share it.

    Args:
        calibration: The pair, rectified or not.
        T_cam_imu: (4, 4) IMU, or body of the velocities, to the optical frame of the left camera.
        config: Settings; automatic ones are resolved by the first frames. Noise can be given here.
        imu_noise: Densities of the inertial unit.
        velocity_frame: Frame of the velocities.
        front_end: Settings of tracking.
        learn: Number of first frames by which automatic settings are resolved.
        queue: Number of pairs that may wait for the tracker.
        delay_s, window: Further arguments of `LiveEKF`. Messages that cannot be used are counted.

    Raises:
        ConfigError: A number is too small.

    Attributes:
        counts: `LiveCounts` of the messages that came in; those of `live` are the filter's.
    """

    def __init__(
        self,
        calibration: PairCalibration,
        T_cam_imu: Array,
        config: Config | None = None,
        *,
        imu_noise: InertialNoise | None = None,
        velocity_frame: VelocityFrame = "imu",
        front_end: FrontEndConfig | None = None,
        learn: int = 40,
        queue: int = 2,
        delay_s: float = 0.1,
        **window: Any,
    ) -> None:
        if learn < 2 or queue < 1:
            raise ConfigError("learn must be at least 2, and queue at least 1")
        self._calibration, self._T_left_imu, self._front_end = calibration, T_cam_imu, front_end
        self._config = (config or Config()).with_overrides({"filter": _BOUNDED})
        self._imu_noise, self._velocity_frame, self._learn = imu_noise, velocity_frame, learn
        self._window = {**window, "delay_s": delay_s, "late": "count"}
        require_window(**self._window)
        checked_pose(checked_numbers(T_cam_imu, "T_cam_imu"), "T_cam_imu")
        # Locks of messages, of the tracker, and of images, whose order stays that of their admission.
        self._lock, self._frame_lock, self._image_lock = threading.RLock(), threading.RLock(), threading.RLock()
        self._admission = Admission("count", self._window.get("jump_s", 10.0))
        self.counts: LiveCounts = self._admission.counts
        self._line = Line(self._track, queue)
        self._start()

    def _start(self) -> None:
        """Begin without frames and inputs."""
        self._tracking = Tracking(self._calibration, self._T_left_imu, self._front_end)
        self._learner = Learner(self._config, self._window)
        self._driving = Velocities(np.inf)  # for the tracker
        self._first: list[float] | None = []  # stamps of the first frames; None once they are handed over
        self._newest: float | None = None  # image that came in, and image that was tracked
        self._tracked: float | None = None
        self._admission.start()

    @property
    def skipped(self) -> int:
        """Number of pairs that were dropped because tracker or filter could not keep up."""
        return self._line.skipped

    @property
    def live(self) -> LiveEKF | None:
        """The filter; None until it has the first frames."""
        return self._learner.live

    @property
    def problem(self) -> Problem | None:
        """Resolved model and settings; None until the first frames are there."""
        return self._learner.problem

    def velocities(self, velocities: ArrayLike, t: float) -> None:
        """Take a measured velocity (6,) ``[v; w]``, m/s and rad/s, which holds since the stamp of the one before."""
        self._take("velocity", checked_inputs(velocities, 6, "velocities"), checked_stamp(t))

    def imu(self, gyro: ArrayLike, accel: ArrayLike, t: float) -> None:
        """Take an inertial sample: (3,) angular rates, rad/s, and (3,) specific forces, m/s^2, in the IMU frame."""
        rows = checked_inputs(gyro, 3, "gyro"), checked_inputs(accel, 3, "accel")
        self._take("sample", np.concatenate(rows), checked_stamp(t))

    def _take(self, kind: Kind, row: Array, t: float) -> None:
        with self._lock:
            learner = self._learner
            learner.require(kind)
            if not self._admits(kind, t, None, self._driving.has(t)):
                return
            self._driving.add(row, t)
            self._driving.drop(len(self._driving.stamps) - MOST_INPUTS)
        learner.take(row, t)

    def _admits(self, kind: Kind, t: float, last: float | None, is_repeated: bool = False) -> bool:
        if self._admission.has_jumped(kind, t, last):
            newest = self._admission.newest_s
            raise ClockError(f"a clock has jumped to {t:.6f} s from {newest:.6f} s: call reset()", field="t")
        return self._admission.accepts(kind, t, last, is_repeated, is_full=False)

    def images(self, left: Image, right: Image, t: float) -> None:
        """Take a pair of grey images (height, width) uint8.

        Raises:
            DataError: An image has another shape or type.
            ClockError: A clock has jumped: call `reset`.
            EkfslamError: An earlier frame could not be processed by a thread.
        """
        t, pair = checked_stamp(t), (self._checked(left, "left"), self._checked(right, "right"))
        with self._image_lock:
            with self._lock:
                self._raise_errors()
                if not self._admits("image", t, self._newest):
                    return
                self._newest, learner = t, self._learner
            self._line.offer(*pair, t, learner)

    def _checked(self, image: Image, name: str) -> Image:
        """Return a copy of an image, since drivers use their memory again."""
        width, height = self._calibration.size
        if (dtype := getattr(image, "dtype", type(image).__name__)) != np.uint8:
            raise DataError(f"expected grey levels uint8, found {dtype}", field=name)
        require_shape(image, (height, width), name)
        return np.array(image)

    def _raise_errors(self) -> None:
        if self._line.errors:
            raise self._line.errors.popleft()

    def _track(self, left: Image, right: Image, t: float, learner: Learner) -> None:
        """Track a pair, and hand its tracks, or those of the first frames together, to the filter."""
        with self._frame_lock:
            if learner is not self._learner:  # it waited during a reset
                self.counts.unused += 1
                return
            before, self._tracked = self._tracked, t
            seen = self._tracking.add(left, right, None if before is None else self._moved(before, t))
            if self._first is not None:
                self._first.append(t)
                if len(self._first) >= self._learn:
                    self._hand_over()
                return
            twist = np.zeros(6)
            if seen.T_now_before is not None and before is not None:
                T = self._tracking.T_cam_imu
                twist = -se3.log(se3.inverse(T) @ seen.T_now_before @ T) / (t - before)
            ids, pixels = self._tracking.last()
            self._tracking.forget()
            self._line.do(lambda: learner.filter(t, ids, pixels, twist))

    def _moved(self, begin: float, end: float) -> Array | None:
        """Return the motion (4, 4) of the IMU between two frames by measured velocities; None: there are none."""
        with self._lock:
            self._driving.forget(begin)
            if self._learner.kind != "velocity" or self._velocity_frame != "imu":
                return None
            twist = self._driving.joined(begin, end)[0].inputs[0]
        return se3.exp(-(end - begin) * twist)

    def _hand_over(self) -> None:
        """Give the first frames to the filter; collect others instead while all velocities are 0."""
        learner, time_s = self._learner, np.array(self._first)
        twist, samples = learner.recorded(time_s, self._imu_noise)
        if twist is not None and not twist.any():
            self._first = list(time_s[-1:])
            self._tracking.forget()
            return
        pair, T, frame = self._calibration, self._T_left_imu, self._velocity_frame
        recording = ImageRecording("live", "live", time_s, pair, _not_kept, T, twist, frame, inertial=samples)
        sequence, _ = self._tracking.sequence(recording)
        self._tracking.forget()
        self._first = None
        self._line.do(lambda: learner.learn(sequence))

    def pose(self, t: float | None = None) -> Pose:
        """Return the pose at a stamp, by default the newest one, see `LiveEKF.pose`; `LateError` before the first."""
        if (live := self.live) is None:
            raise LateError("pose", self._admission.newest_s if t is None else checked_stamp(t), None)
        return live.pose(t)

    def flush(self) -> None:
        """Process everything that waits, since nothing more will come."""
        self._line.wait()
        with self._frame_lock:
            if self._first is not None and len(self._first) > 1:
                self._hand_over()
        self._line.wait()
        if self.live is not None:
            self.live.flush()
        self._raise_errors()

    def reset(self) -> None:
        """Start again; counts go on."""
        self._line.wait()
        with self._frame_lock, self._lock:
            self.counts.resets += 1
            self._start()

    def __enter__(self) -> Self:
        """Track and filter in threads."""
        self._line.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._line.stop()


def _not_kept(frame: int) -> tuple[Image, Image]:
    raise DataError(f"the images of frame {frame} were not kept", source="live")
