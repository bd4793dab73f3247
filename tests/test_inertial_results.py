"""Velocity, biases and tilt of an inertial unit in results, archives, posteriors, figures and pages."""

import functools
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.same import assert_same

import ekfslam
from ekfslam.data.room import Room, simulate_room
from ekfslam.errors import ArchiveError, NoInertialError
from ekfslam.evaluation.consistency import nees
from ekfslam.figures import series
from ekfslam.figures.run import draw_figures, plot_inertial
from ekfslam.filters.inertial_states import velocity_world
from ekfslam.geometry import se3
from ekfslam.page.report import report_page
from ekfslam.storage.archive import open_result
from ekfslam.storage.exports import export


@functools.cache
def room():
    return simulate_room(Room(frames=80, seed=4))


@functools.cache
def full():
    return ekfslam.run(room(), "full")


@functools.cache
def posterior():
    return ekfslam.posterior(full())


def test_a_result_states_velocity_and_biases_with_their_covariance():
    result, motion = full(), room().truth.motion
    states = result.inertial
    for found, true, std in (
        (result.velocity_world_m_s, motion.velocity_m_s, result.velocity_std_world_m_s),
        (states.gyro_bias_rad_s, motion.gyro_bias_rad_s, states.std("gyro_bias")),
        (states.accel_bias_m_s2, motion.accel_bias_m_s2, states.std("accel_bias")),
    ):
        assert (np.abs(found - true)[40:] < 4 * std[40:]).all()
    np.testing.assert_array_equal(states.covariance[:, :6, :6], result.covariance)


def test_the_covariance_of_a_world_velocity_follows_from_errors_of_pose_and_body_velocity():
    rng, frames = np.random.default_rng(0), 3
    T = se3.exp(rng.normal(size=(frames, 6)))
    A = rng.normal(size=(frames, 15, 15))
    states = replace(full().inertial, velocity_m_s=rng.normal(size=(frames, 3)), covariance=A @ A.swapaxes(1, 2))

    def moved(x):
        turned = se3.inverse(se3.exp(x[:6]) @ se3.inverse(T))
        return velocity_world(turned, replace(states, velocity_m_s=states.velocity_m_s + x[6:9]))[0]

    step = 1e-6 * np.eye(15)
    J = np.stack([(moved(dx) - moved(-dx)) / 2e-6 for dx in step], axis=2)
    np.testing.assert_allclose(velocity_world(T, states)[1], J @ states.covariance @ J.swapaxes(1, 2), rtol=1e-6)


def test_gravity_in_the_frame_of_the_imu_points_down_in_world():
    result = full()
    down = result.T_world_imu[:, :3, :3] @ result.gravity_imu[..., None]
    np.testing.assert_allclose(down[..., 0], np.tile([0.0, 0.0, -1.0], (80, 1)), atol=1e-12)
    tilt = result.T_world_imu[:, :3, :3] @ np.swapaxes(room().truth.T_world_imu[:, :3, :3], 1, 2)
    assert (np.abs(se3.so3_log(tilt)[10:, :2]) < 4 * result.tilt_std_rad[10:]).all()


def test_an_archive_keeps_velocity_and_biases(tmp_path):
    ekfslam.write_archive(tmp_path / "a.h5", room(), {"full": full()})
    assert_same(open_result(tmp_path / "a.h5", "full").inertial, full().inertial)


def test_an_archive_without_velocity_and_biases_is_read(tmp_path):
    path = tmp_path / "a.h5"
    ekfslam.write_archive(path, room(), {"full": full()})
    with h5py.File(path, "r+") as file:
        del file["runs/full/inertial"]
    assert open_result(path, "full").inertial is None


def test_frames_in_between_keep_their_velocities():
    part = full().between(*room().time_s[[10, 30]])
    np.testing.assert_array_equal(part.velocity_world_m_s, full().velocity_world_m_s[10:30])


def test_a_result_of_velocities_has_no_biases():
    result = replace(full(), inertial=None)
    with pytest.raises(NoInertialError, match="no inertial samples"):
        _ = result.velocity_world_m_s
    with pytest.raises(ArchiveError, match="inertial"):
        result.to_dataframe("inertial")


