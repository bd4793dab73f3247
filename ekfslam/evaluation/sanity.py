"""Sanity of a recording and of a run: likely mistakes are named, one line each.

The evidence is the flow of the tracks. A point that stereo has located moves in the next image as velocities, stamps
and ``T_cam_imu`` predict. Each known mistake is undone in turn, and named if the prediction error falls much, and below
that of standing still. Unless velocities predict the flow better than standing still, nothing else is suspected.
Noise of velocities is no mistake.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.images import baseline_doubt
from ekfslam.data.sequence import Sequence
from ekfslam.data.tracks import MOVING_M_S, successive
from ekfslam.evaluation.trajectory import absolute_trajectory_error, distance_along
from ekfslam.filters.result import REASONS, SANITY, SANITY_SEPARATOR, Result
from ekfslam.geometry import camera as cam
from ekfslam.geometry import motion, se3
from ekfslam.models.odometry import missing_velocities, stereo_odometry
from ekfslam.models.sensors.base import WAITING

_PAIRS = 5000  # observations that are examined; more say the same
_LEAST_PAIRS = 60
_SHARE_TURNING = 0.2  # of the frames, in which rotations are examined
_BETTER = 0.7  # of the error, which a remedy must leave at most; a right recording leaves less than any remedy
_EXPLAINS = 0.85  # of the error of standing still, which velocities must leave at most
_SMOOTHED = 9  # samples, over whose mean the noise of velocities falls to a third
_AS_GOOD = 1.3  # times the least error: of remedies that do as well, the first is the likelier
_NEAREST_M = 0.1
_OUTSIDE_PX = 1e4  # error of a prediction behind the camera, and the largest one
_BEHIND = 0.5  # share of points without depth from which the images look swapped
_WINDOW = 10  # frames over which the truth's motion is compared
_LEAST_TURN = np.radians(6.0)
_SURE = 4.0
_OTHER_WAY = 0.3  # relative difference of motions from which the truth is another one
_SAME_LENGTH = 0.1
_REJECTED = 0.4
WERE_REJECTED = " were rejected: "  # in the warning about a run, before the likely cause
UNKNOWN = "do not fit each other"  # its end without a likely cause
_MOVING = 0.2  # share of the observations; hardly ever traffic
_OFF_TRUTH = 0.1  # ATE as a share of the path from which the truth is another one


class Sanity(NamedTuple):
    """Facts for the user to judge, and warnings about likely mistakes, one line each."""

    figures: tuple[str, ...]
    warnings: tuple[str, ...]


class _Remedy(NamedTuple):
    """A mistake in words, and how to undo it: function of the extrinsics, factors of velocities, unit of the stamps."""

    text: str
    camera: Callable[[Array], Array] = lambda C: C
    velocities: tuple[float, ...] = (1, 1, 1, 1, 1, 1)
    seconds: float = 1.0
    axes: Array = np.eye(3)

    def undo(self, C: Array, u: Array, tau: Array) -> tuple[Array, Array, Array]:
        """Return the right extrinsics (4, 4), velocities (n, 6) and intervals (n,)."""
        turned = np.hstack([u[:, :3] @ self.axes, u[:, 3:] @ self.axes])
        return self.camera(C), turned * self.velocities, self.seconds * tau

    @property
    def shrinks(self) -> BoolArray:
        """Mask (6,) of the velocities that it makes small, so that their noise may vanish."""
        return self.seconds * np.abs(self.velocities) < 0.5


_OPTICAL, _DEGREE = se3.transform(cam.R_CAM_BODY, np.zeros(3)), np.pi / 180.0
_FORGOTTEN = "optical axes (right, down, forward) are forgotten"
_REMEDIES = (
    _Remedy("T_cam_imu looks inverted", se3.inverse),
    _Remedy(f"T_cam_imu looks like that of a camera with axes forward, left, up: {_FORGOTTEN}", lambda C: _OPTICAL @ C),
    _Remedy(f"T_cam_imu looks inverted, and {_FORGOTTEN}", lambda C: _OPTICAL @ se3.inverse(C)),
    _Remedy("angular velocities look like deg/s instead of rad/s", velocities=(1, 1, 1, _DEGREE, _DEGREE, _DEGREE)),
    _Remedy("stamps look like milliseconds instead of seconds", seconds=1e-3),
    _Remedy("stamps look like microseconds instead of seconds", seconds=1e-6),
    _Remedy("stamps look like nanoseconds instead of seconds", seconds=1e-9),
    _Remedy("linear velocities look as if they had the wrong sign", velocities=(-1, -1, -1, 1, 1, 1)),
    _Remedy("angular velocities look as if they had the wrong sign", velocities=(1, 1, 1, -1, -1, -1)),
    _Remedy("all velocities look as if they had the wrong sign", velocities=(-1, -1, -1, -1, -1, -1)),
    _Remedy(
        "velocities look like those along forward, right, down, while T_cam_imu expects forward, left, up",
        velocities=(1, -1, -1, 1, -1, -1),
    ),
    _Remedy("velocities look like those along the camera's axes right, down, forward", axes=cam.R_CAM_BODY),
)


def inspect_sequence(sequence: Sequence) -> Sanity:
    """Return figures of a recording, and warnings about likely mistakes in it, before it is run."""
    figures, warnings = _tracks_in_front(sequence)
    unfilled = _unfilled(sequence)
    if doubt := baseline_doubt(sequence.camera.baseline_m):
        warnings.append(doubt)
    tau = np.diff(sequence.time_s, prepend=sequence.time_s[:1])
    if len(sequence) > 1:
        figures.insert(0, f"median step {np.median(tau[1:]):.4g} s, longest {tau[1:].max():.4g} s")
    if len(sequence) < 2 or not sequence.has_velocities:
        by_vision = () if warnings or unfilled else _inspect_truth_by_vision(sequence)
        return Sanity(tuple(figures), (*warnings, *unfilled, *by_vision))
    speed, turning = (np.linalg.norm(sequence.twist[:, axes], axis=1) for axes in (slice(3), slice(3, 6)))
    path = f"path {float(speed @ tau):.4g} m by velocities"
    if sequence.truth is not None and len(sequence.truth.frame) > 1:
        path += f", {distance_along(sequence.truth.T_world_imu)[-1]:.4g} m by truth"
    turn = np.degrees(turning.max())
    figures.append(f"speed {np.median(speed):.3g} m/s, at most {speed.max():.3g}; turning at most {turn:.3g} deg/s")
    figures.append(path)
    flow, suspicion, explains = _inspect_flow(sequence, tau)
    # Swapped images make depths wrong, and a flow that does not fit makes velocities wrong.
    warnings = warnings or unfilled or suspicion or (_inspect_truth(sequence) if explains else [])
    return Sanity((*figures, *flow), tuple(warnings))


def inspect_result(sequence: Sequence, result: Result, warnings: tuple[str, ...]) -> tuple[str, ...]:
    """Return warnings about a run, one line each; ``warnings`` of `inspect_sequence` are the likely cause."""
    if result.mode in ("dead-reckoning", "mapping-only"):
        return ()  # their poses drift, so that rejections and distances from the truth are no evidence
    accepted, rejected = int(result.innovation.accepted.sum()), int(result.innovation.rejected.sum())
    rejected -= result.counts.get(f"rejected: {REASONS[WAITING]}", 0)  # such an observation is used later
    if rejected > _REJECTED * max(accepted + rejected, 1):
        parts = "tracks, velocities, stamps and T_cam_imu" if sequence.has_velocities else "the tracks"
        stated = "the stated noise is too small, or " if result.config["noise"]["sigma_px"] is not None else ""
        cause = warnings[0] if warnings else f"{stated}{parts} {UNKNOWN}"
        return (f"{rejected / (accepted + rejected):.0%} of the observations{WERE_REJECTED}{cause}",)
    doubted = result.counts.get("rejected: velocities", 0) / len(sequence)
    if doubted > _REJECTED:
        cause = warnings[0] if warnings else f"tracks, velocities, stamps and T_cam_imu {UNKNOWN}"
        return (f"{doubted:.0%} of the velocities{WERE_REJECTED}{cause}",)
    moving = result.counts.get("rejected: moving", 0) / max(accepted + rejected, 1)
    if moving > _MOVING:
        cause = "traffic, or errors of tracks or velocities that are larger or of another kind than assumed"
        return (f"{moving:.0%} of the observations were dropped as moving with the rig: {cause}",)
    truth = sequence.truth
    if truth is None or len(truth.frame) < 2 or warnings:
        return ()
    path_m = distance_along(truth.T_world_imu)[-1]
    error_m = absolute_trajectory_error(result.T_world_imu[truth.frame], truth.T_world_imu, align=True)
    if error_m <= _OFF_TRUTH * path_m:
        return ()
    off = f"{error_m:.3g} m off a path of {path_m:.3g} m, aligned"
    return (f"the truth looks like that of another recording: the estimate fits the tracks, and is {off}",)


def sanity_attributes(lines: tuple[str, ...]) -> dict[str, str]:
    """Return warnings as an attribute of a result, which `Result.remarks` reads; empty without warnings."""
    return {SANITY: SANITY_SEPARATOR.join(lines)} if lines else {}


def _tracks_in_front(sequence: Sequence) -> tuple[list[str], list[str]]:
    """Return a figure and a warning on points without depth."""
    pixels = sequence.observations.pixels_px
    if not len(pixels) or sequence.camera.is_monocular:
        return [], []
    behind = float((pixels[:, 0] <= pixels[:, 2]).mean())
    figures = [f"{1.0 - behind:.1%} of the observations are of points in front of the camera"]
    swapped = f"left and right images look swapped: {behind:.0%} of the disparities are not positive"
    return figures, [swapped] if behind >= _BEHIND else []


def _unfilled(sequence: Sequence) -> list[str]:
    """Return a warning on velocities that are exactly 0 throughout while the images move."""
    if sequence.velocities is None or sequence.measured_axes.reshape(2, 3).any(axis=1).all():
        return []
    earlier, later = _pairs(sequence)
    pixels = sequence.observations.pixels_px
    seen = np.linalg.norm(pixels[later, :2] - pixels[earlier, :2], axis=1)
    if len(earlier) < _LEAST_PAIRS or np.median(seen) < cam.FLOW_FROM_PX:
        return []
    kinds = missing_velocities(sequence) if sequence.has_velocities else ("linear and angular",)
    zeros = f"exactly 0 throughout, while tracks move by {np.median(seen):.3g} px a frame"
    return [f"{kind} velocities look as if they were never filled in ({zeros}), and are not used" for kind in kinds]


def _inspect_flow(sequence: Sequence, tau: Array) -> tuple[list[str], list[str], bool]:
    """Return how well velocities predict the flow, the likely mistake, and whether they beat standing still."""
    earlier, later = _pairs(sequence)
    if len(earlier) < _LEAST_PAIRS or sequence.camera.is_monocular:  # a flow needs depths
        return [], [], True
    at, pixels = sequence.observations.frame[later], sequence.observations.pixels_px
    seen = np.linalg.norm(pixels[later, :2] - pixels[earlier, :2], axis=1)
    turning = np.linalg.norm(sequence.twist[at, 3:], axis=1)
    turns = turning >= np.quantile(turning, 1.0 - _SHARE_TURNING)
    points = cam.triangulate(sequence.camera, cam.rectified_rows(pixels[earlier], np.ones(4))[0])

    frames, which = np.unique(at, return_inverse=True)

    def error_px(C: Array, u: Array, tau: Array) -> tuple[float, float]:
        """Return the median distance of prediction and observation, on straight stretches and in turns."""
        T = C @ motion.increment(u, tau) @ se3.inverse(C)
        return _off(sequence, se3.apply(T[which], points), pixels[later, :2], turns)

    C, u, tau = given = sequence.T_cam_imu, sequence.twist[frames], tau[frames]
    straight, turn = error_px(*given)
    smooth = sum(error_px(C, _smoothed(sequence.twist)[frames], tau))
    still = sum(error_px(C, np.zeros_like(u), tau))
    predicted = f"the velocities predict it to {straight:.3g} px, where the rig turns most to {turn:.3g} px"
    figure = f"tracks move by {np.median(seen):.3g} px a frame; {predicted}"
    found = [(sum(error_px(*remedy.undo(*given))), remedy) for remedy in _REMEDIES]
    least = min(error for error, _ in found)
    best, remedy = next(entry for entry in found if entry[0] <= _AS_GOOD * least)
    unmoved = sum(error_px(C, np.where(remedy.shrinks, 0.0, u), tau)) if remedy.shrinks.any() else still
    off = f"{0.5 * (straight + turn):.3g} px" if straight + turn < _OUTSIDE_PX else "out of the image"
    if best <= _BETTER * (straight + turn) and best <= _EXPLAINS * unmoved:
        text = f"{remedy.text}: the flow of the tracks is predicted {off} off, otherwise {0.5 * best:.2g} px"
        return [figure], [text], False
    explains = min(straight + turn, smooth) <= _EXPLAINS * still
    is_noise = len(sequence) < _SMOOTHED**2 or smooth < _EXPLAINS * (straight + turn)
    if not is_noise and smooth > still / _BETTER:
        text = f"the velocities look like those of another recording: they predict the flow of the tracks {off} off"
        return [figure], [f"{text}, standing still {0.5 * still:.3g} px"], False
    return [figure], [], explains


def _smoothed(twist: Array) -> Array:
    """Return running means over `_SMOOTHED` samples of velocities (T, 6), which are reflected at both ends."""
    padded = np.pad(twist, ((_SMOOTHED // 2, _SMOOTHED // 2), (0, 0)), mode="symmetric")
    return np.lib.stride_tricks.sliding_window_view(padded, _SMOOTHED, axis=0).mean(axis=-1)


def _pairs(sequence: Sequence) -> tuple[IntArray, IntArray]:
    """Return some observations with depth in successive frames, while the rig moves and is measured."""
    observations, pixels = sequence.observations, sequence.observations.pixels_px
    earlier, later = successive(observations)
    adjacent = observations.frame[later] - observations.frame[earlier] == 1
    near = sequence.camera.is_monocular or pixels[earlier, 0] - pixels[earlier, 2] > cam.FLOW_FROM_PX
    moves = (pixels[later] != pixels[earlier]).any(axis=1)
    measured = ~sequence.interpolated[observations.frame[later]]
    chosen = np.flatnonzero(adjacent & near & moves & measured)
    chosen = chosen[:: max(1, len(chosen) // _PAIRS)]
    return earlier[chosen], later[chosen]


def _off(sequence: Sequence, points: Array, seen: Array, turns: BoolArray) -> tuple[float, float]:
    """Return the median distance (px) of projected points (n, 3) from images (n, 2): driving straight, in turns."""
    ahead = points[:, 2] > _NEAREST_M
    image = cam.project(sequence.camera, np.where(ahead[:, None], points, 1.0))[:, :2]
    off = np.where(ahead, np.minimum(np.linalg.norm(image - seen, axis=1), _OUTSIDE_PX), _OUTSIDE_PX)
    parts = [off[part] for part in (~turns, turns) if part.any()]
    return float(np.median(parts[0])), float(np.median(parts[-1]))


def _inspect_truth_by_vision(sequence: Sequence) -> tuple[str, ...]:
    """Return a warning if the truth of a recording without velocities moves differently from its stereo odometry."""
    if sequence.truth is None or sequence.camera.is_monocular or len(_pairs(sequence)[0]) < _LEAST_PAIRS:
        return ()
    return tuple(_inspect_truth(sequence, sequence.once(stereo_odometry), "stereo odometry says"))


def _inspect_truth(sequence: Sequence, twist: Array | None = None, said: str = "the velocities say") -> list[str]:
    """Return a warning if the truth moves differently from velocities (T, 6), over stretches of some frames."""
    truth = sequence.truth
    if truth is None or len(truth.frame) <= _WINDOW:
        return []
    twist = sequence.twist if twist is None else twist
    T = se3.inverse(motion.integrate(np.eye(4), twist, np.diff(sequence.time_s)))[truth.frame]
    P = truth.T_world_imu
    step, true_step = (se3.inverse(poses[:-_WINDOW]) @ poses[_WINDOW:] for poses in (T, P))
    duration = sequence.time_s[truth.frame[_WINDOW:]] - sequence.time_s[truth.frame[:-_WINDOW]]
    drift_m, drift_rad = _noise_over_window(sequence, twist)
    least_m, least_rad = np.maximum(MOVING_M_S * duration, drift_m), np.full(len(step), max(_LEAST_TURN, drift_rad))
    way = _disagreement(step[:, :3, 3], true_step[:, :3, 3], least_m, drift_m)
    turn = _disagreement(se3.so3_log(step[:, :3, :3]), se3.so3_log(true_step[:, :3, :3]), least_rad, drift_rad)
    if max(way, turn) < _OTHER_WAY:
        return []
    lengths, true_lengths = (np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True) for poses in (step, true_step))
    if way > _OTHER_WAY and _disagreement(lengths, true_lengths, least_m, drift_m) < _SAME_LENGTH:
        moves = f"it moves as far as {said}, but another way ({way:.0%} of it apart)"
        return [f"the truth looks like poses of another body than the IMU: {moves}"]
    moves, turns = f"moves another way than {said}, {way:.0%}", f"turns otherwise, {turn:.0%}"
    how = f"{moves if way > turn else turns} of it"
    return [f"the truth looks like that of another recording: over {_WINDOW} frames it {how} apart"]


def _noise_over_window(sequence: Sequence, twist: Array) -> tuple[float, float]:
    """Return bounds on the sum of white velocity noise over a stretch, m and rad: `_SURE` deviations."""
    changes = np.median(np.abs(np.diff(twist, axis=0)), axis=0)
    std = changes / (0.6745 * np.sqrt(2.0)) * np.median(np.diff(sequence.time_s)) * np.sqrt(_WINDOW)
    return _SURE * float(np.linalg.norm(std[:3])), _SURE * float(np.linalg.norm(std[3:]))


def _disagreement(found: Array, true: Array, least: Array, noise: float) -> float:
    """Return the median relative distance of motions (n, d) above ``least`` (n,), without half the bound of noise."""
    larger = np.maximum(np.linalg.norm(found, axis=1), np.linalg.norm(true, axis=1))
    moving = larger > least
    if moving.sum() < _WINDOW:
        return 0.0
    apart = np.maximum(np.linalg.norm(found - true, axis=1)[moving] - 0.5 * noise, 0.0)
    return float(np.median(apart / larger[moving]))
