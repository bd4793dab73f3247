"""Statistics of tracks, and cutting of tracks, for `ekfslam.data.hygiene`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Observations

# Sensors of a rig that stands still read less than this; turning faster moves the pixels by more than one a frame.
MOVING_M_S = 0.1
MOVING_RAD_S = 0.02


@dataclass(frozen=True)
class TrackReport:
    """Findings of `inspect_tracks`.

    Args:
        tracks: Number of distinct landmark ids.
        observations_per_frame: (T,) number of observations.
        repeated_frames: See the function `repeated_frames`.
        returning_tracks: Number of tracks that come back after a gap.
        nonpositive_disparities: Number of observations with ``uL - uR <= 0``, which have no depth.
        max_row_mismatch_px: Largest ``|vL - vR|``.
    """

    tracks: int
    observations_per_frame: IntArray
    repeated_frames: IntArray
    returning_tracks: int
    nonpositive_disparities: int
    max_row_mismatch_px: float

    @property
    def notes(self) -> tuple[str, ...]:
        """Findings, one sentence each."""
        frames, observations = len(self.observations_per_frame), int(self.observations_per_frame.sum())
        blind = int((self.observations_per_frame == 0).sum())
        repeated, of = len(self.repeated_frames), f"of {frames} frames"
        same = "the previous frame's pixels in every common track although the rig moves"
        counted = {
            f"{repeated} {of} repeat {same}.": repeated,
            f"{self.returning_tracks} tracks come back after a gap.": self.returning_tracks,
            f"{(flat := self.nonpositive_disparities)} of {observations} observations have a disparity <= 0.": flat,
        }
        seen = f"{self.tracks} tracks, {observations} observations, {observations / frames:.1f} a frame"
        return (
            f"{seen}; {blind} {of} see nothing.",
            *(line for line, number in counted.items() if number),
            f"|vL - vR| is at most {self.max_row_mismatch_px:.2f} px.",
        )


def inspect_tracks(observations: Observations, twist: Array) -> TrackReport:
    """Inspect the tracks of a recording with velocities ``twist`` (T, 6) in m/s and rad/s."""
    earlier, later = successive(observations)
    gap = observations.frame[later] - observations.frame[earlier] > 1
    pixels, is_mono = observations.pixels_px, observations.is_monocular
    return TrackReport(
        tracks=len(observations.ids),
        observations_per_frame=np.bincount(observations.frame, minlength=len(twist)),
        repeated_frames=repeated_frames(observations, twist),
        returning_tracks=len(np.unique(observations.landmark[later[gap]])),
        nonpositive_disparities=0 if is_mono else int((pixels[:, 0] <= pixels[:, 2]).sum()),
        max_row_mismatch_px=0.0 if is_mono else float(np.abs(pixels[:, 1] - pixels[:, 3]).max(initial=0.0)),
    )


def cut_tracks(observations: Observations, starts: NDArray[np.bool_], first_id: int) -> IntArray:
    """Return landmark ids (K,) after tracks are cut before the observations that ``starts`` (K,) marks.

    New pieces are numbered from ``first_id``, by track and then by frame; the first piece of a track keeps its id.
    """
    order = np.lexsort((observations.frame, observations.landmark))
    ids, marked = observations.landmark[order], starts[order]
    first = np.diff(ids, prepend=-1) != 0
    # Number of the piece of an observation; unmarked beginnings are those of the tracks themselves.
    piece = first_id - 1 + np.cumsum(marked)
    begins = np.maximum.accumulate(np.where(first | marked, np.arange(len(ids)), 0))
    landmark = np.empty_like(ids)
    landmark[order] = np.where(marked[begins], piece, ids)
    return landmark


def repeated_frames(observations: Observations, twist: Array) -> IntArray:
    """Return ascending frames of a moving rig that repeat the previous frame's pixels in every common track.

    One common track is enough: a subpixel tracker does not return the same four numbers from another image. Velocities
    ``twist`` (T, 6) say whether the rig moves. In such a frame the tracker was restarted at the old pixels in the new
    image: they are right, but show other points than before, so no track leads across.
    """
    earlier, later = adjacent(observations)
    same = (observations.pixels_px[earlier] == observations.pixels_px[later]).all(axis=1)
    common = np.bincount(observations.frame[later], minlength=len(twist))
    repeated = np.bincount(observations.frame[later[same]], minlength=len(twist))
    moving = (np.linalg.norm(twist[:, :3], axis=1) > MOVING_M_S) | (np.linalg.norm(twist[:, 3:], axis=1) > MOVING_RAD_S)
    return np.flatnonzero((common > 0) & (repeated == common) & moving)


def adjacent(observations: Observations) -> tuple[IntArray, IntArray]:
    """Return the pairs of `successive` whose frames follow on each other."""
    earlier, later = successive(observations)
    follows = observations.frame[later] - observations.frame[earlier] == 1
    return earlier[follows], later[follows]


def successive(observations: Observations) -> tuple[IntArray, IntArray]:
    """Return index pairs (earlier, later) of successive observations of the same track."""
    order = np.lexsort((observations.frame, observations.landmark))
    same_track = np.diff(observations.landmark[order]) == 0
    return order[:-1][same_track], order[1:][same_track]
