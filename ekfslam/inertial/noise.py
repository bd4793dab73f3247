"""Densities of an inertial unit, from its samples and from the innovations of the filter.

Data sheets state the noise at rest. Vibration in flight is 5 to 15 times as large. Differences of successive samples
show that: they are the noise, if it is white up to the rate of the samples, and more than it if rotors shake the unit
above the bandwidth of a motion. So they tell whether stated densities can hold, and where to search. The densities are
those with which the innovations of some stretches of the recording are likeliest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import FilterConfig
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.sequence import Sequence
from ekfslam.errors import EkfslamError, FilterError
from ekfslam.filters.stretches import run_stretches, stretches_of, thinned
from ekfslam.models.model import Model

# Ratio of differences over a density from which on it is refuted.
_REFUTED = 1.5
# Quiet stretches: seconds, samples at least, and the ratio up to which two octaves of a spectrum are level.
_QUIET_S, _QUIET_SAMPLES, _LEVEL = 1.0, 40, 1.3
# Stretches: seconds, most of them, tracks in each.
_STRETCH_S, _LEAST_S, _MOST, _TRACKS = 10.0, 1.5, 3, 30
# Length of the one stretch of a single camera, which starts where the recording does: at rest.
_FIRST_S = 15.0
# Factors as powers of 2: their bound, and the standard deviation of their prior.
_BOUND, _SPREAD = 6.0, 1.5
# Walks of biases over white noise, of units that state both: per root of a second.
_WALK = (0.1, 0.5)
# Walks of biases of one camera's unit that states none, at most: 4 times those of data sheets of small units.
_LARGEST_WALKS = (1e-4, 1e-2)
_SURE, _LEAST_GAIN = 3.0, 20.0  # standard errors; see `ekfslam.resolve`

Begun = Callable[[Sequence, InertialNoise], Callable[[InertialNoise], Model]]


@dataclass(frozen=True)
class Densities:
    """Densities, and where they come from."""

    noise: InertialNoise
    text: str


def sampled_densities(samples: InertialSamples) -> tuple[float, float]:
    """Return the densities of gyroscope and accelerometer if all that third differences of samples show is noise."""
    dt = np.diff(samples.time_s)
    even = np.abs(dt - samples.step_s) < 0.2 * samples.step_s
    kept = even[2:] & even[1:-1] & even[:-2]
    found = []
    for values in (samples.gyro_rad_s, samples.accel_m_s2):
        third = np.diff(values, n=3, axis=0)[kept]
        found.append(float(np.sqrt(np.mean(third**2) / 20.0 * samples.step_s)) if len(third) else 0.0)
    return found[0], found[1]


def white_densities(samples: InertialSamples) -> tuple[float, float]:
    """Return the densities of the quietest second, below which noise never is; 0: it is not white there.

    White noise has the same density by single samples and by means of two. Vibration has not, and is motion in part.
    """
    length = round(_QUIET_S / samples.step_s)
    whole = len(samples.time_s) // max(length, 1)
    if length < _QUIET_SAMPLES or not whole:
        return 0.0, 0.0
    found = []
    for values in (samples.gyro_rad_s, samples.accel_m_s2):
        seconds = values[: whole * length].reshape(whole, length, 3)
        pairs = seconds[:, : length // 2 * 2].reshape(whole, length // 2, 2, 3).mean(axis=2)
        by_octave = [(np.diff(each, n=3, axis=1) ** 2).mean(axis=(1, 2)) / 20.0 for each in (seconds, pairs)]
        single, double = np.sqrt(np.multiply(by_octave, samples.step_s * np.array([[1.0], [2.0]])))
        quietest = int(np.argmin(single))
        is_level = 1.0 / _LEVEL < double[quietest] / max(single[quietest], 1e-12) < _LEVEL
        found.append(float(single[quietest]) if is_level else 0.0)
    return found[0], found[1]


def is_refuted(samples: InertialSamples) -> bool:
    """Return whether samples are noisier by far than the densities that they state."""
    stated = samples.noise
    assert stated is not None
    gyro, accel = sampled_densities(samples)
    return gyro > _REFUTED * stated.gyro or accel > _REFUTED * stated.accel


def from_differences(samples: InertialSamples) -> InertialNoise:
    """Return densities by differences of samples alone, with walks of biases as units typically have."""
    gyro, accel = (max(value, 1e-6) for value in sampled_densities(samples))
    return InertialNoise(gyro, accel, _WALK[0] * gyro, _WALK[1] * accel)


def likeliest_densities(sequence: Sequence, config: FilterConfig, begun: Begun) -> Densities | None:
    """Return the densities by which innovations of stretches of a recording are likeliest; None: no stretch serves.

    Args:
        sequence: Recording with clean tracks.
        config: Settings of the filter.
        begun: Function that returns, for a stretch and densities to find its first state with, the models that start
            there, as a function of densities. It raises an `EkfslamError` if there is no first state.
    """
    samples = sequence.inertial
    assert samples is not None
    upper, stated = from_differences(samples), samples.noise
    base = stated or upper
    is_monocular = sequence.camera.is_monocular
    if stated is None and is_monocular:
        walks = np.minimum((base.gyro_walk, base.accel_walk), _LARGEST_WALKS)
        base = replace(base, gyro_walk=float(walks[0]), accel_walk=float(walks[1]))
    # Half way between the stated densities and the differences, and not below noise that is white.
    ratio = ((upper.gyro, base.gyro), (upper.accel, base.accel))
    middle = [round(0.5 * math.log2(max(u, 1e-12) / max(b, 1e-12)), 3) for u, b in ratio]
    white = white_densities(samples)
    least = [round(math.log2(w / max(b, 1e-12)), 3) if w else -_BOUND for w, (_, b) in zip(white, ratio, strict=True)]
    middle = [max(at, bound) for at, bound in zip(middle, least, strict=True)]
    stretches = list(_begun_stretches(sequence, upper, begun))
    if not stretches:
        return None
    # Vibration is rectified, so biases walk with it: half as many powers of 2 as the accelerometer's noise. One short
    # stretch of one camera does not tell walks of biases from errors of its tracks.
    walks = 0.0 if is_monocular else round(0.5 * middle[1], 3)
    search = _Search(config, base, (middle[0], middle[1], walks), stretches, (least[0], least[1], -_BOUND))
    at = search.best(has_walks=not is_monocular)
    if stated is not None and not search.gains((0.0, 0.0, 0.0), at):
        return Densities(stated, "as stated: no others are clearly likelier")
    noise = search.noise(at)
    if is_monocular and (noise.gyro > _REFUTED * upper.gyro or noise.accel > _REFUTED * upper.accel):
        return None  # noisier than the samples can be: the first state is wrong
    of = f"{2.0 ** at[0]:.2g} and {2.0 ** at[1]:.2g} times the stated densities, " if stated else ""
    n = len(search.stretches)
    text = f"found from {n} stretch{'es' if n > 1 else ''}: {of}gyroscope {noise.gyro:.2g} rad/s/sqrt(Hz), "
    walk = f"walks of biases {noise.gyro_walk:.2g} and {noise.accel_walk:.2g} per root of a second"
    return Densities(noise, f"{text}accelerometer {noise.accel:.2g} m/s^2/sqrt(Hz), {walk}")


def _begun_stretches(
    sequence: Sequence, noise: InertialNoise, begun: Begun
) -> Iterator[tuple[Sequence, Callable[[InertialNoise], Model]]]:
    """Yield stretches with few tracks that have a first state, and their models."""
    time_s = sequence.time_s
    duration_s = float(time_s[-1] - time_s[0])
    count = int(np.clip(duration_s / (0.5 * _STRETCH_S), 1, _MOST))
    long_s = min(_STRETCH_S, duration_s / count)
    length = int(np.clip(np.searchsorted(time_s - time_s[0], long_s, "right"), 2, len(sequence)))
    stretches = stretches_of(len(sequence), length, count)
    if sequence.camera.is_monocular:
        stretches = [range(int(np.searchsorted(time_s - time_s[0], _FIRST_S, "right")))]
    for frames in stretches:
        try:
            part = sequence[frames.start : frames.stop]
            if part.time_s[-1] - part.time_s[0] < _LEAST_S:
                continue
            yield thinned(part, [range(len(part))], _TRACKS), begun(part, noise)
        except EkfslamError:  # nothing is seen there, or no state fits
            continue


Factors = tuple[float, float, float]  # powers of 2: gyroscope, accelerometer, and the walks of both


class _Search:
    """Log-likelihoods of stretches by factors on densities."""

    def __init__(
        self,
        config: FilterConfig,
        base: InertialNoise,
        middle: Factors,
        stretches: list[tuple[Sequence, Callable[[InertialNoise], Model]]],
        least: Factors,
    ) -> None:
        self.base, self.middle, self.stretches, self.least = base, middle, stretches, least
        self._config = replace(config, lag=0, revive=-1)
        self._scores: dict[Factors, Array] = {}

    def noise(self, at: Factors) -> InertialNoise:
        """Return the densities of some factors."""
        (gyro, accel, walk), base = (2.0**power for power in at), self.base
        return InertialNoise(base.gyro * gyro, base.accel * accel, base.gyro_walk * walk, base.accel_walk * walk)

    def value(self, at: Factors) -> float:
        """Return the log-likelihood with a weak prior, by which factors stay in its middle if data say nothing."""
        return float(self.score(at).sum()) - 0.5 * float(np.sum((np.subtract(at, self.middle) / _SPREAD) ** 2))

    def score(self, at: Factors) -> Array:
        """Return the log-likelihood of each stretch."""
        if at not in self._scores:
            noise, found = self.noise(at), []
            for part, model in self.stretches:
                try:
                    (stretch,) = run_stretches(model(noise), self._config, part, [range(len(part))])
                    found.append(stretch.log_likelihood)
                except FilterError:
                    found.append(-np.inf)
            self._scores[at] = np.array(found)
        return self._scores[at]

    def gains(self, before: Factors, after: Factors) -> bool:
        """Return whether some factors are clearly likelier than others."""
        gain = self.score(after) - self.score(before)
        error = np.sqrt(len(gain)) * float(gain.std()) if np.isfinite(gain).all() else 0.0
        return bool(gain.sum() > max(_SURE * error, _LEAST_GAIN))

    def best(self, has_walks: bool = True) -> Factors:
        """Return the likeliest factors: by steps along one axis after the other, then by parabolas."""
        at = self._climbed(self.middle, 2.0, (0, 1))
        at = self._climbed(at, 2.0, (2,)) if has_walks else at
        at = self._climbed(at, 1.0, (0, 1, 2) if has_walks else (0, 1))
        return self._vertex(self._vertex(at, 0), 1)

    def _climbed(self, at: Factors, step: float, axes: tuple[int, ...]) -> Factors:
        before = None
        while before != at:
            before = at
            for axis in axes:
                at = max((self._bounded(at, axis, by) for by in (0.0, -step, step)), key=self.value)
        return at

    def _vertex(self, at: Factors, axis: int) -> Factors:
        """Return the maximum, along an axis, of the parabola through the values at a maximum and a step away."""
        low, here, high = (self.value(_moved(at, axis, by)) for by in (-1.0, 0.0, 1.0))
        bend = low - 2.0 * here + high
        by = 0.5 * (low - high) / bend if np.isfinite(bend) and bend < 0 else 0.0
        return self._bounded(at, axis, float(np.clip(by, -0.5, 0.5)))

    def _bounded(self, at: Factors, axis: int, by: float) -> Factors:
        least = self.least[axis]
        return _moved(at, axis, float(np.clip(at[axis] + by, least, max(_BOUND, least))) - at[axis])


def _moved(at: Factors, axis: int, by: float) -> Factors:
    moved = list(at)
    moved[axis] = round(at[axis] + by, 3)
    return moved[0], moved[1], moved[2]
