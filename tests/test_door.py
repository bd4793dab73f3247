"""Checks of the arguments of a filter: what is refused, with the name of the argument, and what is taken as it is."""

from __future__ import annotations

import numpy as np
import pytest
from support.compiled import CAMERA, EXTRINSICS, NOISE

from ekfslam import LiveEKF
from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.errors import DataError, DuplicateObservationError, ShapeError, StampError
from ekfslam.filters.door import (
    ascending,
    checked_frame,
    checked_interval,
    checked_numbers,
    checked_observations,
    checked_stamp,
    require_measured,
)
from ekfslam.filters.joint import JointEKF
from ekfslam.models.process import Measured
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

FITS = {"axis": np.array([0, 5]), "value": np.ones(2), "std": np.full(2, 0.1), "is_biased": np.zeros(2, dtype=bool)}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("value", np.ones(3)),
        ("value", np.array([1.0, np.nan])),
        ("std", np.ones((2, 1))),
        ("std", np.array([0.1, 0.0])),
        ("std", np.array([0.1, -1.0])),
        ("is_biased", np.zeros(1, dtype=bool)),
        ("axis", np.array([0, 6])),
        ("axis", np.array([-1, 2])),
    ],
)
def test_measurements_of_further_sensors_are_refused_by_name(name, wrong):
    require_measured(None)
    require_measured(Measured(**FITS))
    with pytest.raises(DataError, match=f"also.{name}"):
        require_measured(Measured(**{**FITS, name: wrong}))


@pytest.mark.parametrize(
    ("name", "wrong", "field"),
    [
        ("tau_s", 0.0, "time must increase"),
        ("tau_s", -0.1, "time must increase"),
        ("tau_s", np.nan, "tau_s|t:"),
        ("dt_s", np.array([0.2, -0.1]), "time must increase"),
        ("dt_s", np.ones((2, 1)), "dt_s"),
        ("dt_s", np.ones(3), "inputs"),
        ("inputs", np.ones((2, 5)), "inputs"),
        ("inputs", np.full((2, 6), 1e200), "inputs"),
        ("doubt", 0.0, "doubt"),
        ("doubt", -1.0, "doubt"),
    ],
)
def test_intervals_are_refused_by_name(name, wrong, field):
    fits = {"tau_s": 0.1, "dt_s": np.array([0.1, 0.0]), "inputs": np.ones((2, 6)), "is_gap": True, "doubt": 2.0}
    found = checked_interval(Interval(**fits), None, False)
    assert found.is_gap is True and found.doubt == 2.0
    np.testing.assert_array_equal(found.dt_s, fits["dt_s"])
    with pytest.raises(DataError, match=field):
        checked_interval(Interval(**{**fits, name: wrong}), None, False)


def test_one_velocity_is_an_interval_of_its_duration():
    found = checked_interval([1, 2, 3, 4, 5, 6], 0.25, True)
    assert found.tau_s == 0.25 and found.is_gap is True
    np.testing.assert_array_equal(found.inputs, [[1, 2, 3, 4, 5, 6]])
    with pytest.raises(StampError):
        checked_interval(Interval(0.1, np.empty(0), np.empty((0, 6)), False), None, False)


@pytest.mark.parametrize("value", [-1, 1.0, True, "1", None, np.float64(2)])
def test_frames_that_are_no_numbers_of_frames_are_refused(value):
    assert checked_frame(np.int32(3)) == 3 and type(checked_frame(np.int32(3))) is int and checked_frame(0) == 0
    with pytest.raises(DataError, match="frame"):
        checked_frame(value)


@pytest.mark.parametrize("t", [np.inf, np.nan, True, "1", None, [1.0], 1.7e18, 1j])
def test_stamps_that_are_no_seconds_are_refused(t):
    assert checked_stamp(1) == 1.0 and type(checked_stamp(np.float32(0.5))) is float and checked_stamp(-2.5) == -2.5
    with pytest.raises(DataError, match="t"):
        checked_stamp(t)


