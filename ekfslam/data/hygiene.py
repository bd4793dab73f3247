"""Track hygiene: the one stage between a recording and the filters, in which tracks are cut and observations dropped.

Every rule looks at the tracks alone, at how much noise their pixels have, and at the measured velocities; none needs an
estimate. What a rule did is listed observation by observation in a `HygieneReport`: nothing goes silently.

A rule either *drops* an observation, or *cuts* a track: from that observation on the track has an id of its own. Ids of
new pieces count on from the largest. In a recording whose tracks have no gaps, a track is also cut where the dropping
leaves one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.config import HygieneConfig
from ekfslam.data.sequence import Noise, Observations, Sequence
from ekfslam.data.tracks import cut_tracks, repeated_frames, successive
from ekfslam.geometry import camera as cam
from ekfslam.geometry import motion, se3
from ekfslam.stored import COUNTS, FRAMES, attribute, stored, whole, zeros

# The rules in the order in which they are applied, with the key of ``[hygiene]`` that switches each. The index of a
# rule is its code in `HygieneReport.rule`, also in archives: what is new comes last.
_SWITCHES: dict[str, str] = {
    "repeated frame": "restart_at_repeats",
    "jump": "jump_sigma",
    "re-used id": "reused_id_sigma",
    "disparity": "min_disparity_sigma",
    "row mismatch": "max_row_mismatch_sigma",
    "depth": "max_depth_error",
    "too short": "min_observations",
    "disparity jump": "disparity_jump_sigma",
}
RULES: tuple[str, ...] = tuple(_SWITCHES)
REPEATED_FRAME, JUMP, REUSED_ID, DISPARITY, ROW_MISMATCH, DEPTH, TOO_SHORT, DISPARITY_JUMP = range(len(RULES))

# Standard deviation that white noise of 1 px gives to what `jumps` compares.
_JUMP_STD = 2.0
_COMPANY = 5  # tracks of a frame that can tell how the frame as a whole moved


@dataclass(frozen=True)
class HygieneReport:
    """What hygiene found and did, one row a finding, in the order of the rules and then of the frames.

    Args:
        observations: Number of observations looked at.
        rule: (n,) index into `RULES`.
        frame: (n,) frame of the observation that was dropped, or with which the new piece of a cut track begins.
        landmark: (n,) id of its track in the recording.
        continuation: (n,) id that a cut track has from there on; -1 where the observation was dropped.
    """

    observations: int = field(metadata=attribute(int))
    rule: IntArray = field(metadata=stored("finding", "code, see names", codes=RULES))
    frame: IntArray = field(metadata=stored("finding", "frame index", check=FRAMES))
    landmark: IntArray = field(metadata=stored("finding", "landmark id", check=COUNTS))
    continuation: IntArray = field(metadata=stored("finding", "landmark id, -1 where dropped", check=whole(-1)))

    @property
    def dropped(self) -> int:
        """Number of observations dropped, each by one rule."""
        return int((self.continuation < 0).sum())

    @property
    def counts(self) -> dict[str, int]:
        """Findings by rule, and the observations dropped in all."""
        found = np.bincount(self.rule, minlength=len(RULES)).tolist()
        return {
            "dropped by hygiene": self.dropped,
            **{f"hygiene: {name}": count for name, count in zip(RULES, found, strict=True)},
        }

    def lines(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """One line a rule: what was found, where, and what was done; or that ``config`` (``[hygiene]``) has it off."""
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

    @staticmethod
    def empty(observations: int) -> HygieneReport:
        """Return the report on clean tracks."""
        return HygieneReport(observations, **zeros(HygieneReport, finding=0))


def clean_tracks(sequence: Sequence, noise: Noise, config: HygieneConfig) -> tuple[Observations, HygieneReport]:
    """Apply the rules of ``config`` to the tracks of a sequence.

    Args:
        sequence: The recording.
        noise: What its pixels and velocities are worth; all limits are multiples of it.
        config: Which rules, and how strict.

    Returns:
        The tracks that are left, and the report.
    """
    kept = sequence.observations
    own = kept.landmark  # id in the recording
    # Where no track ever comes back, none shall because of what is dropped here.
    come_back = _after_gaps(kept).any()
    rows: list[tuple[int, IntArray, IntArray, IntArray]] = []

    def drop(rule: int, bad: NDArray[np.bool_]) -> None:
        nonlocal kept, own
        rows.append((rule, kept.frame[bad], own[bad], np.full(int(bad.sum()), -1)))
        kept, own = Observations(kept.frame[~bad], kept.landmark[~bad], kept.pixels_px[~bad]), own[~bad]
        if not come_back and (gaps := _after_gaps(kept)).any():
            cut(rule, gaps)

    def cut(rule: int, starts: NDArray[np.bool_]) -> None:
        nonlocal kept, own
        landmark = cut_tracks(kept, starts, int(kept.landmark.max(initial=-1)) + 1)
        rows.append((rule, kept.frame[starts], own[starts], landmark[starts]))
        order = np.lexsort((landmark, kept.frame))  # that of `Observations`
        kept, own = Observations(kept.frame, landmark, kept.pixels_px), own[order]

    std = noise.pixel_std_px
    disparity_std, row_std = np.hypot(std[0], std[2]), np.hypot(std[1], std[3])
    if config.restart_at_repeats:
        starts = _first_at_or_after(kept, repeated_frames(kept, sequence.twist))
        cut(REPEATED_FRAME, starts & ~_is_slow(kept, config.restart_above_px))
    if config.jump_sigma:
        cut(JUMP, jumps(kept, noise, config.jump_sigma))
    if config.reused_id_sigma:
        cut(REUSED_ID, reused_ids(sequence, kept, noise, config.reused_id_sigma))
    least = config.min_disparity_sigma
    if least is None or least > 0:
        drop(DISPARITY, _disparity(kept) <= (1.0 if least is None else least) * disparity_std)
    if config.max_row_mismatch_sigma:
        mismatch = np.abs(kept.pixels_px[:, 1] - kept.pixels_px[:, 3])
        drop(ROW_MISMATCH, mismatch > config.max_row_mismatch_sigma * row_std)
    if config.max_depth_error:
        # The relative error of a depth is that of its disparity; a track is as good as its nearest observation.
        track = np.searchsorted(kept.ids, kept.landmark)
        nearest = np.zeros(len(kept.ids))
        np.maximum.at(nearest, track, _disparity(kept))
        drop(DEPTH, (nearest * config.max_depth_error < disparity_std)[track])
    if config.min_observations:
        track = np.searchsorted(kept.ids, kept.landmark)
        drop(TOO_SHORT, np.bincount(track)[track] < config.min_observations)
    if config.disparity_jump_sigma:
        # Asked of the tracks as they were recorded: where far ones have lost observations, the jump is not seen.
        jumped = disparity_jumps(sequence, noise, config.disparity_jump_sigma)
        drop(DISPARITY_JUMP, np.isin(own, jumped))

    if not rows:
        return kept, HygieneReport.empty(len(sequence.observations))
    rule = np.repeat([row[0] for row in rows], [len(row[1]) for row in rows])
    frame, landmark, continuation = (np.concatenate([row[i] for row in rows]) for i in (1, 2, 3))
    return kept, HygieneReport(len(sequence.observations), rule, frame, landmark, continuation)


def jumps(observations: Observations, noise: Noise, sigma: float) -> NDArray[np.bool_]:
    """Whether (K,) an observation shows another point than the track did before: its pixels jump and stay there.

    Three observations before and three from there on (in successive frames) decide. The track's course is the median of
    the two motions before and the two after; what the pixels have moved beyond it is taken over one, three and five
    frames about the jump, and the median of the three is not moved by one bad observation. A jump exceeds the
    differences within the course. Less what the frame's tracks have in common, it also exceeds ``sigma`` standard
    deviations of pixel noise and of the scatter of the frame's tracks together.
    """
    order = np.lexsort((observations.frame, observations.landmark))
    frame, landmark = observations.frame[order], observations.landmark[order]
    starts = np.flatnonzero((landmark[5:] == landmark[:-5]) & (frame[5:] - frame[:-5] == 5))
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


def reused_ids(sequence: Sequence, observations: Observations, noise: Noise, sigma: float) -> NDArray[np.bool_]:
    """Whether (K,) an observation after a gap in its track shows a point that cannot be the one from before the gap.

    Both points are put into the world by the velocities alone. They may be apart by ``sigma`` standard deviations: of
    both triangulations, and of what the velocities' noise adds up to during the gap, in position and (over the way and
    the distance to the point) in heading. After a long drive that forbids little, so a landmark that comes back is not
    cut.
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
    allowed += drift + turn * reach**2 + (noise.misalignment_rad * way) ** 2
    found[later] = np.linalg.norm(apart[1] - apart[0], axis=1) > sigma * np.sqrt(allowed)
    return found


