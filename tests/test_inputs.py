"""Inputs of a recording: velocities and inertial samples at any rate."""

import dataclasses

import numpy as np
import pytest
from support.helpers import synthetic_sequence

import ekfslam
from ekfslam.data.inputs import InertialNoise, InertialSamples, Velocities
from ekfslam.errors import (
    DataError,
    EkfslamError,
    ExtrinsicsError,
    LostDataError,
    NonFiniteError,
    ShapeError,
    StampError,
)
from ekfslam.resolve import resolve

DENSITIES = InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)


def inertial(begin_s: float = -0.1, end_s: float = 2.1, rate_hz: float = 200.0) -> InertialSamples:
    time_s = np.arange(begin_s, end_s, 1.0 / rate_hz)
    wave = np.sin(np.outer(time_s, [1.0, 2.0, 3.0]))
    return InertialSamples(time_s, wave, wave + 9.81 * np.eye(3)[2], DENSITIES)


def world(**changes: object) -> ekfslam.Sequence:
    return dataclasses.replace(synthetic_sequence(frames=20), **changes)


def test_stamps_of_samples_must_increase():
    samples = inertial()
    with pytest.raises(StampError) as caught:
        dataclasses.replace(samples, time_s=np.insert(samples.time_s[:-1], 7, samples.time_s[7]))
    assert caught.value.index == 8


def test_samples_must_be_finite():
    samples = inertial()
    accel = samples.accel_m_s2.copy()
    accel[5, 2] = np.nan
    with pytest.raises(NonFiniteError, match="accel_m_s2"):
        dataclasses.replace(samples, accel_m_s2=accel)


def test_samples_must_have_the_shape_of_their_stamps():
    with pytest.raises(ShapeError, match="gyro_rad_s"):
        dataclasses.replace(inertial(), gyro_rad_s=np.zeros((4, 3)))


@pytest.mark.parametrize("density", [-1.0, np.nan, np.inf])
def test_densities_must_be_finite_and_not_negative(density):
    with pytest.raises(DataError, match="gyro_walk"):
        dataclasses.replace(DENSITIES, gyro_walk=density)


def test_samples_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        inertial().gyro_rad_s[0] = 1.0


def test_a_recording_with_samples_needs_no_velocities():
    sequence = world(inputs=(inertial(),))
    assert not sequence.has_velocities and sequence.velocities is None
    assert sequence.inertial is not None and not sequence.twist.any()


def test_velocities_at_the_stamps_of_frames_are_the_twist():
    sequence = synthetic_sequence(frames=20)
    assert sequence.velocities is not None
    assert np.array_equal(sequence.twist, sequence.velocities.twist)


def test_replacing_the_twist_keeps_other_inputs_and_the_frame():
    sequence = world(velocity_frame="level", inputs=(Velocities(0.1 * np.arange(20), np.ones((20, 6))), inertial()))
    changed = dataclasses.replace(sequence, twist=sequence.twist + 1.0)
    assert changed.velocity_frame == "level" and changed.inertial is sequence.inertial
    assert np.array_equal(changed.twist, np.full((20, 6), 2.0))
    assert np.array_equal(sequence.with_velocities(sequence.twist + 1.0).twist, changed.twist)


def test_velocities_at_a_higher_rate_are_averaged_over_each_interval():
    time_s = np.arange(1, 5) * 0.25 - 0.25
    velocities = Velocities(time_s, np.outer([1.0, 2.0, 3.0, 4.0], np.ones(6)))
    found = velocities.mean(np.array([0.0, 0.5, 0.625]))
    assert np.allclose(found[:, 0], [1.0, 2.5, 4.0])


def test_an_interval_with_an_interpolated_sample_is_interpolated():
    velocities = Velocities(np.arange(6) / 2, np.ones((6, 6)), interpolated=np.arange(6) == 3)
    assert velocities.interpolated_at(np.array([0.0, 1.0, 2.0, 2.5])).tolist() == [False, False, True, False]


def test_inputs_without_common_time_are_refused():
    with pytest.raises(ShapeError, match="no time in common"):
        world(inputs=(inertial(5.0, 6.0),))


def test_inputs_of_other_types_are_refused():
    with pytest.raises(DataError, match="found tuple"):
        world(inputs=((1, 2),))


