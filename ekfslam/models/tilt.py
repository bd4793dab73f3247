"""Roll and pitch of a vehicle at its first pose, from its own level velocities.

A vehicle moves along its x axis, up to the angle at which the unit is mounted and to what its suspension does. So its
nose is pitched like the road, whose grade is ``v_up / v_forward`` of the level velocities. Turn rates about the level
axes are the rates of roll and pitch, and carry both angles back to the first pose. On ten drives of one car, level
velocities turned by one direction up for each drive are the true ones within 0.07 deg in the mean. These point 0.2 to
0.7 deg above the x axis: an angle of the car, within the prior here.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import Sequence
from ekfslam.models.blocks.twist_bias import TwistBias

# Roll and pitch of a unit in a road vehicle against the road: how the vehicle is loaded (UN regulation 48 allows the
# dipped beam to pitch by 2 % with the load) and the unit mounted; for roll, also the crossfall of roads (2.5 %).
MOUNTED_RAD = np.deg2rad([1.8, 1.0])
# Roll in bends, and the suspension: standard deviations, and the time after which a share 1/e is left.
PASSING_RAD, PASSING_S = np.deg2rad([2.0, 0.5]), (5.0, 3.0)
_LEAST_SPEED_M_S, _MOST_ACROSS, _MOST_SAMPLES = 2.0, 0.2, 300


def first_tilt(sequence: Sequence, noise: Noise, bias: TwistBias) -> Array | None:
    """Return roll and pitch at the first frame, and their standard deviations: (2, 2), rad; None: too rarely along x.

    ``tilt_rad`` of the noise is the standard deviation of both before; ``bias`` are slow errors of the velocities.
    """
    twist, tau_s = sequence.twist, np.diff(sequence.time_s, prepend=sequence.time_s[:1])
    forward, across = np.abs(twist[:, 0]), np.abs(twist[:, 1])
    drives = (forward > max(_LEAST_SPEED_M_S, 5.0 * noise.twist_std[0])) & ~sequence.interpolated
    if not drives.any() or np.median(across[drives] / forward[drives]) > _MOST_ACROSS:
        return None
    at = np.flatnonzero(drives)
    at = at[:: -(-len(at) // _MOST_SAMPLES)]
    since = sequence.time_s[at] - sequence.time_s[0]
    apart = np.abs(np.subtract.outer(since, since))
    turned = np.cumsum(twist[:, 3:5] * tau_s[:, None], axis=0)[at]
    along = np.stack([np.zeros(len(at)), np.arctan(twist[at, 2] / twist[at, 0])], axis=1)
    white = noise.twist_std[2] ** 2 + bias.sigma_v_m_s**2
    # Covariance of the angles that white noise and the bias of the rates have turned until two times.
    earlier, time_s = np.minimum.outer(since, since), bias.time_w_s
    walked = noise.twist_std[3] ** 2 * float(np.median(tau_s)) * earlier
    walked += 2.0 * bias.sigma_w_rad_s**2 * time_s * (earlier + time_s * np.expm1(-earlier / time_s))
    angle, variance = np.empty((2, 2))
    for i in range(2):
        C = walked + PASSING_RAD[i] ** 2 * np.exp(-apart / PASSING_S[i]) + np.diag(i * white / forward[at] ** 2)
        try:
            weight = np.linalg.solve(C, np.ones(len(at)))
        except np.linalg.LinAlgError:  # stamps that are nearly one
            return None
        angle[i], variance[i] = weight @ -(turned + along)[:, i] / weight.sum(), 1.0 / weight.sum()
    share = noise.tilt_rad**2 / (noise.tilt_rad**2 + variance + MOUNTED_RAD**2)
    return np.array([share * angle, noise.tilt_rad * np.sqrt(1.0 - share)])
