"""Agreement of the fields of a result that are each valid alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ekfslam.errors import ArchiveError
from ekfslam.filters.log import Log


def require_agreement(result: Mapping[str, Any], place: str) -> None:
    """Raise an `ArchiveError` if fields of a stored result contradict each other.

    Args:
        result: Stored fields of a `Result`, each valid alone.
        place: File and group, for the message.
    """
    pairs, log = result["pairs"], result["log"]
    if pairs is not None and not (pairs.first < pairs.second).all():
        raise ArchiveError(f"{place}/pairs holds frames that are no pair")
    if log is not None:
        _require_log(log, len(result["landmarks"]), f"{place}/log")


def _require_log(log: Log, landmarks: int, place: str) -> None:
    if log.landmarks != landmarks:
        raise ArchiveError(f"{place}/landmark_id has {log.landmarks} entries, but the map has {landmarks} landmarks")
    if (columns := log.curved.shape[1]) not in (0, 3):  # those of the block `up`, if it was in the state
        raise ArchiveError(f"{place}/curved has {columns} columns, expected 0 or 3")
    if len(np.unique(log.landmark)) < log.landmarks:
        unseen = np.setdiff1d(np.arange(log.landmarks), log.landmark)[0]
        raise ArchiveError(f"{place}/landmark_id[{unseen}] has no observation")
    follows = np.flatnonzero(log.previous >= 0)
    before = log.previous[follows]
    wrong = (log.landmark[before] != log.landmark[follows]) | (log.frame[before] != log.frame[follows] - 1)
    if wrong.any():
        raise ArchiveError(
            f"{place}/previous[{follows[np.argmax(wrong)]}] is no observation of the same landmark in the frame before"
        )
