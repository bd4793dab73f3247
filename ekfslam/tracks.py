"""Track hygiene: what a recording's tracks look like before any filter trusts them, and what is done about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.se3 import Array
from ekfslam.sequence import IntArray, Observations

# Sensors of a rig that stands still read less than this; turning faster moves the pixels by more than one a frame.
MOVING_M_S = 0.1
MOVING_RAD_S = 0.02


@dataclass(frozen=True)
class TrackReport:
    """What `inspect_tracks` found.

    Args:
        tracks: Number of distinct landmark ids.
        observations_per_frame: (T,) number of observations.
        repeated_frames: Ascending frames whose pixels all repeat the previous frame's (see `repeated_frames`).
        returning_tracks: Number of tracks that come back after frames that did not see them.
        nonpositive_disparities: Number of observations with ``uL - uR <= 0``, which have no depth.
        max_row_mismatch_px: Largest ``|vL - vR|``; 0 for an ideally rectified pair.
    """

    tracks: int
    observations_per_frame: IntArray
    repeated_frames: IntArray
    returning_tracks: int
    nonpositive_disparities: int
    max_row_mismatch_px: float

    @property
    def notes(self) -> tuple[str, ...]:
        """The findings, one sentence each."""
        frames, observations = len(self.observations_per_frame), int(self.observations_per_frame.sum())
        blind = int((self.observations_per_frame == 0).sum())
        return (
            f"{self.tracks} tracks, {observations} observations, {observations / frames:.1f} a frame; "
            f"{blind} of {frames} frames see nothing.",
            f"{len(self.repeated_frames)} of {frames} frames repeat the previous frame's pixels in every common track "
            "although the rig moves.",
            f"{self.returning_tracks} tracks come back after a gap.",
            f"{self.nonpositive_disparities} of {observations} observations have a disparity <= 0.",
            f"|vL - vR| is at most {self.max_row_mismatch_px:.2f} px.",
        )


def inspect_tracks(observations: Observations, twist: Array) -> TrackReport:
    """Report on the tracks of a recording with velocities ``twist`` (T, 6) in m/s and rad/s, one for every frame."""
    earlier, later = _successive(observations)
    gap = observations.frame[later] - observations.frame[earlier] > 1
    pixels = observations.pixels_px
    return TrackReport(
        tracks=len(observations.ids),
        observations_per_frame=np.bincount(observations.frame, minlength=len(twist)),
        repeated_frames=repeated_frames(observations, twist),
        returning_tracks=len(np.unique(observations.landmark[later[gap]])),
        nonpositive_disparities=int((pixels[:, 0] <= pixels[:, 2]).sum()),
        max_row_mismatch_px=float(np.abs(pixels[:, 1] - pixels[:, 3]).max(initial=0.0)),
    )


@dataclass(frozen=True)
class Restarts:
    """Tracks that were cut in two at repeated frames.

    Args:
        frame: (n,) first frame of the new piece.
        old, new: (n,) id of the track up to there, and of its continuation.
    """

    frame: IntArray
    old: IntArray
    new: IntArray


def restart_at_repeated_frames(observations: Observations, twist: Array) -> tuple[Observations, Restarts]:
    """Cut every track where a frame repeats the pixels of the one before: the rest gets an id of its own.

    In such a frame the tracker has been restarted at the old pixels in the new image. The pixels are right for the
    frame that they stand in (they predict the next one as well as any), but show other points than before: no track
    leads across. Ids of new pieces count on from the largest.
    """
    frames = repeated_frames(observations, twist)
    # Which piece of its track an observation belongs to: how many repeated frames lie at or before it, from the first.
    piece = np.searchsorted(frames, observations.frame, side="right")
    order = np.lexsort((observations.frame, observations.landmark))
    ids, piece = observations.landmark[order], piece[order]
    starts = np.flatnonzero((np.diff(ids) == 0) & (np.diff(piece) > 0)) + 1
    new = int(observations.landmark.max(initial=-1)) + 1 + np.arange(len(starts))
    # Everything from a start to the next one, or to the end of the track, takes the new id.
    ends = np.searchsorted(ids, ids[starts], side="right")
    ends = np.minimum(ends, np.append(starts[1:], len(ids)))
    landmark = ids.copy()
    landmark[np.repeat(starts, ends - starts) + _counts(ends - starts)] = np.repeat(new, ends - starts)
    restored = np.empty_like(landmark)
    restored[order] = landmark
    return (
        Observations(observations.frame, restored, observations.pixels_px),
        Restarts(observations.frame[order][starts], ids[starts], new),
    )


def _counts(lengths: IntArray) -> IntArray:
    """``0, ..., n-1`` for every length n, one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def repeated_frames(observations: Observations, twist: Array) -> IntArray:
    """Ascending frames that show the previous frame's pixels again, bit for bit in every common track, while moving.

    One common track is enough: a subpixel tracker does not return the same four numbers from another image, and in the
    recordings no frame repeats some tracks but not others. ``twist[k]`` (T, 6) m/s and rad/s, which drives the interval
    before frame k, tells whether the rig moves; standing still, pixels may well repeat.
    """
    earlier, later = _successive(observations)
    adjacent = observations.frame[later] - observations.frame[earlier] == 1
    earlier, later = earlier[adjacent], later[adjacent]
    same = (observations.pixels_px[earlier] == observations.pixels_px[later]).all(axis=1)
    common = np.bincount(observations.frame[later], minlength=len(twist))
    repeated = np.bincount(observations.frame[later[same]], minlength=len(twist))
    moving = (np.linalg.norm(twist[:, :3], axis=1) > MOVING_M_S) | (np.linalg.norm(twist[:, 3:], axis=1) > MOVING_RAD_S)
    return np.flatnonzero((common > 0) & (repeated == common) & moving)


def _successive(observations: Observations) -> tuple[IntArray, IntArray]:
    """Index pairs (earlier, later) of observations that follow each other in the same track."""
    order = np.lexsort((observations.frame, observations.landmark))
    same_track = np.diff(observations.landmark[order]) == 0
    return order[:-1][same_track], order[1:][same_track]
