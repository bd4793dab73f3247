"""The log: everything the joint filter conditioned on, and where it linearised it.

With the log the posterior over *all* poses and landmarks can be rebuilt at any time (`ekfslam.smoother.posterior`),
though the filter itself carries only what is in view. It is flat arrays, a few numbers an observation.
"""

from __future__ import annotations

from dataclasses import dataclass

from ekfslam.arrays import Array, IntArray


@dataclass(frozen=True)
class Log:
    """Motion and accepted observations of the joint filter over T frames, M landmarks and K observations.

    Args:
        first_estimates: Whether the filter took the landmark's place in H at its first estimate (FEJ).
        initial_covariance: (6, 6) of the first pose's error ``xi``.
        twist: (T, 6) measured velocities of the IMU, m/s and rad/s.
        tau_s: (T,) length of the interval that each twist drove; 0 for the first frame.
        T_predicted: (T, 4, 4) ``T_imu_world`` before the update of each frame.
        T_linear: (T, 4, 4) ``T_imu_world`` at which the update was linearised: the predicted one, unless it was
            iterated or a landmark came back.
        T_updated: (T, 4, 4) ``T_imu_world`` after the update.
        id: (M,) landmark ids in the order of first sight; an id occurs again where a track was split.
        first_position_m: (M, 3) triangulation at first sight, in world.
        frame: (K,) frame of each accepted observation, ascending.
        landmark: (K,) row of the landmark in ``id``. Its first observation is the one that it was triangulated from.
        rows: (K, 3) what was measured: the sensor's rows.
        variance: (K, 3) their variances.
        position_m: (K, 3) where the landmark was linearised, in world.
    """

    first_estimates: bool
    initial_covariance: Array
    twist: Array
    tau_s: Array
    T_predicted: Array
    T_linear: Array
    T_updated: Array
    id: IntArray
    first_position_m: Array
    frame: IntArray
    landmark: IntArray
    rows: Array
    variance: Array
    position_m: Array

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.tau_s)

    @property
    def landmarks(self) -> int:
        """Number of landmarks M."""
        return len(self.id)

    @property
    def observations(self) -> int:
        """Number of accepted observations K."""
        return len(self.frame)
