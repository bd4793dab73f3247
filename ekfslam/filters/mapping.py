"""Mapping-only, the report's second half: poses as given, every landmark its own 3x3 EKF.

Equals the joint filter with a certain first pose and exact velocities (P_xx(0) = 0, W = 0).
"""

from __future__ import annotations

from collections.abc import Iterable
from time import perf_counter

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.sequence import Observations
from ekfslam.filters.observing import (
    ACCEPTED,
    BEHIND_CAMERA,
    GATE,
    FrameReport,
    Sensor,
    diagonal,
    first_sight,
    linearise,
    log_density,
    missed,
    normalised_squares,
)
from ekfslam.filters.result import Landmarks


def map_landmarks(
    observations: Observations,
    T_imu_world: Array,
    sensor: Sensor,
    config: FilterConfig,
    frames: Iterable[int],
) -> tuple[Landmarks, list[FrameReport], Array]:
    """Independent EKF updates of all landmarks of a frame in one batch, frame by frame.

    Args:
        observations: Stereo observations.
        T_imu_world: (T, 4, 4) poses, taken as exact.
        sensor: What observes, and its noise.
        config: Gate and limits.
        frames: The frames to go through, ascending (wrapped in a progress bar by the caller).

    Returns:
        Landmarks (pieces that were split off, then the rest in the order of their ids), one report a frame, and the
        wall-clock time of each frame in ms.

    Raises:
        InnovationError: An innovation covariance is not positive definite.
    """
    ids = observations.ids
    position, initial = np.zeros((len(ids), 3)), np.zeros((len(ids), 3))
    covariance = np.zeros((len(ids), 3, 3))
    first, last = np.full(len(ids), -1), np.full(len(ids), -1)
    count, misses = np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=np.int64)
    retired: list[Landmarks] = []
    gate = config.gate

    def landmarks_at(which: IntArray) -> Landmarks:
        return Landmarks(
            ids[which], position[which], covariance[which], initial[which], first[which], last[which], count[which]
        )

    reports: list[FrameReport] = []
    ms: list[float] = []

    for k in frames:
        begin = perf_counter()
        seen, pixels = observations.at(k)
        slot = np.searchsorted(ids, seen)
        rows = sensor.rows(pixels)
        V = diagonal(sensor.variance(rows))
        reason = sensor.screen(pixels, config)

        known = np.flatnonzero((reason == ACCEPTED) & (count[slot] > 0))
        estimate = position[slot[known]]
        q, _, H = linearise(sensor, T_imu_world[k], estimate, estimate)
        in_front = sensor.in_view(q, config)
        reason[known[~in_front]] = BEHIND_CAMERA
        known, q, H = known[in_front], q[in_front], H[in_front]

        residual = rows[known] - sensor.predict(q)
        HP = H @ covariance[slot[known]]
        S = HP @ np.swapaxes(H, -1, -2) + V[known]
        nis = normalised_squares(S, residual, k, seen[known])
        inside = nis <= gate
        reason[known[~inside]] = GATE
        update = slot[known[inside]]
        gain = np.swapaxes(np.linalg.solve(S[inside], HP[inside]), -1, -2)
        position[update] += (gain @ residual[inside, :, None])[..., 0]
        P = covariance[update] - gain @ HP[inside]
        covariance[update] = 0.5 * (P + np.swapaxes(P, -1, -2))

        misses[slot[missed(reason)]] += 1
        misses[update] = 0
        split = slot[(misses[slot] >= config.split_after) & (config.split_after > 0)]
        retired.append(landmarks_at(split))
        count[split] = misses[split] = 0
        reason[np.isin(slot, split)] = ACCEPTED

        new = np.flatnonzero((reason == ACCEPTED) & (count[slot] == 0))
        start = slot[new]
        position[start], _, covariance[start] = first_sight(sensor, T_imu_world[k], rows[new])
        initial[start], first[start] = position[start], k

        accepted = slot[reason == ACCEPTED]
        last[accepted] = k
        count[accepted] += 1
        nis_accepted = nis[inside]
        dof = 3 * len(nis_accepted)
        likelihood = log_density(nis_accepted.sum(), np.linalg.slogdet(S[inside])[1].sum(), dof)
        reports.append(FrameReport(k, seen, reason, float(nis_accepted.sum()), dof, ids[split], likelihood))
        ms.append(1e3 * (perf_counter() - begin))

    landmarks = Landmarks.concatenate([*retired, landmarks_at(np.flatnonzero(count > 0))])
    return landmarks, reports, np.array(ms)
