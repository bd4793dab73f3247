"""Track hygiene: the stage between a recording and the filters that cuts tracks and drops observations.

The rules use tracks, their pixel noise, and measured velocities; none needs an estimate. A rule either *drops* an
observation, or *cuts* a track: from that observation on the track has an id of its own, counted on from the largest. If
the tracks of a recording have no gaps, a track is also cut at every gap that a rule makes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import HygieneConfig
from ekfslam.data.sequence import Noise, Observations, Sequence
from ekfslam.data.tracks import adjacent, cut_tracks, repeated_frames, successive
from ekfslam.data.traffic import moving_tracks
from ekfslam.geometry import camera as cam
from ekfslam.geometry import motion, se3
from ekfslam.stored import COUNTS, FRAMES, attribute, layout_of, stored, whole, zeros

# The rules in the order in which they are applied, with the key of ``[hygiene]`` that switches each. The index of a
# rule is its code in `HygieneReport.rule`, also in archives: new rules are added at the end.
_SWITCHES: dict[str, str] = {
    "repeated frame": "restart_at_repeats",
    "jump": "jump_sigma",
    "re-used id": "reused_id_sigma",
    "disparity": "min_disparity_sigma",
    "row mismatch": "max_row_mismatch_sigma",
    "depth": "max_depth_error",
    "too short": "min_observations",
    "disparity jump": "disparity_jump_sigma",
    "moves": "moving",
}
RULES: tuple[str, ...] = tuple(_SWITCHES)
REPEATED_FRAME, JUMP, REUSED_ID, DISPARITY, ROW_MISMATCH, DEPTH, TOO_SHORT, DISPARITY_JUMP, MOVES = range(len(RULES))

_JUMP_STD = 2.0  # of the jump that `jumps` tests, due to white noise of 1 px
_COMPANY = 5  # tracks of a frame that can tell how the frame as a whole moved


@dataclass(frozen=True)
class HygieneReport:
    """Findings of the rules, one row each, in the order of the rules and then of the frames.

    Args:
        observations: Number of observations examined.
        rule: (n,) index into `RULES`.
        frame: (n,) frame of the dropped observation, or first frame of the new piece of a cut track.
        landmark: (n,) id of the track in the recording.
        continuation: (n,) id of the new piece of a cut track; -1 for a dropped observation.
    """

    observations: int = field(metadata=attribute(int))
    rule: IntArray = field(metadata=stored("finding", "code, see names", codes=RULES))
    frame: IntArray = field(metadata=stored("finding", "frame index", check=FRAMES))
    landmark: IntArray = field(metadata=stored("finding", "landmark id", check=COUNTS))
    continuation: IntArray = field(metadata=stored("finding", "landmark id, -1 where dropped", check=whole(-1)))

    @property
    def dropped(self) -> int:
        """Number of dropped observations."""
        return int((self.continuation < 0).sum())

    @property
    def counts(self) -> dict[str, int]:
        """Number of findings by rule, and of all dropped observations."""
        found = np.bincount(self.rule, minlength=len(RULES)).tolist()
        by_rule = {f"hygiene: {name}": count for name, count in zip(RULES, found, strict=True)}
        return {"dropped by hygiene": self.dropped, **by_rule}

    def lines(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Return one line a rule: its findings, or that ``config`` (``[hygiene]``) switches it off."""
        lines = []
        for code, (name, switch) in enumerate(_SWITCHES.items()):
            found = self.rule == code
            tracks, frames = np.unique(self.landmark[found]), np.unique(self.frame[found])
            cut = int((self.continuation[found] >= 0).sum())
            dropped = int(found.sum()) - cut
            line = f"{name}: " + ("nothing found" if config[switch] else "switched off")
            if len(frames):
                what = " and ".join([f"{dropped} observations dropped"] * bool(dropped) + [f"{cut} cuts"] * bool(cut))
                line = f"{name}: {what}, in {len(tracks)} tracks, {len(frames)} frames from {frames[0]} to {frames[-1]}"
            lines.append(line)
        return (*lines, f"{self.dropped} of {self.observations} observations dropped in all")


