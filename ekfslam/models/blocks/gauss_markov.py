"""Vectors that wander about zero: the base of blocks of slowly changing errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import ConfigError
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class GaussMarkov(StateBlock):
    """``x+ = exp(-l / L) x + w``, ``w ~ N(0, sigma^2 (1 - exp(-2 l / L)))``: stationary with standard deviation sigma.

    ``l`` is the time or way between two frames, L the time or way after which a share 1/e is left (Maybeck, "Stochastic
    Models, Estimation, and Control" 1, 1979, section 4.11). Every setting of a subclass is positive.
    """

    per_frame = True

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if value is not None and not 0 < value < np.inf:
                raise ConfigError(f"blocks.{self.name}.{key} must be positive, found {value}")

    @property
    def size(self) -> int:
        return len(self.stationary_std)

    @property
    def stationary_std(self) -> Array:
        """(size,) sigma."""
        raise NotImplementedError

    def lengths(self, tau_s: Array | float, way_m: Array | float) -> Array:
        """Return ``l / L`` (..., size or 1) over intervals of ``tau_s`` (...) and ``way_m`` (...)."""
        raise NotImplementedError

    def prior_covariance(self) -> Array:
        return np.diag(self.stationary_std**2)

    def transition(self, tau_s: Array | float, way_m: Array | float) -> tuple[Array, Array] | None:
        phi = np.exp(-self.lengths(tau_s, way_m))
        phi = np.broadcast_to(phi, (*phi.shape[:-1], self.size))
        return phi, self.stationary_std * np.sqrt(1.0 - phi**2)
