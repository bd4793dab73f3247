"""What is reported: units, signs, and names that say what stands behind them."""

from __future__ import annotations

import dataclasses
import json

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam import LEVELS, Config, NoiseConfig, Study, open_sequence, read_archive, run, write_archive
from ekfslam.data.sequence import Noise
from ekfslam.evaluation.summary import summarise
from ekfslam.studies.study import StudyArchive, run_one
from ekfslam.studies.summary import summarise_study

# --- velocities of a level frame --------------------------------------------------------------------------------------


def over_level_ground(roll_deg, pitch_deg):
    """A drive that starts tilted, with velocities over level ground; true roll and pitch (T, 2), rad, of the IMU."""
    world = open_sequence("builtin:city?frames=120&outlier_fraction=0&sigma_v_m_s=0.02&sigma_w_rad_s=0.001")
    # Roll is a turn about the forward axis, pitch one about the leftward axis: nose down.
    R_level_world = Rotation.from_euler("ZYX", [0.0, pitch_deg, roll_deg], degrees=True)
    R_level_imu = R_level_world * Rotation.from_matrix(world.truth.T_world_imu[:, :3, :3])
    _, pitch, roll = R_level_imu.as_euler("ZYX").T
    # Forward, left and up over level ground, by the attitude at the begin of the interval.
    turned = Rotation.from_euler("YX", np.column_stack([pitch, roll])).as_matrix()
    before = turned[np.maximum(np.arange(len(world)) - 1, 0)]
    twist = np.hstack([(before @ part[..., None])[..., 0] for part in (world.twist[:, :3], world.twist[:, 3:])])
    return dataclasses.replace(world, twist=twist, velocity_frame="level"), np.column_stack([roll, pitch])


@pytest.mark.slow
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(3.0, 4.0), (-3.0, 4.0), (3.0, -4.0)])
def test_roll_to_the_right_and_pitch_nose_down_are_positive(roll_deg, pitch_deg):
    sequence, true = over_level_ground(roll_deg, pitch_deg)
    found = run(sequence, "full", Config(noise=NoiseConfig(tilt_deg=4.0))).parameters
    assert (found.name, found.unit) == (("roll", "pitch"), ("rad", "rad"))
    value, std, true = (part[60:] for part in (found.value, found.std, true))
    assert (np.abs(value - true) < 4.5 * std).all()
    # No other sign would do, nor one in the place of the other.
    for other in (-true, true * [1, -1], true * [-1, 1], true[:, ::-1]):
        assert (np.abs(value - other) > 10 * std).any()


@pytest.mark.slow
def test_tilt_is_given_in_degrees():
    sequence, _ = over_level_ground(0.0, 0.0)
    result = run(sequence, "full", Config(noise=NoiseConfig(tilt_deg=6.0)))
    assert result.noise.tilt_rad == pytest.approx(6.0 * np.pi / 180)
    np.testing.assert_allclose(result.parameters.prior_std, 6.0 * np.pi / 180)
    np.testing.assert_allclose(result.parameters.std[0], 6.0 * np.pi / 180, rtol=1e-3)


# --- figures of merit -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flat():
    """A recording on a plane, where rotations about the vertical add up, and a result of it."""
    sequence = synthetic_sequence(frames=150)
    return sequence, synthetic_result(sequence)


def test_relative_rotation_errors_are_in_degrees(flat):
    sequence, result = flat
    # The estimate turns by a fifth of a degree too much in every frame, that is in every 0.8 m.
    extra = Rotation.from_euler("z", 0.2 * np.arange(len(sequence))[:, None], degrees=True).as_matrix()
    T = sequence.truth.T_world_imu.copy()
    T[:, :3, :3] = T[:, :3, :3] @ extra
    summary = summarise(sequence, dataclasses.replace(result, T_world_imu=T))
    assert summary["rpe_1_frame_deg"] == pytest.approx(0.2, rel=1e-6)
    assert summary["rpe_10_m_deg"] == pytest.approx(0.2 * 10 / 0.8, rel=0.05)  # 12 or 13 frames
    assert summary["r_rel_deg_per_100m"] == pytest.approx(0.2 * 100 / 0.8, rel=0.02)


def test_the_rotation_rmse_of_a_study_is_in_degrees():
    study = Study({"mid": dataclasses.replace(LEVELS["mid"], frames=5)}, ("invariant", "standard"), runs=1)
    data = {
        variant: {field: x[None].copy() for field, x in of.items()} for variant, of in run_one(study, "mid", 0).items()
    }
    for radians, of in zip((0.02, 0.5), data.values(), strict=True):
        of["rotation_error"][:, 1:] = radians * np.array([0.0, 0.6, -0.8])
        of["position_error"][:, 1:] = radians * np.array([0.6, 0.0, -0.8])
    found = summarise_study(StudyArchive(study, {"mid": np.array([True])}, {"mid": data}))["levels"]["mid"]
    for radians, variant in ((0.02, "invariant"), (0.5, "standard")):
        assert found[variant]["rotation_rmse_deg"] == pytest.approx(180 / np.pi * radians)
        assert found[variant]["position_rmse_m"] == pytest.approx(radians)


def test_times_are_the_median_the_largest_and_the_sum(flat):
    sequence, result = flat
    ms = np.full(len(sequence), 3.0)
    ms[:20], ms[7], ms[30] = 1.0, 40.0, 0.5
    summary = summarise(sequence, dataclasses.replace(result, ms_per_frame=ms))
    assert summary["ms_per_frame_median"] == 3.0
    assert summary["ms_per_frame_max"] == 40.0
    assert summary["total_s"] == pytest.approx((19 * 1.0 + 40.0 + 0.5 + 129 * 3.0) / 1e3)


# --- archives of old ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_limits_in_pixels_of_old_archives_become_deviations_of_what_they_limit(tmp_path):
    """A disparity is uL - uR, a row mismatch vL - vR: each has the deviation of a difference of these two pixels."""
    world = open_sequence("builtin:loop?frames=5")
    world = dataclasses.replace(world, noise=Noise(world.noise.twist_std, np.array([0.3, 0.5, 0.4, 1.2])))
    path = tmp_path / "old.h5"
    write_archive(path, world, {"full": run(world, "full")})
    with h5py.File(path, "r+") as h5file:
        h5file.attrs["format_version"] = np.int64(2)
        group = h5file["runs/full"]
        del group["hygiene"]
        config = json.loads(group.attrs["config"])
        del config["hygiene"]
        config["filter"] |= {"restart_at_repeats": False, "min_disparity_px": 2.0, "max_row_mismatch_px": 26.0}
        group.attrs["config"] = json.dumps(config)
    hygiene = Config().with_overrides(read_archive(path).results["full"].config).hygiene
    assert hygiene.min_disparity_sigma == pytest.approx(2.0 / 0.5)
    assert hygiene.max_row_mismatch_sigma == pytest.approx(26.0 / 1.3)
    assert not hygiene.restart_at_repeats