class _Cleaning:
    """Observations that rules leave (``kept``), and ids (K,) of their tracks in the recording (``own``)."""

    def __init__(self, observations: Observations) -> None:
        self.kept, self.own = observations, observations.landmark
        self._looked_at = len(observations)
        self._has_gaps = bool(_after_gaps(observations).any())
        self._findings: list[tuple[IntArray, ...]] = []

    def drop(self, rule: int, bad: BoolArray) -> None:
        self._record(rule, bad, np.full(len(bad), -1))
        kept = self.kept
        self.kept, self.own = Observations(kept.frame[~bad], kept.landmark[~bad], kept.pixels_px[~bad]), self.own[~bad]
        if not self._has_gaps and (gaps := _after_gaps(self.kept)).any():
            self.cut(rule, gaps)

    def cut(self, rule: int, starts: BoolArray) -> None:
        kept = self.kept
        landmark = cut_tracks(kept, starts, int(kept.landmark.max(initial=-1)) + 1)
        self._record(rule, starts, landmark)
        self.own = self.own[np.lexsort((landmark, kept.frame))]  # the order of `Observations`
        self.kept = Observations(kept.frame, landmark, kept.pixels_px)

    def by_track(self) -> IntArray:
        """Return the number (K,) of the track of each observation, counted from 0."""
        return np.searchsorted(self.kept.ids, self.kept.landmark)

    def report(self) -> HygieneReport:
        if not self._findings:
            return HygieneReport(self._looked_at, **zeros(layout_of(HygieneReport)))
        return HygieneReport(self._looked_at, *map(np.concatenate, zip(*self._findings, strict=True)))

    def _record(self, rule: int, found: BoolArray, continuation: IntArray) -> None:
        columns = (np.full(len(found), rule), self.kept.frame, self.own, continuation)
        self._findings.append(tuple(column[found] for column in columns))


def clean_tracks(sequence: Sequence, noise: Noise, config: HygieneConfig) -> tuple[Observations, HygieneReport]:
    """Return the tracks that the rules of ``config`` leave, and the report; one camera has no disparities."""
    if sequence.camera.is_monocular:
        config = replace(config, reused_id_sigma=0.0, min_disparity_sigma=0.0, max_row_mismatch_sigma=0.0)
        config = replace(config, max_depth_error=0.0, disparity_jump_sigma=0.0, moving=False)
    tracks, std = _Cleaning(sequence.observations), noise.pixel_std_px
    disparity_std, row_std = np.hypot(std[0], std[2]), np.hypot(std[1], std[3])
    if config.restart_at_repeats:
        starts = _first_at_or_after(tracks.kept, repeated_frames(tracks.kept, sequence.twist))
        tracks.cut(REPEATED_FRAME, starts)
    if config.jump_sigma:
        tracks.cut(JUMP, jumps(tracks.kept, noise, config.jump_sigma))
    if config.reused_id_sigma:
        tracks.cut(REUSED_ID, reused_ids(sequence, tracks.kept, noise, config.reused_id_sigma))
    least = 1.0 if config.min_disparity_sigma is None else config.min_disparity_sigma
    if least > 0:
        tracks.drop(DISPARITY, _disparity(tracks.kept) <= least * disparity_std)
    if config.max_row_mismatch_sigma:
        mismatch = np.abs(tracks.kept.pixels_px[:, 1] - tracks.kept.pixels_px[:, 3])
        tracks.drop(ROW_MISMATCH, mismatch > config.max_row_mismatch_sigma * row_std)
    if config.max_depth_error:
        # The relative error of a depth is that of its disparity; the nearest observation of a track decides.
        track = tracks.by_track()
        nearest = np.zeros(len(tracks.kept.ids))
        np.maximum.at(nearest, track, _disparity(tracks.kept))
        tracks.drop(DEPTH, (nearest * config.max_depth_error < disparity_std)[track])
    if config.min_observations:
        track = tracks.by_track()
        tracks.drop(TOO_SHORT, np.bincount(track)[track] < config.min_observations)
    if config.disparity_jump_sigma:
        # The recorded tracks decide: if far ones have lost observations, the jump does not show.
        jumped = disparity_jumps(sequence, noise, config.disparity_jump_sigma)
        tracks.drop(DISPARITY_JUMP, np.isin(tracks.own, jumped))
    if config.moving:
        tracks.drop(MOVES, np.isin(tracks.kept.landmark, moving_tracks(sequence, tracks.kept, noise)))
    return tracks.kept, tracks.report()


