"""How far errors of tracks walk, found from a recording's own innovations, without truth.

Two measures of innovations count, and they ask for different sizes. From one frame to the next the errors of tracks are
small: their size there is where normalised innovations squared are what they should be. But they persist along tracks,
so that over many frames they add up to `PERSISTENCE` times as much. Where velocities are clean they bridge the low
frequencies, and the size of a frame is taken. Where they are noisy, or nobody measured any, vision carries the low
frequencies alone, and what counts is what errors of tracks add up to. Errors of tracks that are checked against their
first sight do not walk.
"""

from __future__ import annotations

import numpy as np

from ekfslam.config import Config
from ekfslam.data.sequence import Sequence
from ekfslam.data.stretches import cut
from ekfslam.errors import InnovationError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.models.build import build, is_automatic
from ekfslam.models.noise import velocity_noise

# Square root of the long-run variance of errors along KLT tracks over that of a frame, as `ekfslam check` finds it.
PERSISTENCE = 3.0
# Normalised innovation squared a degree of freedom: below 1, as errors persist.
TARGET = 0.7
_FRAMES, _ROUNDS, _LEAST_DOF, _LIMITS = 150, 2, 300, (0.3, 4.0)


def with_track_scale(config: Config, sequence: Sequence) -> Config:
    """A configuration with the factor on the walk of track errors, where it is automatic and not given.

    Args:
        config: Settings.
        sequence: The recording; `_FRAMES` frames from its middle are filtered `_ROUNDS` times.
    """
    given = config.noise.track_scale is not None or config.noise.drift is not None
    # A tuned file was found with the walk as it is.
    if not is_automatic(sequence, config) or given or config.noise.model != "auto" or sequence.has_checked_tracks:
        return config
    scale = 1.0
    if not sequence.has_velocities or not velocity_noise(sequence.twist).is_clean:
        scale = PERSISTENCE
    elif len(sequence.observations):
        begin = max(len(sequence) - _FRAMES, 0) // 2
        stretch = cut(sequence, begin, begin + _FRAMES, sequence.initial_T_world_imu) or sequence
        for _ in range(_ROUNDS):
            nis, dof = _innovations(stretch, _scaled(config, scale))
            if dof < _LEAST_DOF:
                break
            scale = float(np.clip(scale * np.sqrt(nis / dof / TARGET), *_LIMITS))
    return _scaled(config, scale)


def _scaled(config: Config, scale: float) -> Config:
    return config.with_overrides({"noise": {"track_scale": scale}})


def _innovations(sequence: Sequence, config: Config) -> tuple[float, int]:
    """NIS and its degrees of freedom of a run; none where the filter breaks down."""
    # What comes back starts afresh: bringing it back would cost a solution of the whole batch problem.
    problem = build(sequence, config.with_overrides({"filter": {"revive": -1}}))
    ekf = JointEKF(problem.model, problem.config.filter)
    try:
        with one_thread():
            reports = [frame.report for frame in run_filter(ekf, problem.sequence)]
    except InnovationError:
        return 0.0, 0
    return sum(report.nis for report in reports), sum(report.dof for report in reports)
