"""Results of a run: trajectory, map, innovation statistics and bookkeeping of one mode on one sequence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass, field, fields, replace
from pkgutil import resolve_name
from types import MethodType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.data.hygiene import HygieneReport
from ekfslam.data.noise import Noise
from ekfslam.errors import NoInertialError, NonFiniteResultError, ShapeError
from ekfslam.filters.inertial_states import InertialStates, in_words, velocity_world
from ekfslam.filters.log import Log
from ekfslam.geometry.camera import StereoCamera
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.shown import Card, Shown, figure
from ekfslam.stored import (
    ASCENDING,
    COUNTS,
    COVARIANCES,
    FRAMES,
    NOT_NEGATIVE,
    NUMBERS_OR_NONE,
    RIGID,
    along,
    attribute,
    group,
    index_of,
    stored,
    values_of,
)

ERROR_CONVENTION = (
    "T_imu_world = exp(xi^) T_hat, xi = [rho; theta] translation first; landmark m = m_hat + d in world; "
    "covariances are of xi and d"
)

# Reasons for rejecting an observation; `Rejections.reason` is an index. Archives hold the index, so "row mismatch" has
# its place still, although `ekfslam.data.hygiene` looks for it today.
REASONS: tuple[str, ...] = ("gate", "disparity", "row mismatch", "behind camera", "moving", "waiting")

_POSE_COVARIANCE = "m^2, m rad, rad^2 (rho 0-2, theta 3-5)"
_PARAMETER_UNITS = "see attribute unit of the group"

# Pixel noise below which a linearised update gains more information than it should. In both built-in worlds the pose
# NEES is the same from 0.7 to 0.1 px, twice as large at 0.03 px, ten times at 0.01 px.
LINEAR_FROM_PX = 0.1
_LAST_STD = "std of last position, heading"
# Attribute with the doubts about a recording and a run, see `ekfslam.evaluation.sanity`.
SANITY, SANITY_SEPARATOR = "sanity", " | "
UNUSED = "unused_inputs"  # attribute: why inputs of the recording are not used
# Attributes of a trajectory of another program: its file, frames without a pose of their own, whether it knows the
# vertical; see `ekfslam.others`.
OTHER, OTHER_MISSING, OTHER_LEVEL = "other", "other_missing", "other_level"


@dataclass(frozen=True)
class Landmarks:
    """Every landmark that a run has estimated (mode full: in the order of landmark initialisation, as in the log).

    Args:
        id: (M,) landmark id; an id occurs again if a retired landmark was initialised again.
        position_m: (M, 3) last estimate in world.
        covariance: (M, 3, 3) of the position error d, m^2.
        initial_position_m: (M, 3) triangulation at landmark initialisation.
        first_frame, last_frame: (M,) frames of the first and last accepted observation.
        observations: (M,) number of accepted observations, the first included.
    """

    id: IntArray = field(metadata=stored("M", "landmark id", check=COUNTS))
    position_m: Array = field(metadata=stored("M xyz", "m", "world", name="position"))
    covariance: Array = field(metadata=stored("M xyz xyz", "m^2", "world", COVARIANCES))
    initial_position_m: Array = field(metadata=stored("M xyz", "m", "world", name="initial_position"))
    first_frame: IntArray = field(metadata=stored("M", "frame index", check=FRAMES))
    last_frame: IntArray = field(metadata=stored("M", "frame index", check=FRAMES))
    observations: IntArray = field(metadata=stored("M", "count", check=COUNTS))

    def __len__(self) -> int:
        return len(self.id)

    def only(self, which: IntArray | NDArray[np.bool_]) -> Landmarks:
        """Return some of the landmarks."""
        return replace(self, **along(self, "M", which))

    @staticmethod
    def concatenate(parts: SequenceType[Landmarks]) -> Landmarks:
        """Return all landmarks of the parts, in their order."""
        return Landmarks(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Landmarks)))


@dataclass(frozen=True)
class Innovation:
    """Per-frame innovation statistics."""

    # (T,) normalised innovation squared r^T S^-1 r of the accepted observations; 0 where there are none.
    nis: Array = field(metadata=stored("T"))
    dof: IntArray = field(metadata=stored("T", "count", check=COUNTS))  # (T,) its degrees of freedom (three a landmark)
    # (T,) observations that updated or started a landmark.
    accepted: IntArray = field(metadata=stored("T", "count", check=COUNTS))
    rejected: IntArray = field(metadata=stored("T", "count", check=COUNTS))  # (T,) observations that did not


@dataclass(frozen=True)
class WhitenedInnovations:
    """Innovations of the K' accepted observations of known landmarks in units of their predicted deviations.

    They are in the order of frames; the equations are in `ekfslam.filters.innovations`.

    Args:
        frame: (K',) frame of the observation.
        landmark: (K',) row of its landmark in the log.
        alone: (K', d) innovation whitened by its own covariance: u, v, disparity.
        apart: (K', d) innovation without the camera motion on which all innovations of the frame agree, whitened by its
            own covariance; NaN if nothing is left.
        score: (T, 6) ``c = J^T S^-1 r`` of each frame, along the axes of the IMU: rho, then theta.
        information: (T, 6, 6) covariance ``C = J^T S^-1 J`` of the score; 0 if nothing was accepted.
    """

    frame: IntArray = field(metadata=stored("innovation", "frame index", check=FRAMES))
    landmark: IntArray = field(metadata=stored("innovation", "row of log/landmark_id", check=index_of("M")))
    alone: Array = field(metadata=stored("innovation d", "1", "image"))
    apart: Array = field(metadata=stored("innovation d", "1", "image", NUMBERS_OR_NONE))
    score: Array = field(metadata=stored("T xi", "1/m (rho 0-2), 1/rad (theta 3-5)", "imu"))
    information: Array = field(
        metadata=stored("T xi xi", "1/m^2, 1/(m rad), 1/rad^2 (rho 0-2, theta 3-5)", "imu", COVARIANCES)
    )

    @property
    def shared(self) -> Array:
        """(T, 6) components ``c_a / sqrt(C_aa)``: white over frames with unit variance; NaN where there is none."""
        variance = np.diagonal(self.information, axis1=1, axis2=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(variance > 0, self.score / np.sqrt(variance), np.nan)

    @property
    def shared_nis(self) -> Array:
        """(T,) ``c^T C^-1 c``, six degrees of freedom; NaN where the frame leaves a direction undetermined."""
        variance = np.diagonal(self.information, axis1=1, axis2=2)
        std = np.sqrt(np.where(variance > 0, variance, 1.0))
        correlation = self.information / (std[:, :, None] * std[:, None, :])
        values, axes = np.linalg.eigh(correlation)
        along = np.einsum("tba,tb->ta", axes, self.score / std)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(values[:, 0] > 1e-12, (along**2 / values).sum(axis=1), np.nan)


@dataclass(frozen=True)
class Rejections:
    """Every rejected observation: (R,) frame, landmark id, and index into `REASONS`."""

    frame: IntArray = field(metadata=stored("R", "frame index", check=FRAMES))
    landmark: IntArray = field(metadata=stored("R", "landmark id", check=COUNTS))
    reason: IntArray = field(metadata=stored("R", "code, see names", codes=REASONS))


@dataclass(frozen=True)
class Parameters:
    """Parameters that the joint filter has estimated, such as calibration, after each of T frames.

    Args:
        name, unit: Names and units of the p parameters.
        prior_std: (p,) standard deviations before the first frame.
        value, std: (T, p) estimates and their standard deviations.
    """

    name: tuple[str, ...] = field(metadata=attribute(tuple, along="P"))
    unit: tuple[str, ...] = field(metadata=attribute(tuple, along="P"))
    prior_std: Array = field(metadata=stored("P", _PARAMETER_UNITS, "imu", NOT_NEGATIVE))
    value: Array = field(metadata=stored("T P", _PARAMETER_UNITS, "imu"))
    std: Array = field(metadata=stored("T P", _PARAMETER_UNITS, "imu", NOT_NEGATIVE))

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """(p,) whether a parameter is observed: its standard deviation is below half of that of the prior."""
        return self.std[-1] < 0.5 * self.prior_std

    @property
    def lines(self) -> tuple[str, ...]:
        """One line a parameter: the last estimate, its standard deviation, and whether it is observed."""
        rows = zip(self.name, self.unit, self.prior_std, self.value[-1], self.std[-1], self.is_observed, strict=True)
        return tuple(
            f"{name}: {value:.3g} +- {std:.2g}{f' {unit}' * (unit != '1')} (before: 0 +- {prior:.2g})"
            + ("" if is_observed else ", not observable here")
            for name, unit, prior, value, std, is_observed in rows
        )


@dataclass(frozen=True)
class PosePairs:
    """Cross-covariances of the errors of reported poses."""

    first: IntArray = field(metadata=stored("pair", "frame index", check=FRAMES))  # first, second: (n,) frames j < k
    second: IntArray = field(metadata=stored("pair", "frame index", check=FRAMES))
    # (n, 6, 6) covariance of xi_j (rows) and xi_k as both were reported.
    cross: Array = field(metadata=stored("pair xi xi", _POSE_COVARIANCE, "imu of first, imu of second"))

    def __len__(self) -> int:
        return len(self.first)

    def only(self, which: NDArray[np.bool_]) -> PosePairs:
        """Return some of the pairs."""
        return replace(self, **along(self, "pair", which))


class View:
    """A method of `Result` in a higher module, ``module:name``, found at first use: results import no figures."""

    def __init__(self, function: str) -> None:
        self.function = function

    def __get__(self, result: Result | None, owner: type) -> Callable[..., Any]:
        function = resolve_name(self.function)
        return function if result is None else MethodType(function, result)


@dataclass(frozen=True, repr=False)
class Result(Shown):
    """One mode run on one sequence.

    Args:
        mode: ``dead-reckoning``, ``mapping-only``, ``full``, or of a posterior ``smoothed`` or ``as filtered``.
        sequence_name: Name of the sequence.
        time_s: (T,) stamps.
        T_world_imu: (T, 4, 4) estimated poses.
        covariance: (T, 6, 6) of the stored error ``xi`` (see `ERROR_CONVENTION`).
        landmarks: The map.
        innovation: Per-frame statistics.
        rejections: Every rejected observation.
        ms_per_frame: (T,) wall-clock time spent on each frame.
        counts: Totals. Observations accepted, rejected and dropped by hygiene add up to all.
        config: The resolved configuration as nested dictionaries.
        noise: The measurement noise that was assumed.
        camera, T_cam_imu: The calibration that was assumed.
        log: Everything that the joint filter conditioned on, with the landmarks in the same order (mode full only).
        hygiene: Report on the cleaning of the tracks (None: they were not cleaned, as in dead reckoning).
        parameters: Estimates of calibration, roll and pitch (None: none were estimated).
        inertial: Velocity and biases of an inertial unit (None: other inputs moved the poses, or an older archive).
        pairs: Cross-covariances of some of the poses (None: there is no truth to compare with).
        whitened: Whitened innovations (mode full only; older archives have none).
        attributes: Sequence attributes, versions, seed, input checksum, ``log_likelihood`` of the accepted innovations.
    """

    mode: str
    sequence_name: str = field(metadata=attribute(str))
    time_s: Array = field(metadata=stored("T", "s", "clock of the recording", ASCENDING, name="trajectory/time"))
    T_world_imu: Array = field(
        metadata=stored("T row column", "m (translation)", "world from imu", RIGID, name="trajectory/T_world_imu")
    )
    covariance: Array = field(
        metadata=stored("T xi xi", _POSE_COVARIANCE, "imu", COVARIANCES, name="trajectory/covariance")
    )
    landmarks: Landmarks = field(metadata=group(Landmarks))
    innovation: Innovation = field(metadata=group(Innovation))
    rejections: Rejections = field(metadata=group(Rejections))
    ms_per_frame: Array = field(metadata=stored("T", "ms", check=NOT_NEGATIVE, name="timing/ms_per_frame"))
    counts: Mapping[str, int]
    config: Mapping[str, Any]
    noise: Noise
    camera: StereoCamera
    T_cam_imu: Array
    log: Log | None = field(default=None, metadata=group(Log))
    hygiene: HygieneReport | None = field(default=None, metadata=group(HygieneReport))
    parameters: Parameters | None = field(default=None, metadata=group(Parameters))
    inertial: InertialStates | None = field(default=None, metadata=group(InertialStates))
    pairs: PosePairs | None = field(default=None, metadata=group(PosePairs))
    whitened: WhitenedInnovations | None = field(default=None, metadata=group(WhitenedInnovations))
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        stated = [value for value in self.attributes.values() if isinstance(value, float)]
        numbers = {
            name: value
            for name, item, value in values_of(self)
            # An infinite variance in a log is an observation without weight.
            if item.check.kinds == "f" and item.check is not NUMBERS_OR_NONE and not name.startswith("log.")
        }
        for name, value in {**numbers, "attributes": np.array(stated)}.items():
            is_wrong = ~np.isfinite(value)
            if is_wrong.any():
                raise NonFiniteResultError(self.mode, name, int(np.argwhere(is_wrong)[0][0]))

    def card(self) -> Card:
        last = zip("xyz", self.T_world_imu[-1, :3, 3], self.position_std_world_m[-1], strict=True)
        innovation, dof = self.innovation, int(self.innovation.dof.sum())
        facts = self.brief
        facts["last position"] = ", ".join(f"{a} {value:.2f} +- {std:.2g}" for a, value, std in last) + " m (1 sigma)"
        tracks, count = len(np.unique(self.landmarks.id)), len(self.landmarks)
        again = f" of {tracks} tracks: one that comes back or is cut starts another" if count > tracks else ""
        facts["landmarks"] = f"{count}{again}"
        if self.inertial is not None:
            velocity = in_words(self.velocity_world_m_s, self.velocity_std_world_m_s, "m/s along world")
            facts |= {"last velocity": velocity, **dict(line.split(": ") for line in self.inertial.lines[1:])}
        if dof:
            facts["NIS / dof"] = f"{figure(float(innovation.nis.sum()) / dof)} (1 expected)"
        facts |= {f"remark {i}": remark for i, remark in enumerate(self.remarks, 1)}
        further: tuple[str, ...] = (".map()", ".plot()", ".errors(sequence)", '.to_dataframe("landmarks")')
        further += ("ekfslam.posterior(result)",) if self.log is not None else ()
        return Card(f"{self.mode} on {self.sequence_name}", facts, further)

    @property
    def is_other(self) -> bool:
        """Whether the poses are those of another program."""
        return OTHER in self.attributes

    @property
    def has_covariance(self) -> bool:
        """Whether the poses have covariances; those of another program may have none, stored as 0."""
        return not self.is_other or bool(self.covariance.any())

    @property
    def knows_vertical(self) -> bool:
        """Whether accelerations have shown the vertical, so that only yaw and position are open."""
        return self.inertial is not None or bool(self.attributes.get(OTHER_LEVEL, 0))

    @property
    def brief(self) -> dict[str, str]:
        """Size, last standard deviations (position: root of the sum), share of observations, and time."""
        way_m = float(np.linalg.norm(np.diff(self.T_world_imu[:, :3, 3], axis=0), axis=1).sum())
        seconds, total_s = float(self.time_s[-1] - self.time_s[0]), float(self.ms_per_frame.sum()) / 1e3
        position_m = np.sqrt(max(float(np.trace(self.position_covariance_world[-1])), 0.0))
        heading_deg = np.degrees(np.sqrt(max(float(self.rotation_covariance_world[-1, 2, 2]), 0.0)))
        each_ms = float(np.median(self.ms_per_frame))
        return {
            "frames, way": f"{len(self.time_s)} in {figure(seconds)} s, {figure(way_m)} m",
            **({_LAST_STD: f"{figure(position_m)} m, {figure(float(heading_deg))} deg"} if self.has_covariance else {}),
            **({} if self.is_other else {"observations used": self._used}),
            **({} if self.is_other else {"time": f"{figure(total_s)} s, {figure(each_ms)} ms a frame"}),
        }

    @property
    def _used(self) -> str:
        """The share of the observations that the estimate is conditioned on."""
        counts, accepted = self.counts, int(self.innovation.accepted.sum())
        if "observations" in counts:  # a posterior
            weak = counts.get("observations weighted below one half", 0)
            return f"all {counts['observations']} of full, {weak} with less than half their weight"
        if (total := accepted + int(self.innovation.rejected.sum()) + counts.get("dropped by hygiene", 0)) == 0:
            return "none"
        return f"{100 * accepted / total:.1f} % of {total}"

    # --- in the frame that a reader expects ---------------------------------------------------------------------------

    @property
    def position_covariance_world(self) -> Array:
        """(T, 3, 3) covariance ``R P_rho R^T`` of the position error along the axes of world, m^2.

        ``covariance`` is of ``xi`` along the axes of the IMU. ``xi`` moves the IMU by ``-R rho`` to first order.
        """
        return world_axes_covariance(self.T_world_imu, self.covariance)[0]

    @property
    def rotation_covariance_world(self) -> Array:
        """(T, 3, 3) covariance ``R P_theta R^T`` of the rotation error about the axes of world, rad^2."""
        return world_axes_covariance(self.T_world_imu, self.covariance)[1]

    @property
    def position_std_world_m(self) -> Array:
        """(T, 3) standard deviations of the position along x, y, z of world."""
        return np.sqrt(np.maximum(np.diagonal(self.position_covariance_world, axis1=1, axis2=2), 0.0))

    @property
    def tilt_std_rad(self) -> Array:
        """(T, 2) standard deviations of the tilt: of the rotation about the level axes x and y of world."""
        variance = np.diagonal(self.rotation_covariance_world, axis1=1, axis2=2)[:, :2]
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def gravity_imu(self) -> Array:
        """(T, 3) unit vectors along gravity (-z of world) in the IMU frame; `tilt_std_rad` is their uncertainty."""
        return -self.T_world_imu[:, 2, :3]

    @property
    def velocity_world_m_s(self) -> Array:
        """(T, 3) velocity of an inertial unit along the axes of world; raises `NoInertialError` without one."""
        return velocity_world(self.T_world_imu, self._moved)[0]

    @property
    def velocity_std_world_m_s(self) -> Array:
        """(T, 3) standard deviations of `velocity_world_m_s`."""
        variance = np.diagonal(velocity_world(self.T_world_imu, self._moved)[1], axis1=1, axis2=2)
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def _moved(self) -> InertialStates:
        if self.inertial is None:
            raise NoInertialError(f"{self.sequence_name}: no velocity and biases: the result is of no inertial samples")
        return self.inertial

    def frame_at(self, time_s: float) -> int:
        """Return the frame whose stamp is nearest to a time on the clock of the recording, s."""
        first_s, last_s = self.time_s[[0, -1]].tolist()
        if not first_s <= time_s <= last_s:
            raise ShapeError(f"{time_s:g} s is not within {first_s:g} to {last_s:g} s", source=self.sequence_name)
        return int(np.argmin(np.abs(self.time_s - time_s)))

    def between(self, begin_s: float, end_s: float) -> Result:
        """Return the frames with stamps in ``[begin_s, end_s)``, on the clock of the recording, as a result.

        The map has the landmarks seen in these frames. Estimates, ``counts``, ``config`` and ``attributes`` stay those
        of the whole run; log, whitened innovations and hygiene are left out.
        """
        begin, end = np.searchsorted(self.time_s, (begin_s, end_s)).tolist()
        if begin >= end:
            raise ShapeError(f"there are no frames from {begin_s:g} s to {end_s:g} s", source=self.sequence_name)

        frames = slice(begin, end)
        rejections, pairs, parameters = self.rejections, self.pairs, self.parameters
        rejected = (rejections.frame >= begin) & (rejections.frame < end)
        rejections = replace(rejections, **along(rejections, "R", rejected))
        known = self.landmarks.only((self.landmarks.first_frame < end) & (self.landmarks.last_frame >= begin))
        first, last = (np.clip(frame, begin, end - 1) - begin for frame in (known.first_frame, known.last_frame))
        if pairs is not None:
            pairs = pairs.only((pairs.first >= begin) & (pairs.second < end))
            pairs = replace(pairs, first=pairs.first - begin, second=pairs.second - begin)
        return replace(
            self,
            **along(self, "T", frames),
            innovation=replace(self.innovation, **along(self.innovation, "T", frames)),
            landmarks=replace(known, first_frame=first, last_frame=last),
            rejections=replace(rejections, frame=rejections.frame - begin),
            parameters=None if parameters is None else replace(parameters, **along(parameters, "T", frames)),
            inertial=self.inertial and replace(self.inertial, **along(self.inertial, "T", frames)),
            pairs=pairs,
            log=None,
            hygiene=None,
            whitened=None,
        )

    # --- methods that higher modules provide --------------------------------------------------------------------------

    map = View("ekfslam.figures.views:map_of")
    plot = View("ekfslam.figures.views:trajectory_of")
    errors = View("ekfslam.figures.views:errors_of")
    to_dataframe = View("ekfslam.storage.tables:dataframe")
    to_xarray = View("ekfslam.storage.tables:dataset")
    export = View("ekfslam.storage.exports:export")

    @property
    def remarks(self) -> tuple[str, ...]:
        """Warnings about the run, one sentence each."""
        remarks = []
        if self.mode != "dead-reckoning" and not self.is_other and not len(self.landmarks):
            is_waiting = self.camera.is_monocular and self.counts.get("rejected: waiting", 0) > 0
            why = "no track of the one camera saw the parallax of a landmark, as if it rested or turned in place"
            remarks.append(
                why if is_waiting else "not one observation was used: the trajectory is that of dead reckoning"
            )
        finest_px = float(np.min(self.noise.pixel_std_px))
        if self.mode == "full" and self.noise.track_first_px is None and finest_px < LINEAR_FROM_PX:
            remarks.append(
                f"pixel noise of {finest_px:.2g} px is less than the errors of linearisation: the filter's covariances "
                "are too small, those of the mode smoothed hold"
            )
        remarks += [str(self.attributes[UNUSED])] if UNUSED in self.attributes else []
        kept = str(self.attributes.get(SANITY, ""))
        return (*remarks, *(kept.split(SANITY_SEPARATOR) if kept else ()))