def disparity_jumps(sequence: Sequence, noise: Noise, sigma: float) -> IntArray:
    """Ids (n,) of tracks that a frame sees together with another right image of their points than the frame before.

    The velocities say how the depth of a point changes, and so its disparity; a track jumps by what its disparity
    changes otherwise, in standard deviations of both disparities and of the velocities, beyond twice what it does in
    the intervals beside. Traffic does so over many frames, a stereo match that was made anew does it once. Where the
    median of a frame's tracks jumps by more than ``sigma``, all that are seen across are affected. Tracks with less
    than ``sigma`` deviations of disparity cannot tell, nor can those of two frames, and at least `_COMPANY` must.
    """
    o, camera = sequence.observations, sequence.camera
    earlier, later = successive(o)
    beside = o.frame[later] - o.frame[earlier] == 1
    earlier, later = earlier[beside], later[beside]
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


def _is_slow(observations: Observations, limit_px: float) -> NDArray[np.bool_]:
    """Whether (K,) an observation's track moves by at most ``limit_px`` before and after the frame that leads to it.

    Those are the motions to the frame before and from this one to the next; a track that has neither is not slow.
    """
    earlier, later = successive(observations)
    beside = observations.frame[later] - observations.frame[earlier] == 1
    earlier, later = earlier[beside], later[beside]
    moved = np.abs(observations.pixels_px[later] - observations.pixels_px[earlier]).max(axis=1)
    onward, hither, before = np.full((3, len(observations)), -1.0)
    onward[earlier] = hither[later] = moved
    before[later] = hither[earlier]
    fastest = np.maximum(before, onward)
    return (fastest >= 0) & (fastest <= limit_px)


