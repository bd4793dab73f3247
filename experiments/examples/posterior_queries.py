"""What can be asked of the posterior over the whole drive: covariances of anything with anything, and samples.

One learns how to smooth a run, how to get the joint covariance of any poses and landmarks, how to carry uncertainty
through any function of them by samples, and how to put a further block into the state: here a bias of the velocities,
which the recording is given first.
"""

from __future__ import annotations

import numpy as np

import ekfslam
from ekfslam.config import Config

BIAS = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.02])  # m/s and rad/s, of what the IMU measures


def main() -> None:
    sequence = ekfslam.open_sequence("builtin:loop?frames=200")
    sequence = sequence.with_velocities(sequence.twist + BIAS)
    block = {"sigma_v_m_s": 0.3, "sigma_w_rad_s": 0.03, "time_v_s": 1e4, "time_w_s": 1e4}
    result = ekfslam.run(sequence, "full", Config(blocks={"twist_bias": block}))
    found, truth = ekfslam.posterior(result), sequence.truth
    assert truth is not None
    for name, T_world_imu in (("filtered", result.T_world_imu), ("smoothed", found.T_world_imu)):
        error_m = np.linalg.norm(T_world_imu[:, :3, 3] - truth.T_world_imu[:, :3, 3], axis=1)
        print(f"{name}: RMS of the position error {np.sqrt(np.mean(error_m**2)):.3f} m")

    # A block of the covariance: by frame and by row of the map, in the order asked for, 6 and 3 columns each.
    P = found.joint_covariance(frames=[100, -1], landmarks=[0, 5])
    std = np.sqrt(np.diag(P))
    correlation = P / np.outer(std, std)
    print(f"joint covariance: {len(P)} columns, {np.linalg.eigvalsh(correlation)[0]:.3f} least eigenvalue if scaled")

    # Samples: of poses and landmarks together, so that any function of them has the right spread.
    T_world_imu, position_m = found.sample(np.random.default_rng(0), 1000)
    distances_m = np.linalg.norm(T_world_imu[:, -1, :3, 3] - position_m[:, 0], axis=1)
    true_m = np.linalg.norm(truth.T_world_imu[-1, :3, 3] - truth.position_m[truth.landmark == found.id[0]])
    print(f"last pose to first landmark: {distances_m.mean():.3f} +- {distances_m.std():.3f} m, true {true_m:.3f} m")

    # A further block: values and covariances of each frame.
    bias, std = found.values["twist_bias"][-1], np.sqrt(np.diag(found.block_covariance("twist_bias")[-1]))
    for i, unit in ((0, "m/s"), (5, "rad/s")):
        print(f"bias {i}: {bias[i]:.4f} +- {std[i]:.4f} {unit}, true {BIAS[i]:.4f}")


if __name__ == "__main__":
    main()
