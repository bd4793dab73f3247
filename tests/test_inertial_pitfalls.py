"""Mistakes with inertial samples that the position error hardly shows: NEES or innovations have to."""

import dataclasses
import functools

import numpy as np
import pytest
from inertial import FILTER, Prior, model_from_prior, run_once

from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.interval import Interval
from ekfslam.data.room import Room, simulate_room
from ekfslam.geometry import se3
from ekfslam.models.process.inertial import inertial

FRAMES, SEEDS = 120, (0, 1)


class Held(InertialSamples):
    """Samples of which each holds until the next one, in place of the mean of both."""

    side = "right"

    def interval(self, begin_s, end_s):
        found = super().interval(begin_s, end_s)
        middle = begin_s + np.cumsum(found.dt_s) - 0.5 * found.dt_s
        k = np.searchsorted(self.time_s, middle, side=self.side) - (self.side == "right")
        return Interval(found.tau_s, found.dt_s, np.hstack([self.gyro_rad_s, self.accel_m_s2])[k])


class OfTheIntervalBefore(Held):
    """Samples that count for the interval that ends at their stamp."""

    side = "left"


def with_samples(change):
    return lambda sequence: dataclasses.replace(sequence, inputs=(change(sequence.inertial),))


def with_noise(**factors):
    def change(samples):
        found = {
            name: value * factors.get(name, factors.get("all", 1.0)) for name, value in vars(samples.noise).items()
        }
        return dataclasses.replace(samples, noise=InertialNoise(**found))

    return with_samples(change)


def scaled(**factors):
    return with_samples(
        lambda s: dataclasses.replace(s, **{name: by * getattr(s, name) for name, by in factors.items()})
    )


def read_as(kind):
    return with_samples(lambda s: kind(s.time_s, s.gyro_rad_s, s.accel_m_s2, s.noise))


def late(by_s):
    return with_samples(lambda s: dataclasses.replace(s, time_s=s.time_s + by_s))


def thinned(samples):
    return InertialSamples(samples.time_s[::4], samples.gyro_rad_s[::4], samples.accel_m_s2[::4], samples.noise)


def turned_camera(sequence):
    turn = se3.exp(np.array([0, 0, 0, 0, np.deg2rad(0.3), 0]))
    return dataclasses.replace(sequence, T_cam_imu=turn @ sequence.T_cam_imu)


@functools.cache
def room(seed):
    return simulate_room(Room(frames=FRAMES, seed=seed))


def mean_nees(mistake, gravity_m_s2=None):
    """Mean NEES of each part over the seeds, with a mistake in the recording or in gravity."""
    found = []
    for seed in SEEDS:
        sequence = mistake(room(seed))
        model = model_from_prior(sequence, Prior(), np.random.default_rng([seed, 1]))
        if gravity_m_s2 is not None:
            process = inertial(sequence.inertial.noise, gravity_m_s2)
            model = dataclasses.replace(model, make_process=process)
        found.append(run_once(sequence, model, FILTER))
    return {part: np.mean([outcome.nees[part] for outcome in found]) for part in found[0].nees}


def unchanged(sequence):
    return sequence


@pytest.mark.slow
def test_the_right_model_has_the_expected_nees():
    assert 11.0 < mean_nees(unchanged)["all"] < 20.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "at_least", "mistake"),
    [
        pytest.param("all", 60.0, read_as(Held), id="last sample held"),
        pytest.param("all", 60.0, read_as(OfTheIntervalBefore), id="sample of the interval before it"),
        pytest.param("all", 45.0, late(0.002), id="stamps 2 ms late"),
        pytest.param("pose", 60.0, late(0.005), id="stamps 5 ms late"),
        pytest.param("all", 45.0, scaled(gyro_rad_s=1.003), id="gyroscope 0.3 % too large"),
        pytest.param("accel bias", 300.0, scaled(accel_m_s2=1.01), id="accelerometer 1 % too large"),
        pytest.param("all", 40.0, with_noise(all=1 / 3), id="densities a third"),
        pytest.param("accel bias", 10.0, with_noise(gyro_walk=1e-6, accel_walk=1e-6), id="biases without walk"),
        pytest.param("all", 22.0, with_samples(thinned), id="50 Hz in place of 200 Hz"),
        pytest.param("all", 25.0, turned_camera, id="camera turned by 0.3 deg"),
    ],
)
def test_a_mistake_makes_a_nees_too_large(mistake, part, at_least):
    assert mean_nees(mistake)[part] > at_least


@pytest.mark.slow
@pytest.mark.parametrize("factors", [{"all": 3.0}, {"gyro": np.sqrt(200), "accel": np.sqrt(200)}])
def test_densities_that_are_too_large_make_the_nees_too_small(factors):
    """Three times the densities, or the standard deviation of a sample at 200 Hz taken for its density."""
    assert mean_nees(with_noise(**factors))["all"] < 11.0


@pytest.mark.slow
def test_a_wrong_magnitude_of_gravity_goes_into_the_bias_of_the_accelerometer():
    found = mean_nees(unchanged, gravity_m_s2=9.78)
    assert found["accel bias"] > 30.0 and found["pose"] < 12.0