def jumps(observations: Observations, noise: Noise, sigma: float) -> BoolArray:
    """Return whether (K,) the pixels of a track jump at an observation, and stay there: it shows another point.

    Three observations before and three from there on, in successive frames, decide. The course of a track is the median
    of the two motions before and the two after. The jump is the median of the motions beyond it over one, three and
    five frames. It exceeds the differences within the course and, less the common motion of the frame's tracks,
    ``sigma`` standard deviations of pixel noise and of the scatter of these tracks together.
    """
    order = np.lexsort((observations.frame, observations.landmark))
    frame, landmark = observations.frame[order], observations.landmark[order]
    starts = np.flatnonzero((landmark[5:] == landmark[:-5]) & (frame[5:] - frame[:-5] == 5))
    if observations.is_monocular:
        rows, variance = observations.pixels_px[order], np.asarray(noise.pixel_std_px[:2]) ** 2
    else:
        rows, variance = cam.rectified_rows(observations.pixels_px[order], noise.pixel_std_px)
    window = rows[starts[:, None] + np.arange(6)]
    motions = np.diff(window, axis=1)[:, [0, 1, 3, 4]]
    beyond = window[:, [3, 4, 5]] - window[:, [2, 1, 0]]
    beyond -= np.median(motions, axis=1)[:, None] * np.array([1.0, 3.0, 5.0])[:, None]
    jump, at = np.median(beyond, axis=1), frame[starts + 3]
    alone = (np.bincount(at, minlength=1)[at] < _COMPANY)[:, None]
    common = np.where(alone, 0.0, _median_by(at, jump))
    scatter = np.where(alone, 0.0, 1.4826 * _median_by(at, np.abs(jump - common)))
    far = np.abs(jump - common) > sigma * np.hypot(scatter, _JUMP_STD * np.sqrt(variance))
    found = np.zeros(len(observations), dtype=bool)
    steady = np.linalg.norm(jump, axis=1) > np.linalg.norm(np.ptp(motions, axis=1), axis=1)
    found[order[starts[far.any(axis=1) & steady] + 3]] = True
    return found


def reused_ids(sequence: Sequence, observations: Observations, noise: Noise, sigma: float) -> BoolArray:
    """Return whether (K,) an observation after a gap in its track cannot show the point from before the gap.

    Velocities alone place both points in the world. They may be ``sigma`` standard deviations apart: those of both
    triangulations, and of the velocity noise that accumulates during the gap, in position and (over the way and the
    distance to the point) in heading. So a landmark that comes back after a long drive is not cut.
    """
    found = np.zeros(len(observations), dtype=bool)
    earlier, later = successive(observations)
    gap = observations.frame[later] - observations.frame[earlier] > 1
    earlier, later = earlier[gap], later[gap]
    disparity = _disparity(observations)
    measurable = (disparity[earlier] > 0) & (disparity[later] > 0)
    earlier, later = earlier[measurable], later[measurable]
    if not len(later):
        return found

    T_imu_world = motion.integrate(np.eye(4), sequence.twist, np.diff(sequence.time_s))
    T_world_cam = se3.inverse(sequence.T_cam_imu @ T_imu_world)

    pixels = observations.pixels_px
    rows, variance = cam.rectified_rows(pixels, noise.pixel_std_px)
    apart, allowed = [], np.zeros(len(later))
    for which in (earlier, later):
        q = cam.triangulate(sequence.camera, rows[which])
        apart.append(se3.apply(T_world_cam[observations.frame[which]], q))
        spread = np.linalg.inv(cam.rectified_jacobian(sequence.camera, q)) * np.sqrt(variance)
        allowed += (spread**2).sum(axis=(1, 2))

    def over(per_frame: Array) -> Array:
        total = np.cumsum(per_frame)
        return total[observations.frame[later]] - total[observations.frame[earlier]]

    tau = np.diff(sequence.time_s, prepend=sequence.time_s[0])
    velocity = noise.velocity_std
    way = over(tau * np.linalg.norm(sequence.twist[:, :3], axis=1))
    reach = way + np.linalg.norm(cam.triangulate(sequence.camera, rows[later]), axis=1)
    drift = over(tau**2 * (velocity[:3] ** 2).sum())
    turn = over(tau**2 * (velocity[3:] ** 2).sum())
    allowed += drift + turn * reach**2
    found[later] = np.linalg.norm(apart[1] - apart[0], axis=1) > sigma * np.sqrt(allowed)
    return found


