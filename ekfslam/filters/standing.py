"""Zero velocity by the images: a rig stands if its tracks rest, but for turns that the gyroscope explains.

The accelerometer cannot tell: motors shake it at rest. Tracks are compared with the frame before, and with the first
view of the rest so far, turned as the gyroscope says. If the bias of the gyroscope is not known yet to a fraction of a
pixel, they are compared as they are, and a turn that it surely saw contradicts the rest. A robust similarity (shift,
turn about the optical axis, expansion) is fitted to their motion, so that driving ahead shows, traffic does not, and
noise averages. The row is ``u = 0`` in this frame, and the next prediction takes it. Its standard deviation is
`STD_M_S` and the largest speed that the images of this rest could have hidden: that grows with the depth of the scene
and falls with the duration of the rest. Rows that the gyroscope or the state contradicts are left out and counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.observing import present
from ekfslam.filters.prediction import squared
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.blocks import GyroBias, Velocity
from ekfslam.models.process import Measured
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

STD_M_S = 0.02  # what shakes at rest
STILL_PX = 0.5  # motion of the tracks below which they rest
_LEAST_S, _LONGEST_S = 0.3, 1.0  # of a rest before it gives rows, and over which motion is measured
_LEAST_TRACKS = 8
_DEPTH_M = 20.0  # of a scene without any landmark yet
_ROUNDS, _SURE = 5, 3.0  # of the robust fit; standard deviations of the gyroscope's bias


@dataclass(frozen=True)
class Standing:
    """Finding in a frame whose tracks rest."""

    measured: Measured | None  # the rows u = 0; None if something contradicts the rest


@dataclass(frozen=True)
class _View:
    """Tracks of a frame: ids (n,) ascending, pixels (n, 2), and the turn of the camera (3, 3) since the first frame."""

    time_s: float
    ids: IntArray
    pixels: Array
    R: Array


class Stillness:
    """Judge of the frames of one filter; the views of the present rest."""

    def __init__(self) -> None:
        self._views: list[_View] = []
        self._since_s = self._time_s = 0.0
        self._R = np.eye(3)

    def judge(self, e: Estimate, ids: IntArray, measured: Array) -> Standing | None:
        """Return the finding in a frame with tracks (n,), after the update by them; None: the rig moves, or may."""
        sensor = e.sensor
        if Velocity.name not in e.model.layout or not isinstance(sensor, Rig | Monocular):
            return None
        turned, C = _turned(e), sensor.T_cam_imu[:3, :3]
        self._time_s, self._R = self._time_s + e.motion.tau_s, C @ se3.so3_exp(-turned) @ C.T @ self._R
        rows, order = sensor.rows(measured), np.argsort(ids)
        now = _View(self._time_s, ids[order], rows[order, :2], self._R)
        if not self._views or not all(_rests(e, sensor, view, now) for view in (self._views[-1], self._views[0])):
            self._views, self._since_s = [now], now.time_s
            return None
        self._views = [view for view in (*self._views, now) if view.time_s > now.time_s - _LONGEST_S]
        duration_s = now.time_s - self._views[0].time_s
        if now.time_s - self._since_s < _LEAST_S:
            return None
        if sensor.camera.fu_px * (np.linalg.norm(turned) - _unsure(e, e.motion.tau_s)) > STILL_PX:
            return Standing(None)
        hidden = STILL_PX * _depth_m(e, ids) / (sensor.camera.fu_px * duration_s)
        # What one rest hides, all its rows hide: together they say no more than one.
        std = np.hypot(STD_M_S, np.sqrt(len(self._views) - 1) * hidden)
        none = Measured(np.arange(3), np.zeros(3), np.full(3, std), np.zeros(3, dtype=bool))
        return Standing(None if squared(e, none) > gates.of_inputs(3) else none)


def moved_px(before: Array, now: Array) -> float:
    """Return the root mean square motion of most tracks (n, 2), as a robust similarity has it, less that of noise."""
    d, x = now - before, before - before.mean(axis=0)
    A = np.zeros((len(x), 2, 4))
    A[:, 0, 0] = A[:, 1, 1] = 1.0
    A[:, 0, 2], A[:, 0, 3], A[:, 1, 2], A[:, 1, 3] = x[:, 0], -x[:, 1], x[:, 1], x[:, 0]
    p = np.array([*np.median(d, axis=0), 0.0, 0.0])
    for _ in range(_ROUNDS):
        square = ((d - A @ p) ** 2).sum(axis=1)
        w = 1.0 / (1.0 + square / max(float(np.median(square)), 1e-4))
        p = np.linalg.solve(np.einsum("n,nij,nik->jk", w, A, A) + 1e-9 * np.eye(4), np.einsum("n,nij,ni->j", w, A, d))
    variance = float(np.median(((d - A @ p) ** 2).sum(axis=1))) / np.log(4.0)  # of one coordinate
    flow = ((A @ p) ** 2).sum(axis=1).mean()
    return float(np.sqrt(max(flow - 4.0 * variance / len(x), 0.0)))


def _rests(e: Estimate, sensor: Rig | Monocular, before: _View, now: _View) -> bool:
    """Return whether common tracks of two views do not move, or only by the turn of the gyroscope."""
    _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    if len(i) < _LEAST_TRACKS:
        return False
    a, b, camera = before.pixels[i], now.pixels[j], sensor.camera
    if camera.fu_px * _unsure(e, now.time_s - before.time_s) < STILL_PX:
        a = _seen_turned(camera, a, now.R @ before.R.T)
    # The median length of a difference of two pixels with noise alone is sqrt(2 log 4) deviations.
    most = STILL_PX + np.sqrt(2.0 * np.log(4.0)) * float(np.max(sensor.noise.pixel_std_px[:2]))
    return bool(np.median(np.linalg.norm(b - a, axis=1)) < most) and moved_px(a, b) < STILL_PX


def _seen_turned(camera: StereoCamera, pixels: Array, R: Array) -> Array:
    """Return pixels (n, 2) of one camera after it has turned by R (3, 3)."""
    focal, centre = np.array([camera.fu_px, camera.fv_px]), np.array([camera.cu_px, camera.cv_px])
    rays = np.hstack([(pixels - centre) / focal, np.ones((len(pixels), 1))]) @ R.T
    return np.asarray(rays[:, :2] / rays[:, 2:] * focal + centre)


def _turned(e: Estimate) -> Array:
    """Return the turn (3,) since the frame before as the gyroscope has it."""
    interval = e.motion.interval
    return np.asarray(interval.dt_s @ (interval.inputs[:, :3] - e.values[GyroBias.name]))


def _unsure(e: Estimate, tau_s: float) -> float:
    """Return by how much a turn of the gyroscope may be wrong after some time, rad."""
    at = e.model.layout[GyroBias.name]
    return float(_SURE * tau_s * np.sqrt(np.linalg.eigvalsh(e.gaussian.body_covariance[at, at])[-1]))


def _depth_m(e: Estimate, ids: IntArray) -> float:
    """Return the median depth of the landmarks in view."""
    slot, is_known = e.table.lookup(ids)
    if not is_known.any():
        return _DEPTH_M
    q = se3.apply(present(e).T_cam_world, e.table.position_m[slot[is_known]])
    return max(float(np.median(q[:, 2])), 0.0)
