"""Dense arrays of tracks, a pixel row for every frame and track, made flat."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Observations, require_finite
from ekfslam.errors import EmptyTracksError, NonFiniteError, ShapeError

UNSEEN = -1.0  # what the dense formats write into all four pixels of a track that a frame does not see; or NaN


def flat_observations(dense: Array, frame_axis: int, field: str) -> tuple[Observations, tuple[str, ...]]:
    """Observations of a dense 4 x T x M (``frame_axis`` 1) or 4 x M x T (2) array of pixels; the column is the id.

    A frame does not see a track where all four pixels are -1 or NaN. Where only the right two are, there is no depth:
    the observation is left out.

    Returns:
        The observations, and a sentence on tracks that no frame sees and on observations without right pixels.

    Raises:
        ShapeError: Some of the four pixels are missing otherwise.
        NonFiniteError: A pixel is infinite, or some of the four are NaN otherwise.
        EmptyTracksError: No track is ever seen.
    """
    missing = (dense == UNSEEN) | np.isnan(dense)
    seen = ~missing.any(axis=0)
    only_left = missing[2:].all(axis=0) & ~missing[:2].any(axis=0)
    _require_whole(dense, missing, seen | only_left | missing.all(axis=0), field)
    require_finite(np.where(missing, 0.0, dense), field)
    never = np.flatnonzero(~(seen | only_left).any(axis=frame_axis - 1))
    if dense.shape[3 - frame_axis] and not seen.any():
        raise EmptyTracksError(f"{len(never)} tracks are never seen, which is all of them", field=field, index=0)
    notes = []
    if len(never):
        notes.append(f"{len(never)} of {dense.shape[3 - frame_axis]} tracks are never seen and are left out.")
    if only_left.any():
        notes.append(f"{int(only_left.sum())} observations have no right pixels and are left out.")
    first, second = np.nonzero(seen)
    frame, landmark = (first, second) if frame_axis == 1 else (second, first)
    return Observations(frame, landmark, dense[:, first, second].T), tuple(notes)


def _require_whole(dense: Array, missing: BoolArray, is_known: BoolArray, field: str) -> None:
    partly = np.argwhere(~is_known)
    if not len(partly):
        return
    position = tuple(int(i) for i in partly[0])
    pixels = dense[:, position[0], position[1]]
    row = int(np.argmax(missing[:, position[0], position[1]]))
    if np.isnan(pixels[row]):
        raise NonFiniteError(
            f"{len(partly)} observations are NaN in some of their pixels", field=field, index=(row, *position)
        )
    raise ShapeError(
        f"{len(partly)} observations have some but not all of their four pixels equal to -1 (unseen)",
        field=field,
        index=(row, *position),
    )
