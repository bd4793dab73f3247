"""What the engine returns of a frame: two flat arrays and counts, and their parts by name."""

from __future__ import annotations

from typing import Any, NamedTuple

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


class _Parts:
    """Reads arrays of whole and of real numbers from their beginning."""

    def __init__(self, arrays: tuple[IntArray, Array]) -> None:
        self._whole, self._real = arrays
        self._whole_at = self._real_at = 0

    def whole(self, count: int) -> IntArray:
        begin = self._whole_at
        self._whole_at = end = begin + count
        return self._whole[begin:end]

    def real(self, count: int) -> Array:
        begin = self._real_at
        self._real_at = end = begin + count
        return self._real[begin:end]

    def rows(self, count: int, width: int) -> Array:
        return self.real(count * width).reshape(count, width)

    def gone(self, count: int, may_return: bool) -> Gone:
        columns: dict[str, Array | IntArray] = dict(zip(_RETIRED, self.whole(6 * count).reshape(6, count), strict=True))
        numbers = self.rows(count, 8)
        columns["position_m"], columns["initial_m"], columns["evidence"] = (
            numbers[:, :3],
            numbers[:, 3:6],
            numbers[:, 6:],
        )
        return Gone(columns, self.real(9 * count).reshape(count, 3, 3), may_return)


def retired(found: tuple[Any, ...] | None) -> Gone | None:
    """Return the landmarks that retired, of `Filter.rest`; None: there are none."""
    return None if found is None else _Parts(found[0]).gone(*found[1])


def report(found: tuple[Any, ...], values: int, body: int, dimension: int) -> Report:
    """Return what a frame did, of `Filter.update`, given the lengths of values, coordinates and rows."""
    arrays, (split, moving, begun, whitened, seen, taken), gone, step_before, nis, log_det, dof, doubt = found
    parts, d = _Parts(arrays), dimension
    whole, real, logged = parts.whole, parts.real, taken + begun
    split, moving, begun_ids, whitened_rows, reason = (
        whole(split),
        whole(moving),
        whole(begun),
        whole(whitened),
        whole(seen),
    )
    landmark, previous = whole(logged), whole(logged)
    flat, updated, linear = real(values), real(values), real(values)
    coordinates, updated_coordinates, linear_coordinates = real(body), real(body), real(body)
    imu_twist, linear_twist, numbers = real(6), real(6), parts.rows(logged, 2 * d + 3)
    before = parts.rows(begun if step_before >= 0 else 0, 2 * d)
    score, information, white = real(6), parts.rows(6, 6), parts.rows(whitened, 2 * d)
    return Report(
        [parts.gone(*part) for part in gone],
        reason,
        nis,
        log_det,
        dof,
        doubt,
        split,
        moving,
        (whitened_rows, white[:, :d], white[:, d:], score, information),
        landmark,
        previous,
        numbers,
        linear,
        linear_coordinates,
        linear_twist,
        updated,
        updated_coordinates,
        begun_ids,
        step_before,
        before,
        flat,
        coordinates,
        imu_twist,
    )
