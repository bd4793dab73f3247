"""What the engine returns of a frame: two flat arrays and counts, and their parts by name."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray

_RETIRED = ("id", "first_frame", "last_frame", "observations", "log_row", "misses")


class Gone(NamedTuple):
    """Landmarks (k) that retired: columns of their table by name, covariances (k, 3, 3), whether they may return."""

    columns: dict[str, Array | IntArray]
    covariance: Array
    may_return: bool


class Report(NamedTuple):
    """A frame in the engine; flat values and coordinates as in `Engine`, rows (k, d)."""

    retired: list[Gone]  # landmarks that retired, in the order in which they left
    reason: IntArray  # (n,) outcome of each observation
    nis: float  # nis, log_det, dof, doubt: of the accepted rows; factor of the inputs' standard deviations
    log_det: float
    dof: int
    doubt: float
    split: IntArray  # split, moving: ids of tracks that start again, and that were found to move
    moving: IntArray
    # Arguments of `ekfslam.filters.innovations.FrameInnovations`.
    innovations: tuple[IntArray, Array, Array, Array, Array]
    # landmark, previous, numbers: (k+j,), (k+j,), (k+j, 2d+3) of the log, see `ekfslam.filters.logbook.Accepted`: k
    # observations of known landmarks, then those of j new ones.
    landmark: IntArray
    previous: IntArray
    numbers: Array
    # linear, linear_coordinates, linear_twist: Values, coordinates, and velocity of the IMU of the linearisation.
    linear: Array
    linear_coordinates: Array
    linear_twist: Array
    updated: Array  # updated, updated_coordinates: after the correction, before new landmarks start
    updated_coordinates: Array
    begun: IntArray  # (j,) ids of new landmarks
    # step_before, before: Frame of the log, rows and variances of a first view that waited for this one; -1: none.
    step_before: int
    before: Array
    values: Array  # values, coordinates, imu_twist: at the end
    coordinates: Array
    imu_twist: Array


def _cut(flat: NDArray[Any], sizes: Iterable[int]) -> list[NDArray[Any]]:
    """Return parts of an array of the given sizes, from its beginning."""
    ends = list(accumulate(sizes, initial=0))
    return [flat[begin:end] for begin, end in pairwise(ends)]


def _gone(whole: IntArray, real: Array, count: int, may_return: bool) -> Gone:
    """Return the landmarks (k) at the beginning of both arrays."""
    columns: dict[str, Array | IntArray] = dict(zip(_RETIRED, whole[: 6 * count].reshape(6, count), strict=True))
    numbers = real[: 8 * count].reshape(count, 8)
    columns["position_m"], columns["initial_m"], columns["evidence"] = numbers[:, :3], numbers[:, 3:6], numbers[:, 6:]
    return Gone(columns, real[8 * count : 17 * count].reshape(count, 3, 3), may_return)


def retired(found: tuple[Any, ...] | None) -> Gone | None:
    """Return the landmarks that retired, of `Filter.rest`; None: there are none."""
    return None if found is None else _gone(*found[0], *found[1])


def report(found: tuple[Any, ...], values: int, body: int, dimension: int) -> Report:
    """Return what a frame did, of `Filter.update`, given the lengths of values, coordinates and rows."""
    (whole, real), (split, moving, begun, whitened, seen, taken), gone, step_before, nis, log_det, dof, doubt = found
    d, logged, waited = dimension, taken + begun, begun if step_before >= 0 else 0
    splits, movings, begun_ids, whitened_rows, reason, landmark, previous, whole = _cut(
        whole, (split, moving, begun, whitened, seen, logged, logged, len(whole))
    )
    sizes = [values] * 3 + [body] * 3 + [6, 6, logged * (2 * d + 3), waited * 2 * d, 6, 36, whitened * 2 * d, len(real)]
    flat, updated, linear, coordinates, updated_coordinates, linear_coordinates, *others = _cut(real, sizes)
    imu_twist, linear_twist, numbers, before, score, information, white, real = others
    white = white.reshape(whitened, 2 * d)
    first = [0, *accumulate(count for count, _ in gone)]
    return Report(
        [_gone(whole[6 * at :], real[17 * at :], *part) for at, part in zip(first, gone, strict=False)],
        reason,
        nis,
        log_det,
        dof,
        doubt,
        splits,
        movings,
        (whitened_rows, white[:, :d], white[:, d:], score, information.reshape(6, 6)),
        landmark,
        previous,
        numbers.reshape(logged, 2 * d + 3),
        linear,
        linear_coordinates,
        linear_twist,
        updated,
        updated_coordinates,
        begun_ids,
        step_before,
        before.reshape(waited, 2 * d),
        flat,
        coordinates,
        imu_twist,
    )