def test_observations_keep_their_order_and_each_sensor_has_its_width():
    rig, one = Rig(CAMERA, EXTRINSICS, NOISE), Monocular(CAMERA, EXTRINSICS, NOISE)
    ids, pixels = checked_observations(rig, [7, 3.0, 0], np.arange(12).reshape(3, 4))
    assert ids.tolist() == [7, 3, 0] and pixels.dtype == float
    in_order = ascending(ids, pixels)
    assert in_order[0].tolist() == [0, 3, 7] and in_order[1][0].tolist() == [8, 9, 10, 11]
    for sensor, width in ((rig, 4), (one, 2), (one, 4)):
        assert checked_observations(sensor, [1], np.ones((1, width)))[1].shape == (1, width)
    for sensor, width in ((rig, 2), (rig, 3), (rig, 5), (one, 3)):
        with pytest.raises(ShapeError, match=rf"expected .* numbers an observation, found {width}"):
            checked_observations(sensor, [1], np.ones((1, width)))
    assert checked_observations(rig, [], [])[1].shape == (0, 4)
    with pytest.raises(DuplicateObservationError, match="landmark 5 is observed twice"):
        checked_observations(rig, [9, 5, 1, 5], np.ones((4, 4)))
    with pytest.raises(DataError, match=r"-1 is negative"):
        checked_observations(rig, [2, -1], np.ones((2, 4)))


class Own(Rig):
    """A sensor of the user's, whose rows are what the class says."""

    wrong = np.nan

    def rows(self, measured):
        return np.full((len(measured), 3), self.wrong) if np.isscalar(self.wrong) else self.wrong


@pytest.mark.parametrize(("wrong", "is_right"), [(1.0, True), (np.nan, False), (np.ones((2, 2)), False)])
def test_observations_of_an_own_sensor_are_judged_by_their_rows(monkeypatch, wrong, is_right):
    monkeypatch.setattr(Own, "wrong", wrong)
    sensor, given = Own(CAMERA, EXTRINSICS, NOISE), ([4, 2], np.ones((2, 7)))
    if is_right:
        assert checked_observations(sensor, *given)[1].shape == (2, 7)
    else:
        with pytest.raises(DataError, match="as rows"):
            checked_observations(sensor, *given)


def test_numbers_are_copied_and_bounded():
    given = np.ones(3)
    assert checked_numbers(given, "x") is not given
    assert checked_numbers([], "x").size == 0
    for wrong in ([1.0, 3.0], [-3.0]):
        with pytest.raises(DataError, match="x"):
            checked_numbers(wrong, "x", largest=2.0)


def of_rig(**wrong):
    settings = {"camera": CAMERA, "T_cam_imu": EXTRINSICS, "noise": NOISE} | wrong
    return LiveEKF.from_rig(**settings)


POSES = [np.zeros((4, 4)), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan), np.eye(3), "x", 1j, [[1.0], []]]


@pytest.mark.parametrize("wrong", POSES, ids=map(str, range(len(POSES))))
@pytest.mark.parametrize("name", ["T_world_imu", "T_cam_imu"])
def test_a_first_pose_and_extrinsics_that_are_not_rigid_are_refused(name, wrong):
    with pytest.raises(DataError, match=name):
        of_rig(**{name: wrong})


@pytest.mark.parametrize("wrong", [1.0, -np.eye(6), np.triu(np.ones((6, 6))), np.eye(5), "x", np.full((6, 6), np.inf)])
def test_a_first_covariance_that_is_none_is_refused(wrong):
    with pytest.raises(DataError, match="covariance"):
        JointEKF(Rig(CAMERA, EXTRINSICS, NOISE), FilterConfig(retire="unseen"), np.eye(4), wrong)


def test_masked_numbers_are_refused():
    with pytest.raises(DataError, match="velocities: expected numbers, found a masked entry"):
        of_rig().predict(np.ma.masked_invalid([0.0, np.nan, 0.0, 0.0, 0.0, 0.0]), 0.0)


def test_measurements_by_further_sensors_of_another_class_are_refused():
    ekf = of_rig().ekf
    with pytest.raises(DataError, match="also: expected Measured, found ndarray"):
        ekf.predict(np.zeros(6), 0.1, np.zeros(6))
