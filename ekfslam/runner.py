"""`run`: one mode on one sequence, from configuration to `Result`."""

from __future__ import annotations

import dataclasses
import platform
from importlib.metadata import version
from time import perf_counter

import h5py
import numpy as np
import scipy
from threadpoolctl import threadpool_limits

from ekfslam.config import MODES, Config, Mode, noise_account, noise_of
from ekfslam.data.hygiene import clean_tracks
from ekfslam.data.sequence import WITHOUT_TRACKS, Sequence
from ekfslam.errors import ConfigError
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.joint import run_joint
from ekfslam.filters.mapping import map_landmarks
from ekfslam.filters.observing import Rig, collect
from ekfslam.filters.result import HygieneReport, Innovation, Landmarks, Rejections, Result
from ekfslam.geometry import se3
from ekfslam.progress import progress
from ekfslam.smoother.posterior import smooth


def run(sequence: Sequence, mode: Mode = "full", config: Config | None = None) -> Result:
    """Estimate trajectory and map of a sequence.

    Args:
        sequence: The recording.
        mode: ``dead-reckoning`` (prediction only), ``mapping-only`` (the report: independent landmark EKFs on dead
            reckoning's poses), ``full`` (joint EKF SLAM) or ``smoothed`` (the posterior of a full run).
        config: Settings; defaults where None.

    Raises:
        ConfigError: Unknown mode.
        InnovationError: An innovation covariance is not positive definite.
        IllPosedError: The posterior of a smoothed run leaves something undetermined.
    """
    if mode not in MODES:
        raise ConfigError(f"unknown mode {mode!r}; known: {', '.join(MODES)}")
    if mode == "smoothed":
        return smooth(run(sequence, "full", config))
    config = (config or Config()).resolved(sequence)
    noise, account = noise_of(sequence, config), noise_account(sequence, config)
    hygiene: HygieneReport | None = None
    if mode != "dead-reckoning":
        observations, hygiene = clean_tracks(sequence, noise, config.hygiene)
        attributes = sequence.attributes if len(observations) else {**sequence.attributes, **WITHOUT_TRACKS}
        sequence = dataclasses.replace(sequence, observations=observations, attributes=attributes)
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise)
    frames = progress(range(len(sequence)), f"{sequence.name}: {mode}")
    counts: dict[str, int] = {}
    log = parameters = None

    # Small dense matrices: a second BLAS thread costs three times what it saves.
    with threadpool_limits(1, user_api="blas"):
        if mode == "full":
            ekf, T_imu_world, covariance, reports, ms = run_joint(
                sequence, rig, config.filter, frames, config.calibration
            )
            landmarks, counts, log, parameters = ekf.landmarks(), ekf.counts, ekf.log(), ekf.further()
        else:
            begin = perf_counter()
            T_imu_world, covariance = dead_reckon(sequence, noise, config.filter.initial_covariance)
            # Dead reckoning is computed for all frames at once; each frame bears its share.
            ms = np.full(len(sequence), 1e3 * (perf_counter() - begin) / len(sequence))
            landmarks, reports = Landmarks.empty(), []
            if mode == "mapping-only":
                landmarks, reports, ms_mapping = map_landmarks(
                    sequence.observations, T_imu_world, rig, config.filter, frames
                )
                ms = ms + ms_mapping

    innovation, rejections = Innovation.empty(len(sequence)), Rejections.empty()
    if reports:
        innovation, rejections, tallies = collect(reports)
        counts = {**tallies, **counts}
        account["log_likelihood"] = float(sum(report.log_likelihood for report in reports))
    if hygiene is not None:
        counts |= hygiene.counts
    return Result(
        mode=mode,
        sequence_name=sequence.name,
        time_s=sequence.time_s,
        T_world_imu=se3.inverse(T_imu_world),
        covariance=covariance,
        landmarks=landmarks,
        innovation=innovation,
        rejections=rejections,
        ms_per_frame=ms,
        counts=counts,
        config=dataclasses.asdict(config),
        noise=noise,
        camera=sequence.camera,
        T_cam_imu=sequence.T_cam_imu,
        log=log,
        hygiene=hygiene,
        parameters=parameters,
        attributes={**sequence.attributes, **account, **versions()},
    )


def versions() -> dict[str, str]:
    """Versions of the software whose numbers these are, as attributes ``version_<name>``."""
    return {
        "version_ekfslam": version("ekfslam"),
        "version_python": platform.python_version(),
        "version_numpy": np.__version__,
        "version_scipy": scipy.__version__,
        "version_h5py": h5py.__version__,
    }
