"""Stretches of velocities and poses that were never measured: a unit (OXTS) had a gap and drew a line across it."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.geometry.se3 import so3_log

SHORTEST = 3  # samples in a row that lie on the line between their neighbours; a single lost packet does no harm
INTERPOLATED = "interpolated"
_BEND = 2e-3  # of the median bend between true motions; measured ones bend by more than 0.01 of it
_ROUNDING = 1e-9  # of the largest value; measured velocities bend by more than 1e-4 of it


def interpolated_intervals(twist: Array) -> BoolArray:
    """Return which intervals (T,) have interpolated velocities; ``[k]`` leads from frame k-1 to frame k.

    All six velocities of (T, 6) must have second differences of 0, to rounding, at `SHORTEST` samples in a row, and
    must change: nothing is interpolated at rest or at constant velocity. A line that was rounded to few digits, or had
    noise added, is not recognised.
    """
    found = np.zeros(len(twist), dtype=bool)
    if len(twist) < SHORTEST + 2:
        return found
    largest = np.repeat([np.abs(twist[:, :3]).max(), np.abs(twist[:, 3:]).max()], 3)
    is_straight = (np.abs(np.diff(twist, 2, axis=0)) <= _ROUNDING * largest).all(axis=1)
    changes = np.asarray((np.abs(np.diff(twist, axis=0)) > _ROUNDING * largest).any(axis=1))
    on_line = np.concatenate([[False], is_straight & changes[1:] & changes[:-1], [False]])
    for begin, end in stretches(on_line):
        if end - begin + 1 >= SHORTEST:
            found[begin : end + 2] = True  # up to the measured sample behind
    return found


def interpolated_poses(T_world_imu: Array) -> BoolArray:
    """Return which intervals (n,) between poses (n, 4, 4) are interpolated; ``[k]`` leads from pose k-1 to pose k.

    Jitter of stamps hides a line between two poses, but successive motions along it have one direction, to rounding, in
    position and rotation. Nothing is interpolated at rest, or on straight lines whose motions hardly ever bend.
    """
    found = np.zeros(len(T_world_imu), dtype=bool)
    if len(found) < SHORTEST + 2:
        return found
    R = T_world_imu[:, :3, :3]
    moves = np.diff(T_world_imu[:, :3, 3], axis=0), so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    on_line = np.ones(len(found) - 2, dtype=bool)
    for move in moves:
        before, after = move[:-1], move[1:]
        square = (before**2).sum(axis=1, keepdims=True)
        along = (before * after).sum(axis=1, keepdims=True) / np.where(square > 0, square, 1.0)
        bend = np.linalg.norm(after - along * before, axis=1)
        on_line &= (square[:, 0] > 0) & (bend < _BEND * np.median(bend))
    for begin, end in stretches(on_line):
        if end - begin + 1 >= SHORTEST:
            found[begin + 1 : end + 3] = True
    return found


def stretches(which: BoolArray) -> list[tuple[int, int]]:
    """Return first and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    return [(int(begin), int(end) - 1) for begin, end in edges.reshape(-1, 2)]


def interpolation_attributes(twist: Array) -> dict[str, str]:
    """Return interpolated intervals as the attribute ``interpolated``, such as ``1-12 178-182``; empty if none."""
    return _attributes(interpolated_intervals(twist))


def attributes_of_part(
    attributes: Mapping[str, str | int | float], is_interpolated: BoolArray
) -> dict[str, str | int | float]:
    """Return attributes for a part of a recording, given which of its intervals (T,) are interpolated."""
    others = {name: value for name, value in attributes.items() if name != INTERPOLATED}
    return {**others, **_attributes(is_interpolated)}


def stretches_text(which: BoolArray) -> str:
    """Return every run of True as text, such as ``1-12 178-182``."""
    return " ".join(f"{begin}-{end}" for begin, end in stretches(which))


def stretches_of(text: str, length: int) -> BoolArray | None:
    """Return the mask (length,) of a text of `stretches_text`; None if it is none."""
    if not re.fullmatch(r"\d+-\d+( \d+-\d+)*", text):
        return None
    found = np.zeros(length, dtype=bool)
    for begin, end in (map(int, stretch.split("-")) for stretch in text.split()):
        found[begin : end + 1] = True
    return found


def _attributes(is_interpolated: BoolArray) -> dict[str, str]:
    found = stretches_text(is_interpolated)
    return {INTERPOLATED: found} if found else {}


def known_intervals(attributes: Mapping[str, str | int | float], twist: Array) -> BoolArray:
    """Return interpolated intervals (T,) of a recording, by its attributes or else by its velocities."""
    found = stretches_of(str(attributes.get(INTERPOLATED, "")), len(twist))
    return interpolated_intervals(twist) if found is None else found


def interpolation_notes(twist: Array) -> tuple[str, ...]:
    """Return one sentence for each stretch of interpolated velocities."""
    rest = "are interpolated, and so probably are true poses there: no NEES is taken of them."
    spans = stretches(interpolated_intervals(twist))
    return tuple(f"The velocities of intervals {begin} to {end} {rest}" for begin, end in spans)
