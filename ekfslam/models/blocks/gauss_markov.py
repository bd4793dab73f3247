"""Vectors that wander about zero: the base of blocks of slowly changing errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

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
    laws: ClassVar = {"transition": "gauss_markov", "lengths": "scales"}
    least_way_m: ClassVar[float] = 0.0  # way between two frames that counts at least

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

    @property
    def scales(self) -> tuple[Array | float, Array | float]:
        """L (size or 1) as a time in s, and as a way in m; infinite where it is no such one."""
        raise NotImplementedError

    def lengths(self, tau_s: Array | float, way_m: Array | float) -> Array:
        """Return ``l / L`` (..., size or 1) over intervals of ``tau_s`` (...) and ``way_m`` (...)."""
        time_s, length_m = self.scales
        return np.asarray(tau_s)[..., None] / time_s + np.maximum(way_m, self.least_way_m)[..., None] / length_m

    def prior_covariance(self) -> Array:
        return np.diag(self.stationary_std**2)

    def transition(self, tau_s: Array | float, way_m: Array | float) -> tuple[Array, Array] | None:
        phi = np.exp(-self.lengths(tau_s, way_m))
        phi = np.broadcast_to(phi, (*phi.shape[:-1], self.size))
        return phi, self.stationary_std * np.sqrt(1.0 - phi**2)

    def as_data(self) -> dict[str, Any] | None:
        data = super().as_data()
        if data is None or self.law("lengths") == "own":
            return None
        time_s, length_m = (np.broadcast_to(scale, self.size).astype(float) for scale in self.scales)
        std = np.asarray(self.stationary_std, dtype=float)
        return {**data, "std": std, "time_s": time_s, "length_m": length_m, "least_way_m": self.least_way_m}
