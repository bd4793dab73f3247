"""Factors of observations, at any state or as filtered; a difference, eq. (10), touches two frames."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.log import Log
from ekfslam.geometry import se3
from ekfslam.models.blocks import PreviousView, View
from ekfslam.models.model import Model
from ekfslam.models.observation import landmark_by_pose
from ekfslam.models.observer import GIVEN, Camera, Moment, Projected
from ekfslam.smoother.sparse.factors import Factor, Term, concatenated
from ekfslam.smoother.unknowns import State, Unknowns, split
from ekfslam.smoother.views import Observed, Sight, Views, views_of_frame

# Prior of a landmark about its initialisation: too weak to matter to a landmark with a depth.
LANDMARK_PRIOR_M = 1e4
_AT_ONCE = 20_000  # observations that are linearised as filtered: those of a long drive would take gigabytes


class ObservationFactors:
    """Factors of a log that concern landmarks, first seen in ``first_frame`` (M,) at ``first_position_m``.

    A weak prior of landmarks there has the standard deviation 1 / ``prior_weight``; 0: none.
    """

    def __init__(self, log: Log, model: Model, unknowns: Unknowns) -> None:
        self._log, self._model, self._unknowns = log, model, unknowns
        self._way_m = log.way_m
        self._is_difference = log.previous >= 0
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

    def forget(self) -> None:
        """Forget the last sight, which takes more memory than all else kept."""
        self._seen = None

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

    def views(self, state: State) -> tuple[Array, Array]:
        """Return the cameras ``T_cam_world`` (T, 4, 4) at a state, and their derivatives (T, 6, seen)."""
        moments = self._moments(state)
        camera = self._model.observer.camera(moments)
        return camera.T_cam_imu @ moments.T_imu_world, camera.by

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

    # --- as filtered --------------------------------------------------------------------------------------------------

    @cached_property
    def _by_coordinates(self) -> dict[str, Camera]:
        """The cameras (2, T) of single observations and of differences at coordinates of the log, by their name."""
        return {name: self._cameras(getattr(self._log, name)) for name in ("departed", "linear", "updated")}

    @property
    def frozen_views(self) -> Camera:
        """The cameras (T) of single observations where the filter predicted them."""
        return self._by_coordinates["departed"].at(0)

    def frozen(self) -> list[Factor]:
        """Return the factors where the filter linearised them; residuals count from the coordinates of the log."""
        parts: tuple[list[Factor], list[Factor]] = [], []
        for begin in range(0, self._log.observations, _AT_ONCE):
            some = np.arange(begin, min(begin + _AT_ONCE, self._log.observations))
            for part, factor in zip(parts, self._frozen(some), strict=True):
                part += factor
        return [concatenated(part) for part in parts if part]

    def _frozen(self, some: IntArray) -> tuple[list[Factor], list[Factor]]:
        """Return the factors of some successive observations (n,): single ones, and differences, if there are any."""
        log, layout, first = self._log, self._model.layout, self._is_first[some]
        k, position, first_position = log.frame[some], log.position_m[some], log.first_position_m[log.landmark[some]]
        linear_position = first_position if log.first_estimates else position
        # A new landmark is initialised after the update of its frame; all others are linearised before it.
        at = self._is_difference[some].astype(np.int64), k
        of = self._by_coordinates
        updated, predicted = of["updated"].at(0).at(k), of["departed"].at(*at)
        T_cam_imu = np.where(first[:, None, None], updated.T_cam_imu, of["linear"].at(*at).T_cam_imu)
        W = T_cam_imu @ np.where(first[:, None, None], log.T_updated[k], log.T_linear[k])
        W_first, by = predicted.T_cam_imu @ log.T_predicted[k], predicted.by
        by = _carried_back(W, W_first, ~first) @ by
        if View.name not in layout:  # nothing remembers the prediction
            by[first], W_first[first] = updated.by[first], (updated.T_cam_imu @ log.T_predicted[k])[first]
        W_linear = np.where(first[:, None, None], W, T_cam_imu @ log.T_predicted[k]) if log.first_estimates else W
        x = np.where(first[:, None], log.updated[k], log.linear[k])
        seen = self._projected(2 * k + first, x, W, position, W_linear, linear_position)
        if log.first_estimates:  # a new landmark follows the predicted camera
            seen.H_z[first] = -seen.H_m[first] @ landmark_by_pose(W_first[first], first_position[first])
        H_x, H_m = self._model.observer.by_body(seen, by), seen.H_m
        r = log.rows[some] - seen.z + (H_x @ (x - log.departed[0])[:, : layout.seen, None])[..., 0]
        shift = (position - first_position)[..., None]
        found: tuple[list[Factor], list[Factor]] = [], []
        single, follows = np.flatnonzero(at[0] == 0), np.flatnonzero(at[0])
        if len(follows):
            H_before, H_m_before, r_before = self._frozen_before(some[follows], x[follows], linear_position[follows])
            H_m[follows] -= H_m_before
            r[follows] -= r_before
        r += (H_m @ shift)[..., 0]
        for kind, which, H in ((0, single, None), (1, follows, H_before if len(follows) else None)):
            if len(which):
                found[kind].append(self._whitened(some[which], H_x[which], H, H_m[which], r[which]))
        return found

    def _whitened(self, which: IntArray, H_x: Array, H_before: Array | None, H_m: Array, r: Array) -> Factor:
        """Return the factor of single observations (n,), or of differences with ``H_before`` by the frame before."""
        log, u, scale = self._log, self._unknowns, 1.0 / np.sqrt(self._log.variance[which])
        observed, wide = u.drive_columns < H_x.shape[-1], scale[..., None]
        drive = u.drive_columns[observed]
        J_drive = np.zeros((*H_x.shape[:2], len(observed)))
        J_drive[..., observed] = wide * (
            H_x[..., drive] if H_before is None else H_x[..., drive] - H_before[..., drive]
        )
        terms = [
            Term("frames", log.frame[which], wide * H_x[..., u.frame_columns]),
            Term("drive", np.zeros(len(which), dtype=np.int64), J_drive),
            Term("landmarks", log.landmark[which], wide * H_m),
        ]
        if H_before is not None:
            terms.append(Term("frames", log.frame[which] - 1, -wide * H_before[..., u.frame_columns]))
        return Factor(scale * r, tuple(terms), which)

    def _frozen_before(self, follows: IntArray, x: Array, linear_position: Array) -> tuple[Array, Array, Array]:
        """Return ``H_x`` (j, d, seen), ``H_m`` (j, d, 3) and r (j, d) of the observations before differences (j,)."""
        log, layout, observer = self._log, self._model.layout, self._model.observer
        k, view, start = log.frame[follows], layout[PreviousView.name], log.departed[0]
        predicted, updated = self.frozen_views.at(k - 1), self._by_coordinates["updated"].at(0).at(k - 1)
        W, W_updated = (updated.T_cam_imu @ T for T in (log.T_linear_before[k], log.T_updated[k - 1]))
        z_updated = (predicted.by @ log.updated[k - 1, : layout.seen, None])[..., 0]
        if log.has_views:
            z, W_predicted = x[:, view], se3.exp(log.departed[k, view] - z_updated) @ W_updated
        else:
            z, W_predicted = z_updated + se3.log(W @ se3.inverse(W_updated)), updated.T_cam_imu @ log.T_departed[k]
        D = _carried_back(W, W_predicted)
        W_linear = predicted.T_cam_imu @ log.T_predicted[k - 1] if log.first_estimates else W
        before = self._projected(k, x, W, log.position_m[follows], W_linear, linear_position)
        z -= (predicted.by @ start[: layout.seen, None])[..., 0]
        shifted = (before.H_z @ D @ z[..., None])[..., 0]
        shifted += (before.H_i @ (x - start)[:, observer.intrinsic, None])[..., 0]
        r = log.rows[log.previous[follows]] - before.z + shifted
        return observer.by_body(before, D @ predicted.by), before.H_m, r

    def _cameras(self, coordinates: Array) -> Camera:
        """Return the cameras (2, T) of single observations and of differences, given the coordinates (T, body)."""
        log, model, layout = self._log, self._model, self._model.layout
        shared = {block.name: coordinates[:, layout[block.name]] for block in model.observer.shared}
        moments = Moment(log.T_predicted, log.T_predicted, GIVEN, log.seen_twist, shared, self._way_m)
        if model.observer.calibration is None:
            return model.observer.cameras(moments)
        found = [
            model.observer.cameras(replace(moments.at(k), calibration=self._parameters(coordinates[k])))
            for k in range(log.frames)
        ]
        T_cam_imu, by = (np.stack([getattr(camera, name) for camera in found], 1) for name in ("T_cam_imu", "by"))
        return Camera(T_cam_imu, by)

    def _parameters(self, coordinates: Array) -> Array:
        """Return the calibration parameters (9,) at coordinates (body,)."""
        calibration = self._model.observer.calibration
        if calibration is None:
            return GIVEN
        return calibration.retract(calibration.initial(), coordinates[self._model.layout[calibration.name]])

    def _projected(
        self,
        group: IntArray,
        coordinates: Array,
        T_cam_world: Array,
        positions_m: Array,
        T_linear: Array,
        linear_positions_m: Array,
    ) -> Projected:
        """Return landmarks (n, 3) as cameras (n, 4, 4) see them, given coordinates (n, body), equal in a group (n,)."""
        if self._model.observer.calibration is None:
            return self._model.observer.project(GIVEN, T_cam_world, positions_m, T_linear, linear_positions_m)
        parts, order = [], np.argsort(group, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            arrays = (array[some] for array in (T_cam_world, positions_m, T_linear, linear_positions_m))
            parts.append(self._model.observer.project(self._parameters(coordinates[some[0]]), *arrays))
        back = np.argsort(order, kind="stable")
        return Projected(
            *(np.concatenate([getattr(part, field.name) for part in parts])[back] for field in fields(Projected))
        )


def _carried_back(T_linear: Array, T_reference: Array, which: BoolArray | bool = True) -> Array:
    """Return the derivatives D (n, 6, 6) that carry rows at cameras (n, 4, 4) of iterated updates back, or I."""
    shift = se3.log(T_linear @ se3.inverse(T_reference))
    moved = np.any(np.abs(shift) > 1e-12, axis=1) & which
    D = np.broadcast_to(np.eye(6), (len(shift), 6, 6)).copy()
    D[moved] = se3.left_jacobian(shift[moved])
    return D
