"""Cameras of all frames at a state, and how their errors follow from the unknowns: the only way to landmarks.

The error z of a camera, ``W_true = exp(z^) W``, is linear in those of the unknowns (`ekfslam.models.observer.Camera`).
A difference of observations, eq. (10), may see the present frame through another camera than a single observation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.models.blocks import StateBlock
from ekfslam.models.observer import Moment, Observer
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.unknowns import Unknowns


@dataclass(frozen=True)
class Views:
    """Cameras of T frames, h of each: that of single observations and, if it differs, that of differences."""

    observer: Observer  # sensor with the blocks that observations depend on
    sensor: Sensor  # sensor with its calibration
    T_view_world: Array  # (T h, 4, 4) cameras
    by_frame: Array  # (T, 6 h, w) derivative of their errors by the unknowns of their frame
    by_drive: Array  # (T h, 6, g) derivative by the unknowns of the drive
    drive_place: IntArray  # (c,) places of the calibration's columns among those of the drive
    # (s,) columns of a frame by which its views are regular: the pose and, if there are two views, a block of which
    # they have different shares. All, if there is none.
    seen: IntArray

    @staticmethod
    def of(observer: Observer, unknowns: Unknowns, moment: Moment) -> Views:
        """Return the views at the moments of all frames."""
        kinds, shape = views_of_frame(observer), moment.T_imu_world.shape[:-2]
        found = observer.cameras(moment)
        T = (found.T_cam_imu[:kinds] @ moment.T_imu_world).swapaxes(0, 1)
        by, free = found.by[:kinds].swapaxes(0, 1), unknowns.drive_columns < found.by.shape[-1]
        by_frame = by[..., unknowns.frame_columns].reshape(*shape, 6 * kinds, unknowns.width)
        by_drive = np.zeros((*by.shape[:-1], len(free)))
        by_drive[..., free] = by[..., unknowns.drive_columns[free]]
        seen = np.arange(6 if kinds == 1 else unknowns.width)
        if kinds == 2:
            apart = [_apart(block, moment) for block in observer.moves_camera]
            if max(apart) > 0:
                own = _columns(unknowns)[observer.moves_camera[int(np.argmax(apart))].name]
                seen = np.concatenate([np.arange(6), np.arange(own.start, own.stop)])
        sensor, place = observer.sensor_at(moment.calibration), _drive_place(observer, unknowns)
        by_drive = by_drive.reshape(np.prod(by.shape[:2]), 6, len(free))
        return Views(observer, sensor, T.reshape(-1, 4, 4), by_frame, by_drive, place, seen)

    @property
    def rig(self) -> Rig:
        """The sensor, which must be a stereo rig."""
        assert isinstance(self.sensor, Rig)
        return self.sensor

    def points(self, view: IntArray, positions_m: Array) -> Array:
        """Return landmarks (n, 3) in the cameras of views (n,)."""
        T = self.T_view_world[view]
        return np.einsum("nij,nj->ni", T[:, :3, :3], positions_m) + T[:, :3, 3]


@dataclass(frozen=True)
class Observed:
    """Observations of one kind: single ones, or differences."""

    which: IntArray  # (n,) their numbers in the log
    views: tuple[IntArray, ...]  # the view (n,) of each; then, of differences, the view (n,) before
    landmark: IntArray  # (n,) rows of the landmarks in the log
    rows: Array  # rows, scale: (n, d) rows or their differences, and reciprocals of their standard deviations
    scale: Array

    def only(self, some: BoolArray) -> Observed:
        """Return some (n,) of the observations."""
        views = tuple(view[some] for view in self.views)
        return Observed(self.which[some], views, self.landmark[some], self.rows[some], self.scale[some])


class Sight:
    """Kinds of observations at cameras and landmarks (M, 3) of a state, and their whitened ``residuals`` (n, d)."""

    def __init__(self, views: Views, batches: Sequence[Observed], positions_m: Array) -> None:
        self.views, self.batches, self.residuals = views, batches, []
        self._q = [[views.points(view, positions_m[o.landmark]) for view in o.views] for o in batches]
        with np.errstate(all="ignore"):
            for o, q in zip(batches, self._q, strict=True):
                z = [views.sensor.predict(points) for points in q]
                self.residuals.append(o.scale * (o.rows - z[0] + sum(z[1:], 0.0)))

    def norms_of(self, kind: int) -> Array:
        """Return the norms (n,) of the whitened residuals of a kind."""
        return np.sqrt(np.einsum("ij,ij->i", self.residuals[kind], self.residuals[kind]))

    def can_see(self, kind: int, min_depth_m: float) -> BoolArray:
        """Return whether the camera of each observation (n,) of a kind can see its landmark."""
        return self.views.sensor.in_view(self._q[kind][0], min_depth_m)

    def norms(self) -> Array:
        """Return the norms (K,) of the whitened residuals of all observations."""
        return self._all(self.norms_of)

    def in_view(self, min_depth_m: float) -> BoolArray:
        """Return whether the camera of each observation (K,) can see its landmark."""
        return self._all(lambda kind: self.can_see(kind, min_depth_m))

    def _all(self, of_kind: Callable[[int], NDArray]) -> NDArray:
        """Return values of all observations (K,), given a function that returns those of a kind."""
        parts = [of_kind(kind) for kind in range(len(self.batches))]
        return np.concatenate(parts)[np.argsort(np.concatenate([o.which for o in self.batches]))]

    @cached_property
    def _by_points(self) -> list[list[Array]]:
        """Derivatives (n, d, 3) of the whitened rows by the points in each view."""
        jacobian, signs = self.views.sensor.jacobian, (1.0, -1.0)
        return [
            [sign * o.scale[..., None] * jacobian(points) for points, sign in zip(q, signs, strict=False)]
            for o, q in zip(self.batches, self._q, strict=True)
        ]

    @cached_property
    def by_landmark(self) -> list[Array]:
        """Derivatives (n, d, 3) of the whitened rows of each kind by landmarks."""
        R = self.views.T_view_world[:, :3, :3]
        return [
            sum((A @ R[view] for A, view in zip(by_points, o.views, strict=True)), np.zeros(()))
            for o, by_points in zip(self.batches, self._by_points, strict=True)
        ]

    def by_views(self, kind: int) -> list[Array]:
        """Return the derivatives (n, d, 6) of the whitened rows of a kind by the errors of each view."""
        found = []
        for A, q in zip(self._by_points[kind], self._q[kind], strict=True):
            x, y, z = q[:, None, 0], q[:, None, 1], q[:, None, 2]
            J = np.empty((*A.shape[:2], 6))
            J[..., :3] = A
            J[..., 3] = y * A[..., 2] - z * A[..., 1]
            J[..., 4] = z * A[..., 0] - x * A[..., 2]
            J[..., 5] = x * A[..., 1] - y * A[..., 0]
            found.append(J)
        return found

    def by_drive(self, kind: int, by_views: Sequence[Array]) -> Array:
        """Return the derivatives (n, d, g) of the whitened rows of a kind by the unknowns of the drive."""
        o, views, calibration = self.batches[kind], self.views, self.views.observer.calibration
        J = sum((of @ views.by_drive[view] for of, view in zip(by_views, o.views, strict=True)), np.zeros(()))
        if calibration is not None and len(calibration.intrinsic):
            own = views.drive_place[calibration.intrinsic]
            for q, sign in zip(self._q[kind], (1.0, -1.0), strict=False):
                J[..., own] += sign * o.scale[..., None] * calibration.rows_by_intrinsic(views.rig, q)
        return J

    def only(self, landmarks: BoolArray, positions_m: Array) -> Sight:
        """Return the observations of some landmarks (M,) at other positions (M, 3)."""
        return Sight(self.views, [o.only(landmarks[o.landmark]) for o in self.batches], positions_m)

    def take(self, landmarks: BoolArray, part: Sight) -> None:
        """Take everything about some landmarks (M,) from a part, made by `only`."""
        for kind, o in enumerate(self.batches):
            at = landmarks[o.landmark]
            mine, others = (
                [sight.residuals[kind], sight.by_landmark[kind], *sight._q[kind], *sight._by_points[kind]]
                for sight in (self, part)
            )
            for own, new in zip(mine, others, strict=True):
                own[at] = new


def views_of_frame(observer: Observer) -> int:
    """Return the number h of views of a frame."""
    return 2 if observer.has_drift else 1


def _columns(unknowns: Unknowns) -> dict[str, slice]:
    """Return the columns of each shared block among those of a frame."""
    ends = 6 + np.cumsum([block.size for block in unknowns.shared]).astype(int)
    return {b.name: slice(end - b.size, end) for b, end in zip(unknowns.shared, ends.tolist(), strict=True)}


def _apart(block: StateBlock, moment: Moment) -> float:
    """Return the least difference between the shares of a block in the two views of a frame."""
    shape = np.shape(moment.way_m)
    one, other = (block.camera_share(moment.way_m, np.full(shape, kind)) for kind in (False, True))
    return 0.0 if one is None or other is None else float(np.abs(other - one).min())


def _drive_place(observer: Observer, unknowns: Unknowns) -> IntArray:
    """Return the places of the calibration's columns among those of the drive."""
    if observer.calibration is None:
        return np.empty(0, dtype=np.int64)
    at = observer.layout[observer.calibration.name]
    return np.searchsorted(unknowns.drive_columns, np.arange(at.start, at.stop))