def _after_gaps(observations: Observations) -> NDArray[np.bool_]:
    """Whether (K,) an observation is the first after frames that did not see its track."""
    earlier, later = successive(observations)
    found = np.zeros(len(observations), dtype=bool)
    found[later[observations.frame[later] - observations.frame[earlier] > 1]] = True
    return found


def _disparity(observations: Observations) -> Array:
    return observations.pixels_px[:, 0] - observations.pixels_px[:, 2]


def _first_at_or_after(observations: Observations, frames: IntArray) -> NDArray[np.bool_]:
    """Whether (K,) an observation is the first of its track at or after one of ``frames``, but not of all the track."""
    piece = np.searchsorted(frames, observations.frame, side="right")
    earlier, later = successive(observations)
    found = np.zeros(len(observations), dtype=bool)
    found[later[piece[later] > piece[earlier]]] = True
    return found


def _median_by(group: IntArray, values: Array) -> Array:
    """For every row of ``values`` (n, m) the medians of all rows of its group (n,)."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    start = np.cumsum(count) - count
    medians = np.empty((len(count), values.shape[1]))
    for column in range(values.shape[1]):
        ordered = values[np.lexsort((values[:, column], which)), column]
        medians[:, column] = 0.5 * (ordered[start + (count - 1) // 2] + ordered[start + count // 2])
    return medians[which]
