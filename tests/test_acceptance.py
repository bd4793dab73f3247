"""What the whole system promises, on the embedded worlds and on the recordings."""

import itertools

import numpy as np
import pytest
from support.running import WHOLE

from ekfslam import Config, open_sequence, run
from ekfslam.evaluation.summary import summarise
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import settings_of

# What the dense, noisy edition of the recordings had added to its velocities.
NOISY = Config().with_overrides({"noise": {"sigma_v_m_s": 0.5, "sigma_w_rad_s": 0.05, "sigma_px": 2.0}})


@pytest.fixture(scope="module")
def city():
    sequence = open_sequence("builtin:city" if WHOLE else "builtin:city?frames=300")
    return {mode: summarise(sequence, run(sequence, mode)) for mode in ("dead-reckoning", "mapping-only", "full")}


@pytest.mark.slow
def test_full_slam_beats_dead_reckoning_and_mapping_only_on_the_city(city):
    assert city["dead-reckoning"]["ate_m"] > 5 * city["full"]["ate_m"]
    assert city["mapping-only"]["landmark_rmse_m"] > 3 * city["full"]["landmark_rmse_m"]


@pytest.mark.slow
def test_innovations_on_the_city_are_white_despite_outliers(city):
    """The mean of NIS per degree of freedom is 1 within a few percent."""
    assert abs(city["full"]["nis_per_dof"] - 1) < 0.03


@pytest.mark.slow
def test_loop_keeps_its_landmarks_and_closes_the_loop():
    sequence = open_sequence("builtin:loop")
    result = run(sequence, "full")
    assert result.config["filter"]["retire"] == "never"
    assert result.counts["reappeared"] == 0
    assert summarise(sequence, result)["final_error_m"] < 0.2


@pytest.mark.slow
def test_state_stays_as_small_as_the_view():
    """The cost of a frame depends on what is seen, not on what has been seen."""
    sequence = open_sequence("builtin:city?frames=300")
    config = settings_of(sequence, Config()).filter
    ekf = JointEKF(Rig(sequence.camera, sequence.T_cam_imu, sequence.noise), config, sequence.initial_T_world_imu)
    for k, *_ in run_filter(ekf, sequence):
        assert set(ekf.ids.tolist()) <= set(sequence.observations.at(k)[0].tolist())
    assert len(ekf.landmarks()) > 4 * len(ekf.ids)


LENGTHS = {"0027": 1106, "0020": 1104}
# Every pair of recording, variant and coordinates.
PAIRS = [
    ("0027", "invariant", "image"),
    ("0027", "standard", "xyz"),
    ("0020", "invariant", "xyz"),
    ("0020", "standard", "image"),
]


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "variant", "coordinates"),
    itertools.product(LENGTHS, ("invariant", "standard"), ("image", "xyz")) if WHOLE else PAIRS,
)
def test_retired_and_never_retired_agree_on_the_recordings(data_path, name, variant, coordinates):
    sequence = open_sequence(data_path(f"ece276a/{name}.npz"))
    assert len(sequence) == LENGTHS[name]
    sequence = sequence if WHOLE else sequence[:60]
    base = Config().with_overrides({"filter": {"variant": variant, "landmark_coordinates": coordinates}})
    unseen, never = (
        run(sequence, "full", base.with_overrides({"filter": {"retire": retire}})) for retire in ("unseen", "never")
    )
    np.testing.assert_allclose(unseen.T_world_imu, never.T_world_imu, atol=1e-9)
    assert unseen.counts["retired"] > never.counts["retired"]


@pytest.mark.slow
@pytest.mark.data
def test_dense_noisy_recording_gains_threefold_over_dead_reckoning(data_path):
    truth = data_path("kitti_odometry_poses/07.txt")
    sequence = open_sequence(data_path("ece276a/0027_dense_noisy.npz"), truth=truth)
    sequence = sequence if WHOLE else sequence[:300]
    reckoned, full = (summarise(sequence, run(sequence, mode, NOISY)) for mode in ("dead-reckoning", "full"))
    assert reckoned["ate_m"] > 3 * full["ate_m"]