def disparity_jumps(sequence: Sequence, noise: Noise, sigma: float) -> IntArray:
    """Return the ids (n,) of tracks in frames in which the stereo matches of most tracks change at once.

    Velocities predict the change of a point's disparity. A track jumps by the rest of the change, in standard
    deviations of both disparities and of the velocities, less twice the jumps in the two neighbouring intervals:
    traffic changes over many frames, a new stereo match does once. If the median of a frame's tracks, at least
    `_COMPANY`, jumps by more than ``sigma``, all tracks that lead into the frame are affected. Tracks with less than
    ``sigma`` deviations of disparity do not count, nor do those of two frames.
    """
    o, camera = sequence.observations, sequence.camera
    earlier, later = adjacent(o)
    disparity, std = _disparity(o), float(np.hypot(noise.pixel_std_px[0], noise.pixel_std_px[2]))
    tells = (disparity[earlier] > sigma * std) & (disparity[later] > 0)
    a, b = earlier[tells], later[tells]
    at = o.frame[b]
    tau = np.diff(sequence.time_s, prepend=sequence.time_s[0])[at]
    points = cam.triangulate(camera, cam.rectified_rows(o.pixels_px[a], noise.pixel_std_px)[0])
    C = sequence.T_cam_imu
    depth = se3.apply(C @ motion.increment(sequence.twist[at], tau) @ se3.inverse(C), points)[:, 2]
    in_front = depth > 0
    a, b, at, tau, depth = a[in_front], b[in_front], at[in_front], tau[in_front], depth[in_front]
    expected = camera.fu_px * camera.baseline_m / depth
    by_velocity = expected / depth * tau * np.linalg.norm(noise.velocity_std[:3])
    jump = np.abs(disparity[b] - expected) / np.hypot(np.sqrt(2.0) * std, by_velocity)
    # Pairs are in the order of tracks and then of frames.
    goes_on = b[:-1] == a[1:]
    after, before = np.zeros((2, len(jump)))
    after[:-1], before[1:] = np.where(goes_on, jump[1:], 0.0), np.where(goes_on, jump[:-1], 0.0)
    has_beside = np.zeros(len(jump), dtype=bool)
    has_beside[:-1] |= goes_on
    has_beside[1:] |= goes_on
    at, beyond = at[has_beside], (jump - 2.0 * np.maximum(before, after))[has_beside]
    together = np.bincount(at, minlength=1)[at] >= _COMPANY
    frames = np.unique(at[together & (_median_by(at, beyond[:, None])[:, 0] > sigma)])
    return np.unique(o.landmark[later[np.isin(o.frame[later], frames)]])


def _after_gaps(observations: Observations) -> BoolArray:
    """Return whether (K,) an observation is the first after frames that did not see its track."""
    earlier, later = successive(observations)
    found = np.zeros(len(observations), dtype=bool)
    found[later[observations.frame[later] - observations.frame[earlier] > 1]] = True
    return found


def _disparity(observations: Observations) -> Array:
    return observations.pixels_px[:, 0] - observations.pixels_px[:, 2]


def _first_at_or_after(observations: Observations, frames: IntArray) -> BoolArray:
    """Return whether (K,) an observation is the first of its track at or after a frame of ``frames``, not of all."""
    piece = np.searchsorted(frames, observations.frame, side="right")
    earlier, later = successive(observations)
    found = np.zeros(len(observations), dtype=bool)
    found[later[piece[later] > piece[earlier]]] = True
    return found


def _median_by(group: IntArray, values: Array) -> Array:
    """Return for every row of ``values`` (n, m) the medians over the rows of its group (n,)."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    start = np.cumsum(count) - count
    medians = np.empty((len(count), values.shape[1]))
    for column in range(values.shape[1]):
        ordered = values[np.lexsort((values[:, column], which)), column]
        medians[:, column] = 0.5 * (ordered[start + (count - 1) // 2] + ordered[start + count // 2])
    return medians[which]
