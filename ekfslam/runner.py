"""Run one mode on one recording, from configuration to `Result`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import MODES, Config, Mode
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, NoVelocitiesError
from ekfslam.evaluation.relative import dead_reckoned_pairs, relative_pairs
from ekfslam.evaluation.sanity import inspect_result, inspect_sequence, sanity_attributes
from ekfslam.evaluation.sources import compare_sources, doubt_in_truth, in_words
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.inertial_states import InertialStates
from ekfslam.filters.innovations import collect_innovations
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.log import Log
from ekfslam.filters.loop import one_thread, run_filter, solvable
from ekfslam.filters.mapping import IndependentLandmarks
from ekfslam.filters.references import References
from ekfslam.filters.reports import FrameReport, collect
from ekfslam.filters.result import Innovation, Landmarks, Parameters, PosePairs, Rejections, Result
from ekfslam.geometry import se3
from ekfslam.models.process.inertial import Inertial
from ekfslam.models.sensors.velocities import Both, VelocitySource
from ekfslam.progress import progress
from ekfslam.provenance import provenance
from ekfslam.resolve import Problem, resolve
from ekfslam.smoother.fixed_lag import FixedLag
from ekfslam.smoother.posterior import smooth
from ekfslam.smoother.revival import MapRevival
from ekfslam.stored import empty
from ekfslam.timings import Timings


def require_arguments(sequence: object, config: object) -> None:
    """Raise `ConfigError` for a name in place of a recording, or a dictionary in place of a configuration."""
    if not isinstance(sequence, Sequence):
        message = f"expected a Sequence, as open_sequence returns it, found {type(sequence).__name__}"
        raise ConfigError(message)
    if not isinstance(config, Config | None):
        raise ConfigError(f"expected a Config, as Config().with_overrides(...) makes it, found {type(config).__name__}")


@one_thread()
@solvable()
def run(
    sequence: Sequence,
    mode: Mode = "full",
    config: Config | None = None,
    further: VelocitySource | None = None,
    timings: Timings | None = None,
) -> Result:
    """Estimate trajectory and map of a sequence.

    Args:
        mode: ``dead-reckoning`` (prediction only), ``mapping-only`` (the report: independent landmark EKFs on dead
            reckoning's poses), ``full`` (joint EKF SLAM) or ``smoothed`` (the posterior of a full run).
        further: Velocity measurements of other sensors, for the joint filter (`ekfslam.models.sensors.velocities`).
        timings: Clock that the parts of the run are charged to.

    Raises:
        ConfigError: Unknown mode.
        NoVelocitiesError: Dead reckoning of a recording without velocities.
        FilterError: The filter cannot go on: an innovation covariance is not positive definite (`InnovationError`), a
            number is none (`NonFiniteResultError`), or a matrix is singular.
        IllPosedError: The posterior of a smoothed run leaves something undetermined.
    """
    require_arguments(sequence, config)
    if mode not in MODES:
        raise ConfigError(f"unknown mode {mode!r}; known: {', '.join(MODES)}")
    if mode == "dead-reckoning" and not sequence.has_velocities:
        raise NoVelocitiesError(
            f"{sequence.name}: no measured velocities, so no dead reckoning; the other modes use vision"
        )
    if mode == "mapping-only" and sequence.camera.is_monocular:
        raise ConfigError(f"{sequence.name}: mapping-only needs depths, which one camera does not see; use full")
    timings = timings or Timings()
    if mode == "smoothed":
        full = run(sequence, "full", config, further, timings)
        with timings.part(mode):
            return smooth(full)
    with timings.part("automatic model"):
        suspicions = sequence.once(inspect_sequence).warnings
        problem = resolve(sequence, config, mode)
    with timings.part(mode):
        sources = further if problem.beside is None else problem.beside.along(further)
        estimate = _joint(problem, sources) if mode == "full" else _dead_reckoned(problem, mode)
    with timings.part("evaluation"):
        result = _result(problem, mode, estimate)
        compared = compare_sources(sequence) if mode == "full" and not suspicions else None
        found = in_words(compared, sequence.time_s)
        lines = sanity_attributes((*suspicions, *inspect_result(sequence, result, suspicions), *found))
        doubts = doubt_in_truth(compared, sequence.time_s)
        return dataclasses.replace(result, attributes={**result.attributes, **lines, **doubts})


@dataclasses.dataclass(frozen=True)
class _Estimate:
    """Estimate of a mode; fields are those of `Result`, except for the direction of the poses (T, 4, 4)."""

    T_imu_world: Array
    covariance: Array
    ms: Array
    pairs: PosePairs | None
    reports: list[FrameReport] = dataclasses.field(default_factory=list)
    landmarks: Landmarks = dataclasses.field(default_factory=lambda: empty(Landmarks))
    counts: Mapping[str, int] = dataclasses.field(default_factory=dict)
    log: Log | None = None
    parameters: Parameters | None = None
    inertial: InertialStates | None = None


def _judged(problem: Problem) -> tuple[IntArray, IntArray] | None:
    """Return the pairs of frames whose relative pose is compared with the truth, if requested."""
    truth, reach = problem.sequence.truth, problem.config.filter.relative_frames
    return relative_pairs(truth, reach) if truth is not None and reach else None


def _joint(problem: Problem, further: VelocitySource | Both | None) -> _Estimate:
    """Run the joint filter."""
    sequence, settings, judged = problem.sequence, problem.config.filter, _judged(problem)
    count = len(sequence)
    revival = MapRevival(problem.model, settings) if settings.revive >= 0 else None
    ekf = JointEKF(problem.model, settings, revival=revival, window=FixedLag)
    references = None if judged is None else References(ekf, *judged)
    T_imu_world, covariance, ms = np.zeros((count, 4, 4)), np.zeros((count, 6, 6)), np.zeros(count)
    reports: list[FrameReport] = []
    own, columns = problem.model.process.own[1:], np.ix_(*[problem.model.process.columns] * 2)
    states, joint = list[list[Array]](), list[Array]()
    frames = progress(range(count), f"{sequence.name}: full")
    for k, report, ms[k] in run_filter(ekf, sequence, frames, further):
        P = ekf.gaussian.body_covariance
        T_imu_world[k], covariance[k] = ekf.T_imu_world, P[:6, :6]
        if isinstance(problem.model.process, Inertial):
            states.append([ekf.values[name] for name in own])
            joint.append(P[columns])
        reports.append(report)
        if references is not None:
            references.record(k)
    pairs = None if references is None else references.pairs()
    inertial = InertialStates.of_frames(states, joint)
    known, log = ekf.landmarks(), ekf.log()
    return _Estimate(T_imu_world, covariance, ms, pairs, reports, known, ekf.counts, log, ekf.parameters(), inertial)


def _dead_reckoned(problem: Problem, mode: Mode) -> _Estimate:
    """Return the prediction and, in mode ``mapping-only``, the map built on it."""
    sequence, model, settings = problem.sequence, problem.model, problem.config.filter
    judged, begin = _judged(problem), perf_counter()
    T_imu_world, covariance = dead_reckon(sequence, model.noise, settings.initial_covariance)
    pairs = None if judged is None else dead_reckoned_pairs(*judged, se3.inverse(T_imu_world), covariance)
    # Dead reckoning is computed for all frames at once; each frame bears its share.
    ms = np.full(len(sequence), 1e3 * (perf_counter() - begin) / len(sequence))
    if mode == "dead-reckoning":
        return _Estimate(T_imu_world, covariance, ms, pairs)
    mapper, reports = IndependentLandmarks(model.observer.rig.with_white_pixels(), settings, T_imu_world), []
    frames = progress(range(len(sequence)), f"{sequence.name}: {mode}")
    for k, report, taken in run_filter(mapper, sequence, frames):
        reports.append(report)
        ms[k] += taken
    return _Estimate(T_imu_world, covariance, ms, pairs, reports, mapper.landmarks())


def _result(problem: Problem, mode: Mode, estimate: _Estimate) -> Result:
    sequence, reports = problem.sequence, estimate.reports
    account: dict[str, Any] = {**problem.account, "model": "; ".join(problem.lines)}
    innovation, rejections = empty(Innovation, T=len(sequence)), empty(Rejections)
    counts, whitened = dict(estimate.counts), None
    if reports:
        innovation, rejections, tallies = collect(reports)
        counts = {**tallies, **counts}
        found = [report.innovations for report in reports if report.innovations is not None]
        whitened = collect_innovations(found) if found else None
        account["log_likelihood"] = float(sum(report.log_likelihood for report in reports))
    if problem.hygiene is not None:
        counts |= problem.hygiene.counts
    return Result(
        mode=mode,
        sequence_name=sequence.name,
        time_s=sequence.time_s,
        T_world_imu=se3.inverse(estimate.T_imu_world),
        covariance=estimate.covariance,
        landmarks=estimate.landmarks,
        innovation=innovation,
        rejections=rejections,
        ms_per_frame=estimate.ms,
        counts=counts,
        config=dataclasses.asdict(problem.config),
        noise=problem.model.noise,
        camera=sequence.camera,
        T_cam_imu=sequence.T_cam_imu,
        log=estimate.log,
        hygiene=problem.hygiene,
        parameters=estimate.parameters,
        inertial=estimate.inertial,
        pairs=estimate.pairs,
        whitened=whitened,
        attributes={**sequence.attributes, **account, **provenance()},
    )
