"""A slowly changing error of the measured velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import optional_block
from ekfslam.models.blocks.gauss_markov import GaussMarkov

# Biases of an automotive GNSS/INS unit: the data sheets of OXTS's RT3000 family state 0.05 to 0.1 km/h and 0.01 deg/s.
_VELOCITY_BIAS_M_S, _RATE_BIAS_RAD_S = 0.02, np.deg2rad(0.01)
# A noisy sensor's bias is taken as a tenth of its noise: consumer units state no better.
_SHARE_OF_NOISE = 0.1


@optional_block
@dataclass(frozen=True)
class TwistBias(GaussMarkov):
    """Gauss-Markov bias b of the six measured velocities: measured = true + b + white noise.

    Args:
        sigma_v_m_s, sigma_w_rad_s: Stationary standard deviations for linear and angular velocities, each axis.
        time_v_s, time_w_s: Their time constants.
        slip_x_m_s, slip_y_m_s, slip_z_m_s: Those of linear velocities that are 0 because nothing measures them
            (`ekfslam.models.vehicle`); by default ``sigma_v_m_s``.
    """

    sigma_v_m_s: float = 0.05
    sigma_w_rad_s: float = 0.002
    time_v_s: float = 30.0
    time_w_s: float = 100.0
    slip_x_m_s: float | None = None
    slip_y_m_s: float | None = None
    slip_z_m_s: float | None = None

    name = "twist_bias"
    labels = tuple(f"bias of {name}" for name in ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z"))
    units = ("m/s",) * 3 + ("rad/s",) * 3

    @property
    def stationary_std(self) -> Array:
        slip = (self.slip_x_m_s, self.slip_y_m_s, self.slip_z_m_s)
        linear = [self.sigma_v_m_s if std is None else std for std in slip]
        return np.array([*linear, *[self.sigma_w_rad_s] * 3])

    @property
    def scales(self) -> tuple[Array | float, Array | float]:
        return np.repeat([self.time_v_s, self.time_w_s], 3), np.inf

    @classmethod
    def automatic(cls, white_std: Array | None, is_clean: bool, has_checked_tracks: bool) -> dict[str, float] | None:
        """Return the bias of the unit's class for clean velocities, else a tenth of their noise."""
        if white_std is None:
            return None
        least = np.array([_VELOCITY_BIAS_M_S, _RATE_BIAS_RAD_S])
        v, w = (least if is_clean else np.maximum(_SHARE_OF_NOISE * white_std, least)).tolist()
        times = {"time_v_s": 4.0, "time_w_s": 20.0} if is_clean else {"time_w_s": 200.0}
        return {"sigma_v_m_s": v, "sigma_w_rad_s": w, **times}

    def velocity_offset(self) -> Array | None:
        return np.eye(6)
