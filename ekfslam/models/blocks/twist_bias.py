"""A slowly changing error of the measured velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import ConfigError
from ekfslam.models.blocks.base import StateBlock, optional_block


@optional_block
@dataclass(frozen=True)
class TwistBias(StateBlock):
    """Gauss-Markov bias b of the six measured velocities: measured = true + b + white noise.

    ``b+ = exp(-tau / T) b + w`` with ``w ~ N(0, sigma^2 (1 - exp(-2 tau / T)))``: stationary with standard deviation
    sigma. Source: Maybeck, "Stochastic Models, Estimation, and Control" 1, 1979, section 4.11.

    Args:
        sigma_v_m_s, sigma_w_rad_s: Stationary standard deviations of the linear and the angular velocities, each axis.
        time_v_s, time_w_s: Their time constants T.
    """

    sigma_v_m_s: float = 0.05
    sigma_w_rad_s: float = 0.002
    time_v_s: float = 30.0
    time_w_s: float = 100.0

    name = "twist_bias"
    per_frame = True

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if not 0 < value < np.inf:
                raise ConfigError(f"blocks.{self.name}.{key} must be positive, found {value}")

    @property
    def size(self) -> int:
        return 6

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"bias of {name}" for name in ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z"))

    @property
    def units(self) -> tuple[str, ...]:
        return ("m/s",) * 3 + ("rad/s",) * 3

    def prior_covariance(self) -> Array:
        return np.diag(np.repeat([self.sigma_v_m_s, self.sigma_w_rad_s], 3) ** 2)

    def transition(self, tau_s: Array | float) -> tuple[Array, Array] | None:
        phi = np.exp(-np.asarray(tau_s)[..., None] / np.repeat([self.time_v_s, self.time_w_s], 3))
        return phi, np.sqrt(np.diag(self.prior_covariance()) * (1.0 - phi**2))

    def velocity_offset(self) -> Array | None:
        return np.eye(6)