def test_a_stretch_keeps_the_samples_around_its_frames():
    sequence = world(inputs=(inertial(),))
    part = sequence[5:10]
    stamps = part.inertial.time_s
    assert stamps[0] <= part.time_s[0] < stamps[1] and stamps[-2] < part.time_s[-1] <= stamps[-1]
    assert part.inertial.noise == DENSITIES


def test_a_stretch_keeps_the_velocities_that_drive_it():
    fast = Velocities(np.arange(0, 2, 0.05), np.arange(40)[:, None] * np.ones(6))
    sequence = world(inputs=(fast,))
    assert np.allclose(sequence[5:10].twist[1:], sequence.twist[6:10])


def test_a_file_keeps_all_inputs(tmp_path):
    fast = Velocities(np.arange(0, 2, 0.05), np.ones((40, 6)), "level", np.arange(40) == 3)
    frames = Velocities(0.1 * np.arange(20), np.ones((20, 6)))
    for inputs in ((inertial(),), (inertial(), fast), (frames, inertial()), (fast,), (inertial(), frames, fast), ()):
        sequence = world(inputs=inputs)
        ekfslam.write_sequence(sequence, tmp_path / "a.h5")
        read = ekfslam.open_sequence(tmp_path / "a.h5")
        assert [type(a) for a in read.inputs] == [type(a) for a in sequence.inputs]
        for a, b in zip(read.inputs, sequence.inputs, strict=True):
            assert all(np.array_equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


def test_a_file_of_unknown_inputs_is_refused(tmp_path):
    import h5py

    ekfslam.write_sequence(world(inputs=(inertial(),)), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["sequence/inputs/0"].attrs["kind"] = "Wheels"
    with pytest.raises(EkfslamError, match="Wheels"):
        ekfslam.open_sequence(tmp_path / "a.h5")


def test_tracks_with_samples_need_the_pose_of_the_camera():
    sequence = synthetic_sequence(frames=20)
    seen = sequence.observations
    arrays = {"frame": seen.frame, "landmark": seen.landmark, "imu": inertial()}
    with pytest.raises(ExtrinsicsError):
        ekfslam.Sequence.from_tracks(sequence.time_s, seen.pixels_px, sequence.camera, **arrays)
    built = ekfslam.Sequence.from_tracks(
        sequence.time_s, seen.pixels_px, sequence.camera, **arrays, T_cam_imu=sequence.T_cam_imu
    )
    assert built.inertial is arrays["imu"] and not built.has_velocities


def test_velocities_at_a_higher_rate_lead_to_the_frame_piece_by_piece():
    fast = Velocities(np.arange(0, 2, 0.04), np.arange(50)[:, None] * np.ones(6))
    found = world(inputs=(fast,)).interval(3)
    assert np.allclose(found.dt_s, [0.04, 0.04, 0.02]) and np.isclose(found.tau_s, 0.1)
    assert found.inputs[:, 0].tolist() == [6.0, 7.0, 8.0]


def test_a_recording_without_samples_has_no_inertial_intervals():
    with pytest.raises(LostDataError, match="no inertial samples"):
        world().interval(3, InertialSamples)


def test_info_names_the_inputs(tmp_path, capsys):
    from ekfslam.cli import main

    ekfslam.write_sequence(world(inputs=(inertial(),)), tmp_path / "a.h5")
    main(["info", str(tmp_path / "a.h5")])
    shown = capsys.readouterr().out
    assert "440 inertial samples, 200 Hz; gyroscope 0.00017 rad/s/sqrt(Hz)" in shown
    assert "inertial samples move the state" in shown


def test_samples_may_end_one_step_before_a_frame_but_not_two():
    samples = inertial(0.0, 0.9975)  # 200 samples, the last at 0.995 s
    assert samples.interval(0.9, 0.9995).dt_s.sum() == pytest.approx(0.0995)
    with pytest.raises(LostDataError):
        samples.interval(0.9, 1.005)


def test_samples_move_the_state_beside_measured_velocities_but_not_in_dead_reckoning():
    sequence = world(inputs=(synthetic_sequence(frames=20).velocities, inertial()))
    assert resolve(sequence).model.process.takes is InertialSamples
    assert resolve(sequence, mode="dead-reckoning").model.process.takes is Velocities