def test_a_table_for_pandas_has_velocity_biases_and_tilt():
    pytest.importorskip("pandas")
    table = full().to_dataframe("inertial")
    np.testing.assert_array_equal(table["v_world_y_m_s"], full().velocity_world_m_s[:, 1])
    np.testing.assert_array_equal(table["accel_bias_z_std_m_s2"], full().inertial.std("accel_bias")[:, 2])


@pytest.mark.slow
def test_a_posterior_states_smoothed_velocities_and_biases():
    found, motion = posterior(), room().truth.motion
    np.testing.assert_allclose(found.inertial.covariance[:, :6, :6], found.pose_covariance, atol=1e-12)
    for i, name in enumerate(("velocity", "gyro_bias", "accel_bias")):
        at = slice(6 + 3 * i, 9 + 3 * i)
        np.testing.assert_allclose(found.inertial.covariance[:, at, at], found.block_covariance(name), atol=1e-12)
    smoothed = ekfslam.smoother.posterior.smooth(full(), found=found)
    assert (smoothed.velocity_std_world_m_s[5:40] < full().velocity_std_world_m_s[5:40]).all()
    error = smoothed.velocity_world_m_s - motion.velocity_m_s
    covariance = velocity_world(smoothed.T_world_imu, smoothed.inertial)[1]
    assert 1.0 < np.nanmean(nees(error, covariance)[1:]) < 6.0


@pytest.mark.slow
def test_the_joint_marginal_of_a_frame_is_that_of_the_dense_inverse():
    found, frame = posterior(), 7
    matrix, columns = found.information_matrix()
    own = [
        np.flatnonzero((columns["frame"] == frame) & (columns["kind"] == k)) for k in ("pose", "velocity", "accel_bias")
    ]
    dense = np.linalg.inv(matrix.toarray())[np.ix_(np.concatenate(own), np.concatenate(own))]
    at = np.r_[0:9, 12:15]
    scale = np.sqrt(np.outer(dense.diagonal(), dense.diagonal()))
    np.testing.assert_allclose(found.inertial.covariance[frame][np.ix_(at, at)] / scale, dense / scale, atol=1e-6)


def test_series_have_units_bounds_and_truth():
    drawn = series.inertial(full(), room().truth)
    assert [one.name for one, _ in drawn[::3]] == [
        "velocity x",
        "velocity error x",
        "gyro bias x",
        "accel bias x",
        "tilt x error",
    ]
    for one, true in drawn:
        assert one.unit in ("m/s", "rad/s", "m/s^2", "deg") and one.share_inside > 0.95
        assert (true is None) == ("error" in one.name)


def test_a_figure_of_velocity_and_biases_is_registered_once_per_mode():
    figures = draw_figures({"full": full()}, room().truth)
    assert [name for name in figures if "inertial" in name] == ["inertial_full"]
    without = plot_inertial(full())
    assert [ax.get_ylabel() for ax in without.axes[::3]][-1] == "tilt x, std [deg]"
    assert all(ax.get_xlabel() == "time [s]" for ax in without.axes[-3:])


def test_a_page_shows_velocity_and_biases():
    archive = ekfslam.storage.archive.Archive
    fields = {name: getattr(room(), name) for name in archive.__dataclass_fields__ if name not in ("results", "twist")}
    page = report_page({"room": archive(**fields, twist=None, results={"full": full()})})
    assert '"velocity error x"' in page and '"accel bias z"' in page
    assert "Velocity and biases at the end" in page and "gyro bias: x" in page


def test_states_are_exported_as_the_truth_of_euroc_and_read_back(tmp_path):
    result = full()
    path = tmp_path / "states.csv"
    export(result, path, "euroc")
    truth = ekfslam.attach_truth(room(), path).truth
    np.testing.assert_allclose(truth.T_world_imu, result.T_world_imu, atol=1e-9)
    np.testing.assert_allclose(truth.motion.velocity_m_s, result.velocity_world_m_s, atol=1e-12)
    np.testing.assert_allclose(truth.motion.gyro_bias_rad_s, result.inertial.gyro_bias_rad_s, atol=1e-12)
    np.testing.assert_allclose(truth.motion.accel_bias_m_s2, result.inertial.accel_bias_m_s2, atol=1e-12)


def test_states_of_a_result_without_samples_are_not_exported(tmp_path):
    result = replace(full(), inertial=None)
    with pytest.raises(NoInertialError):
        export(result, tmp_path / "states.csv", "euroc")
