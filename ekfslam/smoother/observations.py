"""Factors of the observations of landmarks, at any state or as the filter linearised them.

An observation whose track walks is a *difference* from the observation before, eq. (10): it touches two frames.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.log import Log
from ekfslam.geometry import se3
from ekfslam.models.model import Model
from ekfslam.models.observer import GIVEN, Moment, Seen
from ekfslam.smoother.sparse.factors import Factor, Term
from ekfslam.smoother.unknowns import State, Unknowns, split
from ekfslam.smoother.views import Observed, Sight, Views, views_of_frame

# Prior of a landmark about its initialisation: too weak to matter to a landmark with a depth.
LANDMARK_PRIOR_M = 1e4


class ObservationFactors:
    """Factors of a log that concern landmarks.

    Attributes:
        first_frame: (M,) frame of each landmark's first observation.
        first_position_m: (M, 3) its initialisation.
        prior_weight: Reciprocal of the standard deviation of a weak prior of landmarks there; 0: none.
    """

    def __init__(self, log: Log, model: Model, unknowns: Unknowns) -> None:
        self._log, self._model, self._unknowns = log, model, unknowns
        self._way_m = log.way_m
        self._is_difference = log.previous >= 0
        self._clone = model.layout.clones.get("pose", "pose")  # differences need the clone
        self._follows = np.flatnonzero(self._is_difference)
        self._previous = log.previous[self._follows]
        _, first = np.unique(log.landmark, return_index=True)
        self._is_first = np.zeros(log.observations, dtype=bool)
        self._is_first[first] = True
        self.first_frame = np.zeros(log.landmarks, dtype=np.int64)
        self.first_frame[log.landmark[first]] = log.frame[first]
        self.first_position_m = log.first_position_m
        # Differences of successive observations leave the disparity itself open: some tracks fit best at infinity.
        self.prior_weight = 0.0 if model.track_error is None else 1.0 / LANDMARK_PRIOR_M
        self._seen: tuple[State, Sight] | None = None

    # --- at a state ---------------------------------------------------------------------------------------------------

    @cached_property
    def batches(self) -> tuple[Observed, Observed]:
        """Single observations, and differences."""
        log, h, rows = self._log, views_of_frame(self._model.observer), self._log.rows.copy()
        rows[self._follows] -= log.rows[self._previous]
        found = []
        for which, before in ((np.flatnonzero(~self._is_difference), None), (self._follows, self._previous)):
            views = [h * log.frame[which]] if before is None else [h * log.frame[which] + h - 1, h * log.frame[before]]
            scale = 1.0 / np.sqrt(log.variance[which])
            found.append(Observed(which, tuple(views), log.landmark[which], rows[which], scale))
        return found[0], found[1]

    def at(self, state: State) -> Sight:
        """Return the observations as seen at a state; the last one is remembered."""
        if self._seen is None or self._seen[0] is not state:
            views = Views.of(self._model.observer, self._unknowns, self._moments(state))
            self._seen = state, Sight(views, self.batches, state.positions_m)
        return self._seen[1]

    def remember(self, state: State, sight: Sight) -> None:
        """Take a sight as that of a state."""
        self._seen = state, sight

    def factors(self, state: State) -> list[Factor]:
        """Return the factors linearised at a state."""
        sight, factors = self.at(state), []
        for kind, observed in enumerate(self.batches):
            if not len(observed.which):
                continue
            r, by_views = sight.residuals[kind], sight.by_views(kind)
            terms = [
                *(Term("views", view, J) for view, J in zip(observed.views, by_views, strict=True)),
                Term("drive", np.zeros(len(r), dtype=np.int64), sight.by_drive(kind, by_views)),
                Term("landmarks", observed.landmark, sight.by_landmark[kind]),
            ]
            factors.append(Factor(r, tuple(terms), observed.which))
        return [*factors, *self._near(state)]

    def _moments(self, state: State) -> Moment:
        """Return the moments of all frames."""
        log, model, T = self._log, self._model, state.T_imu_world
        twist = np.zeros((len(T), 6))
        if model.observer.has_time_offset:
            # The trajectory's own velocities: how they change with it is of second order.
            values = self._unknowns.all_values(state)
            before, after = ({name: x[at] for name, x in values.items()} for at in (slice(-1), slice(1, None)))
            twist = np.concatenate([log.seen_twist[:1], model.process.imu_twist(before, after, log.intervals)])
        shared = split(self._unknowns.shared, state.shared)
        return Moment(T, T, model.observer.parameters(state.drive_values), twist, shared, self._way_m)

    def first_cameras(self, views: Views) -> Array:
        """Return the cameras (M, 4, 4) that saw each landmark first."""
        return views.T_view_world[views_of_frame(self._model.observer) * self.first_frame]

    def _near(self, state: State) -> list[Factor]:
        """Return weak priors of landmarks if errors of tracks walk."""
        if not self.prior_weight:
            return []
        landmarks = np.arange(self._log.landmarks)
        J = np.broadcast_to(self.prior_weight * np.eye(3), (len(landmarks), 3, 3))
        r = self.prior_weight * (self.first_position_m - state.positions_m)
        return [Factor(r, (Term("landmarks", landmarks, J),))]

    def _whitened(self, H_x: Array, H_m: Array, r: Array) -> list[Factor]:
        """Return the factors of single observations and of differences, from Jacobians and residuals (K, d, ...)."""
        log, u, scale = self._log, self._unknowns, 1.0 / np.sqrt(self._log.variance)
        observed, factors = u.drive_columns < H_x.shape[-1], []
        for is_difference in (False, True):
            which = np.flatnonzero(self._is_difference == is_difference)
            if not len(which):
                continue
            H, wide, n = H_x[which], scale[which][..., None], len(which)
            J_drive = np.zeros((*H.shape[:2], len(observed)))
            J_drive[..., observed] = wide * H[..., u.drive_columns[observed]]
            terms = [
                Term("frames", log.frame[which], wide * H[..., u.frame_columns]),
                Term("drive", np.zeros(n, dtype=np.int64), J_drive),
                Term("landmarks", log.landmark[which], wide * H_m[which]),
            ]
            if is_difference:
                J_before = np.zeros((*H.shape[:2], u.width))
                J_before[..., u.cloned] = wide * H[..., u.clone_columns]
                terms.append(Term("frames", log.frame[which] - 1, J_before))
            factors.append(Factor(scale[which] * r[which], tuple(terms), which))
        return factors

    # --- as filtered --------------------------------------------------------------------------------------------------

    def frozen(self) -> list[Factor]:
        """Return the factors where the filter linearised them; residuals count from the coordinates of the log."""
        log, first, layout = self._log, self._is_first, self._model.layout
        position, first_position = log.position_m, log.first_position_m[log.landmark]
        linear_position = first_position if log.first_estimates else position
        # A new landmark is initialised after the update of its frame; all others are linearised before it.
        T = np.where(first[:, None, None], log.T_updated[log.frame], log.T_linear[log.frame])
        x = np.where(first[:, None], log.updated[log.frame], log.linear[log.frame])
        T_linear = T
        if log.first_estimates:
            T_linear = np.where(first[:, None, None], T, log.T_predicted[log.frame])
        group = 2 * log.frame + first
        seen = self._see(group, log.frame, T, T_linear, x, position, linear_position, "pose", self._is_difference)
        H_x, H_m = seen.H_x, seen.H_m
        if log.first_estimates:
            # A new landmark follows the predicted pose.
            frame, place = log.frame[first], first_position[first]
            there = self._see(group[first], frame, T[first], log.T_predicted[frame], x[first], place, place)
            H_x[first, :, layout["pose"]] = H_m[first] @ np.linalg.solve(there.H_m, there.H_x[..., layout["pose"]])
        H_x = _carried_back(H_x, layout["pose"], log.T_linear, log.T_predicted, log.frame, ~first)
        r = log.rows - seen.z + (H_x @ (x - log.departed[0])[:, : layout.seen, None])[..., 0]
        if len(self._follows):
            self._subtract_frozen_before(H_x, H_m, r, x, linear_position)
        r += (H_m @ (position - first_position)[..., None])[..., 0]
        return self._whitened(H_x, H_m, r)

    def _subtract_frozen_before(self, H_x: Array, H_m: Array, r: Array, x: Array, linear_position: Array) -> None:
        """Turn observations into differences, in place: the same landmarks from the clones of the frames before."""
        log, follows, layout = self._log, self._follows, self._model.layout
        frame = log.frame[follows]
        T = log.T_linear_before[frame]
        T_linear = log.T_predicted[frame - 1] if log.first_estimates else T
        positions = log.position_m[follows], linear_position[follows]
        before = self._see(frame, frame, T, T_linear, x[follows], *positions, self._clone)
        B_x = _carried_back(before.H_x, layout[self._clone], log.T_linear_before, log.T_departed, frame)
        shifted = (B_x @ (x[follows] - log.departed[0])[:, : layout.seen, None])[..., 0]
        r[follows] -= log.rows[log.previous[follows]] - before.z + shifted
        H_x[follows] -= B_x
        H_m[follows] -= before.H_m

    def _see(
        self,
        group: IntArray,
        frame: IntArray,
        T: Array,
        T_linear: Array,
        coordinates: Array,
        positions_m: Array,
        linear_positions_m: Array,
        pose: str = "pose",
        is_difference: BoolArray | None = None,
    ) -> Seen:
        """Return landmarks (n, 3) as observed in frames (n,) from poses (n, 4, 4), given coordinates (n, body).

        Coordinates of the drive's blocks are equal within a group (n,).
        """
        model, calibration, layout = self._model, self._model.observer.calibration, self._model.layout
        twist, way_m = self._log.seen_twist[frame - (pose != "pose")], self._way_m[frame]
        clones = layout.clones if pose == layout.clones.get("pose") else {}
        shared = {
            block.name: coordinates[:, layout[clones.get(block.name, block.name)]] for block in model.observer.shared
        }
        moment = Moment(T, T_linear, GIVEN, twist, shared, way_m)
        if calibration is None:
            return model.observer.see(moment, positions_m, linear_positions_m, pose, is_difference)
        parts, order = [], np.argsort(group, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            found = calibration.retract(calibration.initial(), coordinates[some[0], layout[calibration.name]])
            here = replace(moment.at(some), calibration=found)
            differs = None if is_difference is None else is_difference[some]
            parts.append(model.observer.see(here, positions_m[some], linear_positions_m[some], pose, differs))
        back = np.argsort(order, kind="stable")
        return Seen(*(np.concatenate([getattr(part, field.name) for part in parts])[back] for field in fields(Seen)))


def _carried_back(
    H_x: Array, at: slice, T_linear: Array, T_reference: Array, frame: IntArray, which: BoolArray | bool = True
) -> Array:
    """Return rows of iterated updates in the coordinates before the update, by the chain rule."""
    shift = se3.log(T_linear @ se3.inverse(T_reference))
    moved = np.any(np.abs(shift) > 1e-12, axis=1)[frame] & which
    if moved.any():
        H_x[moved, :, at] = H_x[moved, :, at] @ se3.left_jacobian(shift[frame[moved]])
    return H_x
